"""The command line, ``eigengs-dr``: thin, every command calls one function of the package.

What the commands need is imported inside them, so that ``--help`` and mistakes answer at once.
"""

import json
import math
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click

from .backend import select
from .cli_fit import fit
from .cli_info import info
from .cli_pack import pack
from .cli_scene import scene
from .cli_shared import (
    ANY_PATH,
    EXISTING,
    MOST_PIXELS,
    Size,
    backend_option,
    checked_pixels,
    json_option,
)
from .cli_train import train
from .console import Program
from .outputs import check_outputs, name_outputs


@click.group(cls=Program)
@click.version_option(package_name="eigengs-dr")
def main() -> None:
    """Fit images with 2D Gaussians and render them at any size.

    \b
    Examples:
      eigengs-dr fit photo.jpg -o photo.npz --preview photo-fit.png
      eigengs-dr render photo.npz -o large.png --scale 2
      eigengs-dr pack photo.npz -o photo.egs --image photo.jpg
      eigengs-dr train photos/ -o photos.npz
      eigengs-dr doctor
    """


main.add_command(fit)
main.add_command(train)
main.add_command(info)
main.add_command(pack)
main.add_command(scene)


class Benchmarks(click.Group):
    """The commands of the benchmarks, a distribution of its own, loaded when one is used."""

    def list_commands(self, context: click.Context) -> list[str]:
        """Names of the commands."""
        return _benchmarks().list_commands(context)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """One of the commands; None where none has this name."""
        return _benchmarks().get_command(context, name)


main.add_command(Benchmarks("bench", help="Measure speed and accuracy."))


def _benchmarks() -> Any:
    """Load the group of commands that the installed benchmarks offer."""
    for entry in entry_points(group="eigengs_dr.commands", name="bench"):
        return entry.load()
    raise click.UsageError(
        "the benchmarks are not installed; in a checkout of eigengs-dr, run: "
        "pip install ./benchmarks"
    )


@main.command()
@click.argument("file", type=EXISTING, metavar="X.npz")
@click.option("-o", "--output", required=True, type=ANY_PATH, metavar="Y.png")
@click.option("--scale", type=float, metavar="S", help="Times the native size, such as 2 or 0.5.")
@click.option("--size", type=Size(), help="Width and height in pixels, such as 1024x768.")
@click.option(
    "--first",
    type=click.IntRange(min=1),
    metavar="N",
    help="Draw the first N Gaussians alone; for sets that were fitted in --levels.",
)
@backend_option
def render(
    file: Path,
    output: Path,
    scale: float | None,
    size: tuple[int, int] | None,
    first: int | None,
    backend: str | None,
) -> None:
    """Render a fitted image, at its native size or at any other.

    Linear light is written as sRGB, data as it is: grey where it has one channel.

    \b
    Examples:
      eigengs-dr render photo.npz -o photo.png
      eigengs-dr render photo.npz -o large.png --scale 4
      eigengs-dr render photo.npz -o icon.png --size 64x48 --first 500
    """
    if scale is not None and size is not None:
        raise click.UsageError("--scale and --size exclude each other; give one of them")
    from .images import SAVE_OPTIONS

    [output] = name_outputs([file], output, list(SAVE_OPTIONS))
    check_outputs([output], [file])
    select(backend)
    import eigengs_dr as eg

    from .rendering import picture_of

    gaussians = eg.Gaussians.load(file, backend=backend)
    if first is not None and first > len(gaussians):
        raise ValueError(f"{file}: --first is {first}; the file has {len(gaussians)} Gaussians")
    gaussians = gaussians[:first]
    width, height = size or _scaled(gaussians.width, gaussians.height, scale)
    eg.save_image(output, picture_of(gaussians, width, height))


@main.command()
@json_option
@click.pass_context
def doctor(context: click.Context, as_json: bool) -> None:
    """Show what works on this machine and what to install.

    Ends with exit code 1 where no backend works.

    \b
    Example:
      eigengs-dr doctor
    """
    from . import doctor as doctor_module

    found = doctor_module.report()
    click.echo(json.dumps(found, indent=2) if as_json else doctor_module.describe(found))
    context.exit(0 if found["llvm"]["works"] or found["cuda"]["works"] else 1)


def _scaled(width: int, height: int, scale: float | None) -> tuple[int, int]:
    """Width and height in pixels that a scale asks for."""
    scale = 1.0 if scale is None else scale
    if not (math.isfinite(scale) and scale > 0):
        raise click.UsageError(f"--scale {scale}: expected a number above 0, such as 2 or 0.5")
    scale = min(scale, MOST_PIXELS)
    return checked_pixels(max(1, round(width * scale)), max(1, round(height * scale)))
