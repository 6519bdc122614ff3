"""The program ``eigengs-dr``: each command calls one function of the package.

Commands import heavy modules when they run, so that ``--help`` and usage errors are fast.
"""

from importlib.metadata import entry_points

import click

from .console import Program
from .doctor import doctor
from .fit import fit
from .info import info
from .pack import pack
from .render import render
from .scene import scene
from .train import train
from .view import view


class Benchmarks(click.Group):
    """Measure speed and accuracy, and draw tables and charts.

    \b
    Examples:
      eigengs-dr bench kernels
      eigengs-dr bench tables data/ -o results/ --set natural256 --images 3
    """  # benchmarks are loaded only when one of their commands is used

    def list_commands(self, context: click.Context) -> list[str]:
        """Return the names of the commands."""
        return _load().list_commands(context)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """Return a command, or None if there is none of this name."""
        return _load().get_command(context, name)


bench = Benchmarks("bench", help=Benchmarks.__doc__)


def _load() -> click.Group:
    """Load the commands of the benchmarks, if they are installed."""
    for entry in entry_points(group="eigengs_dr.commands", name="bench"):
        group: click.Group = entry.load()
        return group
    raise click.UsageError(
        "the benchmarks are not installed; in a checkout of eigengs-dr, run: "
        "pip install ./benchmarks"
    )


@click.group(cls=Program, context_settings={"show_default": True})
@click.version_option(package_name="eigengs-dr")
def main() -> None:
    """Fit images with 2D Gaussians and render them at any size.

    \b
    Examples, in the order to run them first:
      eigengs-dr doctor
      eigengs-dr fit photo.jpg -o photo.npz --preview fit.png
      eigengs-dr render photo.npz -o large.png --scale 2
      eigengs-dr pack photo.npz -o photo.egs
      eigengs-dr view photo.npz --open

    "eigengs-dr COMMAND --help" describes a command.
    """


for command in (fit, render, train, info, pack, view, scene, doctor, bench):
    main.add_command(command)
