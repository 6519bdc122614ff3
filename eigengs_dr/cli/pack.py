"""The command ``eigengs-dr pack``: compress a fitted image or a material."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from . import options
from .fit import load_maps
from .outputs import check_outputs, describe_run, name_outputs, write_report

SUFFIX, BUDGET = ".egs", 0.5
"""Suffix of packed files and default loss in dB; copies, because `eigengs_dr.codec` imports
Dr.Jit."""

COMPARED_IN = {"linear": "sRGB", "radiance": "PU21"}
"""What the PSNR of a set of light compares; of other sets, their space."""


@click.command()
@click.argument("file", type=options.EXISTING, metavar="X.npz")
@options.output("File to write.", "Y.egs")
@click.option("--image", type=options.IMAGE, help="The original image, to measure the loss with.")
@options.maps_option("The image of a map of a material; repeat for all of them.")
@options.encoding_option
@click.option(
    "--max-psnr-drop", type=float, default=BUDGET, metavar="DB", help="Allowed loss of PSNR."
)
@click.option(
    "--levels",
    type=options.LEVEL_COUNTS,
    help="Levels of the fit, as for fit. Readers may stop after any level and have a picture. "
    "Without this option, the order of the levels is lost.",
)
@options.backend_option
@options.report_option
@options.quiet_option
@click.pass_context
def pack(
    context: click.Context,
    /,
    file: Path,
    output: Path,
    image: Path | None,
    maps: dict[str, options.MapFile],
    encoding: str | None,
    max_psnr_drop: float,
    levels: Any,
    backend: str | None,
    report: Path | None,
    quiet: bool,
) -> None:
    """Compress a fitted image to few bytes.

    The command quantises the parameters as coarsely as the allowed loss of PSNR permits, and
    codes them. Every command that reads the .npz file of an image reads .egs files too. Without
    --image, the command assumes that the fit has 40 dB. A material takes --map instead.

    \b
    Examples:
      eigengs-dr pack photo.npz -o photo.egs --image photo.jpg
      eigengs-dr pack photo.npz -o photo.egs --max-psnr-drop 0.1
      eigengs-dr pack levels.npz -o levels.egs --levels 4
      eigengs-dr pack bark.npz -o bark.egs --map albedo=a.jpg --map normal=n.jpg
    """
    [target] = name_outputs([file], output, [SUFFIX])
    inputs = [file, *([image] if image else []), *(m.path for m in maps.values())]
    check_outputs([target, report], inputs)
    select(backend)
    import eigengs_dr as eg

    from ..image.io import read_file

    gaussians = eg.Gaussians.load(file, backend)
    spaces = {m.name: m.space for m in gaussians.maps}
    if maps and not spaces:
        raise ValueError(f"{file}: holds one image and no maps; give --image instead of --map")
    if image and spaces:
        raise ValueError(f"{file}: holds a material; give its images by --map NAME=FILE")
    if levels is not None and spaces:
        raise ValueError(f"{file}: a material has no levels in .egs files; leave --levels out")
    images: Any = read_file(image, gaussians.channels == 1, encoding) if image else None
    if maps:
        known = {k: m._replace(space=m.space or spaces.get(k)) for k, m in maps.items()}
        images = load_maps(known, encoding)
    try:
        counts = eg.level_counts(len(gaussians), 1 if levels is None else levels)
        sections = [n - before for before, n in zip([0, *counts], counts, strict=False)]
        given = None if spaces else sections
        packed = eg.pack(gaussians, target, images, max_psnr_drop, given, encoding=encoding)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    figures = {
        "input": str(file),
        "output": str(target),
        "gaussians": len(packed.gaussians),
        "max_psnr_drop": max_psnr_drop,
        "bytes_before": file.stat().st_size,
        "bytes": packed.bytes,
        "bits_per_pixel": packed.bits_per_pixel,
        "psnr": packed.psnr,
        "psnr_drop": packed.psnr_drop,
        "steps": packed.steps._asdict(),
    }
    write_report(report, describe_run(context, backend) | figures)
    if not quiet:
        against = "the original" if images is not None else "the rendering of the input"
        psnr = packed.psnr if isinstance(packed.psnr, dict) else {"": packed.psnr}
        shown = ", ".join(f"{name} {value:.2f} dB".strip() for name, value in psnr.items())
        figure = (
            "psnr_rgb" if spaces else COMPARED_IN.get(gaussians.space, f"psnr in {gaussians.space}")
        )
        click.echo(
            f"{file}: {len(gaussians):,} Gaussians, {file.stat().st_size:,} bytes\n"
            f"  wrote {target}: {packed.bytes:,} bytes, "
            f"{packed.bits_per_pixel:.3f} bits per pixel\n"
            f"  lost {packed.psnr_drop:.2f} dB; {figure} against {against}: {shown}"
        )
