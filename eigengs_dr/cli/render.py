"""The command ``eigengs-dr render``: render Gaussians to a picture."""

import math
from pathlib import Path

import click

from ..backend.selection import select
from .options import (
    ANY_PATH,
    EXISTING,
    MAX_PIXELS,
    Size,
    backend_option,
    check_pixels,
    quiet_option,
)
from .outputs import check_outputs, name_outputs


@click.command()
@click.argument("file", type=EXISTING, metavar="X.npz")
@click.option(
    "-o", "--output", required=True, type=ANY_PATH, metavar="Y.png", help="Picture to write."
)
@click.option("--scale", type=float, metavar="S", help="Factor on the native size, such as 0.5.")
@click.option("--size", type=Size(), help="Width and height in pixels, such as 1024x768.")
@click.option(
    "--first",
    type=click.IntRange(min=1),
    metavar="N",
    help="Draw the first N Gaussians alone; for fits with --levels.",
)
@backend_option
@quiet_option
def render(
    file: Path,
    output: Path,
    scale: float | None,
    size: tuple[int, int] | None,
    first: int | None,
    backend: str | None,
    quiet: bool,
) -> None:
    """Render a fitted image at any size.

    Without --scale and --size, the picture has the native size. A fit in linear light is written
    as sRGB. A fit of data is written unchanged; one channel gives a grey picture.

    \b
    Examples:
      eigengs-dr render photo.npz -o photo.png
      eigengs-dr render photo.npz -o large.png --scale 4
      eigengs-dr render photo.npz -o icon.png --size 64x48 --first 500
    """
    if scale is not None and size is not None:
        raise click.UsageError("--scale and --size exclude each other; give one of them")
    from ..image.io import SAVE_OPTIONS

    [output] = name_outputs([file], output, list(SAVE_OPTIONS))
    check_outputs([output], [file])
    select(backend)
    import eigengs_dr as eg

    from ..raster.render import picture_of

    gaussians = eg.Gaussians.load(file, backend=backend)
    if first is not None and first > len(gaussians):
        raise ValueError(f"{file}: --first is {first}; the file has {len(gaussians)} Gaussians")
    gaussians = gaussians[:first]
    width, height = size or _scaled(gaussians.width, gaussians.height, scale)
    eg.save_image(output, picture_of(gaussians, width, height))
    if not quiet:
        click.echo(f"{file}: {len(gaussians):,} Gaussians\n  wrote {output} ({width}x{height})")


def _scaled(width: int, height: int, scale: float | None) -> tuple[int, int]:
    """Return the scaled width and height in pixels."""
    scale = 1.0 if scale is None else scale
    if not (math.isfinite(scale) and scale > 0):
        raise click.UsageError(f"--scale {scale}: expected a number above 0, such as 2 or 0.5")
    scale = min(scale, MAX_PIXELS)
    return check_pixels(max(1, round(width * scale)), max(1, round(height * scale)))
