"""The command ``eigengs-dr pack``: compress a fitted image or a material."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..backend.selection import select
from ..fitting.options import Levels
from .fit_material import MapFile, MapOption, by_name, load_map
from .options import (
    ANY_PATH,
    EXISTING,
    IMAGE,
    LEVEL_COUNTS,
    backend_option,
    describe_run,
    encoding_option,
    quiet_option,
    report_option,
)
from .outputs import check_outputs, name_outputs, write_report

if TYPE_CHECKING:
    from ..codec.packing import PackResult
    from ..gaussian.gaussians import Gaussians


SUFFIX, BUDGET = ".egs", 0.5
"""Suffix of packed files and default loss in dB; copies, because `eigengs_dr.codec` imports
Dr.Jit."""


@click.command()
@click.argument("file", type=EXISTING, metavar="X.npz")
@click.option(
    "-o", "--output", required=True, type=ANY_PATH, metavar="Y.egs", help="File to write."
)
@click.option("--image", type=IMAGE, help="The original image, to measure the loss with.")
@click.option(
    "--map",
    "maps",
    multiple=True,
    type=MapOption(),
    help="The image of a map of a material; repeat for all of them.",
)
@encoding_option
@click.option(
    "--max-psnr-drop",
    type=float,
    default=BUDGET,
    show_default=True,
    metavar="DB",
    help="Allowed loss of PSNR.",
)
@click.option(
    "--levels",
    type=LEVEL_COUNTS,
    default=1,
    help="Levels of the fit, as for fit. Readers may stop after any level and have a picture. "
    "Without this option, the order of the levels is lost.",
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
    maps: tuple[MapFile, ...],
    encoding: str | None,
    max_psnr_drop: float,
    levels: Levels,
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
    inputs = [file, *([image] if image else []), *(item.path for item in maps)]
    check_outputs([target, report], inputs)
    select(backend)
    import eigengs_dr as eg

    from ..gaussian.file import maps_of

    if maps_of(file):
        figures = pack_maps(
            file, target, image, maps, encoding, max_psnr_drop, levels, backend, quiet
        )
        if report:
            write_report(report, {**describe_run(context, backend), **figures})
        return
    if maps:
        raise ValueError(f"{file}: holds one image and no maps; give --image instead of --map")

    gaussians = eg.Gaussians.load(file, backend=backend)
    grey = gaussians.channels == 1
    pixels = eg.load_image(image, grey, encoding) if image else None
    try:
        counts = eg.level_counts(len(gaussians), levels)
        sections = [n - before for before, n in zip([0, *counts], counts, strict=False)]
        receipt = eg.pack(gaussians, target, pixels, max_psnr_drop, sections)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    if report:
        figures = packing_figures(file, target, receipt.gaussians, max_psnr_drop, receipt, "psnr")
        write_report(report, {**describe_run(context, backend), **figures})
    if not quiet:
        against = "the image" if image else "the rendering of the input"
        spaces = {"linear": "sRGB", "radiance": "PU21"}
        space = spaces.get(gaussians.space, gaussians.space)
        click.echo(
            f"{file}: {len(gaussians):,} Gaussians, {file.stat().st_size:,} bytes\n"
            f"  wrote {target}: {receipt.bytes:,} bytes, "
            f"{receipt.bits_per_pixel:.3f} bits per pixel\n"
            f"  lost {receipt.psnr_drop:.2f} dB: {receipt.psnr:.2f} dB in {space} "
            f"against {against}"
        )


def pack_maps(
    file: Path,
    target: Path,
    image: Path | None,
    maps: tuple[MapFile, ...],
    encoding: str | None,
    max_psnr_drop: float,
    levels: Levels,
    backend: str | None,
    quiet: bool,
) -> dict[str, Any]:
    """Pack a material, and return its figures."""
    import eigengs_dr as eg

    if image:
        raise ValueError(f"{file}: holds a material; give its images by --map NAME=FILE")
    if levels != 1:
        raise ValueError(f"{file}: a material has no levels in .egs files; leave --levels out")
    gaussians = eg.Gaussians.load(file, backend)
    spaces = {m.name: m.space for m in gaussians.maps}
    named = {
        name: item._replace(space=item.space or spaces.get(name))
        for name, item in by_name(maps).items()
    }
    images = {name: load_map(item, encoding) for name, item in named.items()} or None
    try:
        packed = eg.pack(gaussians, target, images, max_psnr_drop, encoding=encoding)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    before = file.stat().st_size
    if not quiet and isinstance(packed.psnr, dict):
        shown = ", ".join(f"{name} {psnr:.2f} dB" for name, psnr in packed.psnr.items())
        against = "the images" if images else "the renderings of the input"
        click.echo(
            f"{file}: {len(gaussians):,} Gaussians, {before:,} bytes\n"
            f"  wrote {target}: {packed.bytes:,} bytes, "
            f"{packed.bits_per_pixel:.3f} bits per pixel for all maps\n"
            f"  lost {packed.psnr_drop:.2f} dB; psnr_rgb against {against}: {shown}"
        )
    return packing_figures(file, target, gaussians, max_psnr_drop, packed, "psnr_rgb")


def packing_figures(
    file: Path,
    target: Path,
    gaussians: Gaussians,
    max_psnr_drop: float,
    packed: PackResult,
    psnr: str,
) -> dict[str, Any]:
    """Return the figures of a report, with the PSNR under a key of its kind."""
    return {
        "input": str(file),
        "output": str(target),
        "gaussians": len(gaussians),
        "max_psnr_drop": max_psnr_drop,
        "bytes_before": file.stat().st_size,
        "bytes": packed.bytes,
        "bits_per_pixel": packed.bits_per_pixel,
        psnr: packed.psnr,
        "lost": packed.psnr_drop,
        "steps": packed.steps._asdict(),
    }
