"""``eigengs-dr bench tables``: the paper's tables, measured on sets of images."""

from pathlib import Path

import click

from .backend.selection import select
from .cli.console import progress_bar
from .cli.options import (
    FOLDER,
    SETS,
    backend_option,
    describe_run,
    folder_option,
    quiet_option,
    seed_option,
)
from .cli.outputs import check_outputs

PAPERS = SETS[:-1]
"""The paper's kinds of images: all but Kodak's photos."""

TABLES = ("main", "ablation", "cross", "reach")
"""Of `eigengs_dr.bench.tables`, without importing it."""


@click.command()
@click.argument("data", type=FOLDER, metavar="DATA")
@folder_option("For results, which are continued")
@click.option(
    "--set",
    "names",
    multiple=True,
    type=click.Choice(SETS),
    help="Which images; may be repeated. By default all but kodak.",
)
@click.option(
    "--table",
    "tables",
    multiple=True,
    type=click.Choice(TABLES),
    help="Which tables; may be repeated. By default all.",
)
@click.option("--images", type=click.IntRange(min=1), default=20, show_default=True)
@click.option("--iterations", type=click.IntRange(min=1), default=1000, show_default=True)
@seed_option
@backend_option
@quiet_option
@click.pass_context
def tables(
    context: click.Context,
    data: Path,
    output: Path,
    names: tuple[str, ...],
    tables: tuple[str, ...],
    images: int,
    iterations: int,
    seed: int,
    backend: str | None,
    quiet: bool,
) -> None:
    """Measure every method on images that nothing was trained or tuned on.

    DATA has a folder a set (faces256, cats512, cars256, natural256), with images in train/ for the
    bases and in test/ for the figures; kodak has no parts. The first images are used.

    \b
    Tables:
      main      gaussianimage, default, and eigengs with its own and with the universal basis
      ablation  eigengs in YCbCr or RGB, with and without the frequency-aware split
      cross     eigengs with the basis of other images
      reach     how soon default has the PSNR that gaussianimage ends with

    Every fit adds a line to tables.jsonl in the folder: the same command goes on where one was
    broken off, and one with more sets or steps adds to what is there. Clocks start before the first
    splat is placed; judging pictures is not counted. Trained bases and models are kept in models/
    of the folder: about a gigabyte a set, at 512x512 some gigabytes.

    \b
    Examples:
      eigengs-dr bench tables data/ -o results/ --set natural256 --images 3
      eigengs-dr bench tables data/ -o results/ --images 4 --iterations 10000 --table main
    """
    output.mkdir(parents=True, exist_ok=True)
    check_outputs([output / "tables.jsonl"], [])
    select(backend)
    from .bench import summary
    from .bench import tables as benchmark
    from .bench.table import as_text

    with progress_bar(quiet) as show:
        found = benchmark.run(
            data,
            output,
            tuple(dict.fromkeys(names)) or PAPERS,
            tables or TABLES,
            images,
            iterations,
            seed,
            describe_run(context, backend),
            backend,
            show,
        )
    if not quiet:
        click.echo("\n\n".join(map(as_text, summary.tables(found))))
