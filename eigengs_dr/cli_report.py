"""``eigengs-dr bench report``: a page of all results."""

from pathlib import Path

import click

from .cli.options import FOLDER, folder_option, quiet_option
from .cli.outputs import check_outputs


@click.command()
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@folder_option("For the page")
@quiet_option
def report(folder: Path, output: Path, quiet: bool) -> None:
    """Write a page of what the other commands of bench left in a folder.

    Writes index.html, one file that needs no other, and README.md with pictures/ beside it. Every
    section names the commands, days, machine and versions behind its figures.

    \b
    Example:
      eigengs-dr bench stability -o results/
      eigengs-dr bench pareto -o results/
      eigengs-dr bench report results/ -o page/
    """
    from .bench import results
    from .bench.page import write_html, write_markdown

    page = results.page(folder)
    output.mkdir(parents=True, exist_ok=True)
    check_outputs([output / "index.html", output / "README.md"], [])
    write_html(output / "index.html", page)
    write_markdown(output, page)
    if not quiet:
        click.echo(f"wrote {output / 'index.html'} and {output / 'README.md'}")
