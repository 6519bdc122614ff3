"""``eigengs-dr bench budget``: how many Gaussians a quality takes."""

from pathlib import Path

import click

from .backend.selection import select
from .cli.console import progress_bar
from .cli.options import (
    FOLDER,
    backend_option,
    chosen_sets,
    describe_run,
    folder_option,
    quiet_option,
    seed_option,
    set_option,
)
from .cli.outputs import check_outputs

NATURAL = "natural256"
TARGETS, HIGHEST = (32.0, 36.0, 40.0), 100.0
"""Of `eigengs_dr.bench.budget` and `eigengs_dr.fitting.refine`, without importing them."""


@click.command()
@click.argument("data", type=FOLDER, required=False)
@folder_option("For results, which are continued")
@set_option(f"Images to fit; may be repeated. By default {NATURAL}, or samples without DATA.")
@click.option(
    "--images", type=click.IntRange(min=1), default=20, show_default=True, help="Of each set."
)
@click.option(
    "--target",
    "targets",
    multiple=True,
    type=float,
    default=TARGETS,
    show_default=True,
    metavar="DB",
    help="PSNR in YCbCr to reach; may be repeated.",
)
@click.option(
    "--gaussians",
    type=click.IntRange(min=1),
    help="Of the fits that compare starts; by default the number of the set, 5000 or 20000.",
)
@click.option("--iterations", type=click.IntRange(min=1), default=1000, show_default=True)
@seed_option
@backend_option
@quiet_option
@click.pass_context
def budget(
    context: click.Context,
    data: Path | None,
    output: Path,
    names: tuple[str, ...],
    images: int,
    targets: tuple[float, ...],
    gaussians: int | None,
    iterations: int,
    seed: int,
    backend: str | None,
    quiet: bool,
) -> None:
    """Measure how many Gaussians a PSNR takes: of fits of fixed numbers, and by the search.

    DATA has a folder a set, with images in test/, or the images themselves; the set "samples",
    photos of scikit-image, needs none.

    \b
    On every image, in this order:
      fits of fixed numbers, splats placed once, until two enclose each target
      the search of fit --target-psnr, and a default fit of the number it found
      fits of one number, splats placed once, and placed anew on the way

    FOLDER gets all measurements as budget.jsonl, and a chart and a CSV file a set. The same command
    again goes on where it was stopped. An image of 256x256 pixels takes a minute or two, one of
    768x512 some ten.

    \b
    Examples:
      eigengs-dr bench budget -o budget/ --images 1 --target 36
      eigengs-dr bench budget data/ -o budget/ --set natural256 --images 20
    """
    from .bench import budget as benchmark
    from .bench import budget_tables as laid
    from .bench.charts import new_figure, save_figure
    from .bench.table import as_text

    wanted = chosen_sets(names, data, NATURAL)
    for target in targets:
        if not 0 < target <= HIGHEST:  # NaN is inside every click.FloatRange
            raise ValueError(f"--target is {target}; it must be above 0 and at most {HIGHEST:g}")
    new_figure(1, 1)  # says now, not after an hour, that charts cannot be drawn
    output.mkdir(parents=True, exist_ok=True)
    drawings = {name: output / f"budget-{name}.svg" for name in wanted}
    files = {name: output / f"budget-{name}.csv" for name in wanted}
    check_outputs([output / "budget.jsonl", *drawings.values(), *files.values()], [])
    select(backend)
    with progress_bar(quiet) as show:
        rows = benchmark.run(
            data,
            output,
            wanted,
            images,
            iterations,
            tuple(dict.fromkeys(targets)),
            gaussians,
            seed,
            describe_run(context, backend),
            backend,
            show,
        )
    found = laid.points(rows)
    for name, path in files.items():
        drawn = [point for point in found if point.set == name]
        laid.save_points(path, drawn)
        save_figure(drawings[name], laid.chart(drawn, name))
    if not quiet:
        click.echo("\n\n".join(map(as_text, laid.tables(rows))))
        click.echo(f"\ncharts: {', '.join(map(str, drawings.values()))}")
