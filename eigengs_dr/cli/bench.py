"""``eigengs-dr bench``: the benchmarks, a distribution of its own."""

from importlib.metadata import entry_points
from typing import Any

import click


class Benchmarks(click.Group):
    """The commands of the benchmarks, loaded when one of them is used."""

    def list_commands(self, context: click.Context) -> list[str]:
        """Return the names of the commands."""
        return _load().list_commands(context)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """Return a command, or None if there is none of this name."""
        return _load().get_command(context, name)


HELP = """Measure speed and accuracy, and draw tables and charts.

\b
Examples:
  eigengs-dr bench kernels
  eigengs-dr bench tables data/ -o results/ --set natural256 --images 3
"""

bench = Benchmarks("bench", help=HELP)


def _load() -> Any:
    """Load the group of commands that the installed benchmarks offer."""
    for entry in entry_points(group="eigengs_dr.commands", name="bench"):
        return entry.load()
    raise click.UsageError(
        "the benchmarks are not installed; in a checkout of eigengs-dr, run: "
        "pip install ./benchmarks"
    )
