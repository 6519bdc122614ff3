"""``eigengs-dr bench rate``: packed fits against JPEG and WebP."""

from functools import partial
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


@click.command()
@click.argument("data", type=FOLDER, required=False)
@folder_option("For results, which are continued")
@set_option("Images to code; may be repeated. By default samples, photos of scikit-image.")
@click.option(
    "--images", type=click.IntRange(min=1), default=3, show_default=True, help="Of each set."
)
@click.option("--iterations", type=click.IntRange(min=1), default=1000, show_default=True)
@seed_option
@backend_option
@quiet_option
@click.pass_context
def rate(
    context: click.Context,
    data: Path | None,
    output: Path,
    names: tuple[str, ...],
    images: int,
    iterations: int,
    seed: int,
    backend: str | None,
    quiet: bool,
) -> None:
    """Compare packed fits with JPEG and WebP at equal size.

    DATA has a folder a set, with images in test/, or the images themselves; the set "samples" needs
    none. FOLDER gets all measurements as rate.jsonl and a chart a set. The same command again goes
    on where it was stopped. An image of 256x256 pixels takes a minute.

    \b
    Examples:
      eigengs-dr bench rate -o rate/ --images 1
      eigengs-dr bench rate data/ -o rate/ --set kodak --set natural256
    """
    from .bench import rate as benchmark
    from .bench import rate_tables as laid
    from .bench.charts import new_figure, save_figure
    from .bench.rows import measure
    from .bench.table import as_text

    wanted = chosen_sets(names, data)
    new_figure(1, 1)  # says now, not after an hour, that charts cannot be drawn
    output.mkdir(parents=True, exist_ok=True)
    drawings = {name: output / f"rate-{name}.svg" for name in wanted}
    lines = output / "rate.jsonl"
    check_outputs([lines, *drawings.values()], [])
    select(backend)
    with progress_bar(quiet) as show:
        jobs = [
            job
            for name in wanted
            for job in benchmark.jobs(
                name,
                benchmark.images_of(data, name, images),
                iterations,
                seed=seed,
                backend=backend,
            )
        ]
        rows = measure(lines, jobs, describe_run(context, backend), partial(show, "rate"))
    for name, path in drawings.items():
        save_figure(path, laid.chart(rows, name))
    if not quiet:
        click.echo("\n\n".join(map(as_text, laid.tables(rows))))
        click.echo(f"\ncharts: {', '.join(map(str, drawings.values()))}")
