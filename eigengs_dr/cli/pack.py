"""``eigengs-dr pack``: a fitted image in few bytes."""

from pathlib import Path

import click

from ..backend.selection import select
from .options import ANY_PATH, EXISTING, backend_option, describe_run, quiet_option, report_option
from .outputs import check_outputs, name_outputs
from .report import write_report

SUFFIX, BUDGET = ".egs", 0.5
"""Those of `eigengs_dr.codec`, without importing Dr.Jit."""


@click.command()
@click.argument("file", type=EXISTING, metavar="X.npz")
@click.option("-o", "--output", required=True, type=ANY_PATH, metavar="Y.egs")
@click.option("--image", type=EXISTING, help="What was fitted: the loss is measured against it.")
@click.option(
    "--budget",
    type=float,
    default=BUDGET,
    show_default=True,
    metavar="DB",
    help="Decibels of PSNR that may be lost.",
)
@click.option(
    "--levels",
    type=click.IntRange(min=1),
    default=1,
    help="Those that the set was fitted with: readers may stop after each of them, and what they "
    "read is a picture. Without it the order of the levels is lost.",
)
@backend_option
@report_option
@quiet_option
@click.pass_context
def pack(
    context: click.Context,
    file: Path,
    output: Path,
    image: Path | None,
    budget: float,
    levels: int,
    backend: str | None,
    report: Path | None,
    quiet: bool,
) -> None:
    """Store a fitted image in as few bytes as a loss of PSNR allows.

    Parameters are rounded in steps that fit the image, and coded; all that reads .npz files of
    images reads .egs files too. Without the image the loss is that of a fit of 40 dB.

    \b
    Examples:
      eigengs-dr pack photo.npz -o photo.egs --image photo.jpg
      eigengs-dr pack photo.npz -o photo.egs --budget 0.1
    """
    [target] = name_outputs([file], output, [SUFFIX])
    check_outputs([target, report], [file, *([image] if image else [])])
    select(backend)
    import eigengs_dr as eg

    gaussians = eg.Gaussians.load(file, backend=backend)
    pixels = eg.load_image(image, keep_grey=gaussians.channels == 1) if image else None
    try:
        counts = eg.level_counts(len(gaussians), levels)
        sections = [n - before for before, n in zip([0, *counts], counts, strict=False)]
        receipt = eg.pack(gaussians, target, pixels, budget, sections)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    figures = {
        "input": str(file),
        "output": str(target),
        "gaussians": len(gaussians),
        "budget": budget,
        "bytes_before": file.stat().st_size,
        "bytes": receipt.bytes,
        "bits_per_pixel": receipt.bits_per_pixel,
        "psnr": receipt.psnr,
        "lost": receipt.psnr_drop,
        "steps": receipt.steps._asdict(),
    }
    if report:
        write_report(report, {**describe_run(context, backend), **figures})
    if not quiet:
        against = "the image" if image else "the rendering before"
        space = "sRGB" if gaussians.space == "linear" else gaussians.space
        click.echo(
            f"{file}: {len(gaussians):,} Gaussians, {file.stat().st_size:,} bytes\n"
            f"  wrote {target}: {receipt.bytes:,} bytes, {receipt.bits_per_pixel:.3f} bits a pixel"
            f"\n  lost {receipt.psnr_drop:.2f} dB: {receipt.psnr:.2f} dB in {space} "
            f"against {against}"
        )
