"""``eigengs-dr bench pareto``: speed against accuracy, setting by setting."""

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
@set_option("Images to fit; may be repeated. By default samples, photos of scikit-image.")
@click.option(
    "--images", type=click.IntRange(min=1), default=3, show_default=True, help="Of each set."
)
@click.option("--iterations", type=click.IntRange(min=1), default=1000, show_default=True)
@seed_option
@backend_option
@quiet_option
@click.pass_context
def pareto(
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
    """Measure speed against accuracy: fits that differ from the default one in one setting.

    DATA has a folder a set, with images to train models on in train/ and others in test/; the set
    "samples" needs none. FOLDER gets all measurements as pareto.jsonl, a chart and a CSV file a
    set, charts of the renderer and of storage, and the models. The same command again goes on
    where it was stopped. An image takes some two minutes.

    \b
    Examples:
      eigengs-dr bench pareto -o pareto/ --images 1
      eigengs-dr bench pareto data/ -o pareto/ --set samples --set faces256
    """
    from .bench import pareto as benchmark
    from .bench import pareto_charts as charts
    from .bench import pareto_tables as laid
    from .bench.charts import new_figure, save_figure
    from .bench.pareto_kernels import kernel_job
    from .bench.rows import measure, read
    from .bench.table import as_text

    wanted = chosen_sets(names, data)
    new_figure(1, 1)  # says now, not after an hour, that charts cannot be drawn
    output.mkdir(parents=True, exist_ok=True)
    drawings = {name: output / f"pareto-{name}.svg" for name in (*wanted, "storage", "kernels")}
    points = {name: output / f"pareto-{name}.csv" for name in wanted}
    lines = output / "pareto.jsonl"
    check_outputs([lines, *drawings.values(), *points.values()], [])
    select(backend)
    with progress_bar(quiet) as show:
        collections = [
            benchmark.collected(data, name, images, output / "models", backend, show)
            for name in wanted
        ]
        jobs = [job for c in collections for job in benchmark.jobs(c, iterations, seed, backend)]
        jobs.append(kernel_job(backend))
        rows = measure(lines, jobs, describe_run(context, backend), partial(show, "pareto"))
    settings = {"iterations": iterations, "seed": seed}
    same = [row for row in read(lines) if settings.items() <= row["job"].items()]
    for name, path in points.items():
        drawn = laid.points(rows, name)
        laid.save_points(path, drawn)
        save_figure(drawings[name], charts.set_chart(drawn, name))
    save_figure(drawings["storage"], charts.storage_chart(same))
    save_figure(drawings["kernels"], charts.kernels_chart(rows[-1]["kernels"]))
    if not quiet:
        click.echo("\n\n".join(map(as_text, laid.tables(rows))))
        click.echo(f"\ncharts: {', '.join(map(str, drawings.values()))}")
