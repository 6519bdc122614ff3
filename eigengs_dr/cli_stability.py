"""``eigengs-dr bench stability``: every preset on every hard case."""

from functools import partial
from pathlib import Path

import click

from .backend.selection import select
from .cli.console import progress_bar
from .cli.options import backend_option, describe_run, folder_option, quiet_option, seed_option
from .cli.outputs import check_outputs

NAMES = ("default", "gaussianimage", "eigengs")
"""Of the presets, without importing Dr.Jit, which their module does."""

SHOWN = (("gaussianimage", 1), ("gaussianimage", 3), ("default", 1))
"""What is shown side by side of the case "smooth", gross tiles, faint ones and none: presets, and
how many times the steps of the case they take."""


@click.command()
@folder_option("For results, which are continued")
@click.option("--case", "cases", multiple=True, help="May be repeated. By default all.")
@click.option(
    "--preset",
    "presets",
    multiple=True,
    type=click.Choice(NAMES),
    help="May be repeated. By default all.",
)
@click.option("--iterations", type=click.IntRange(min=0), help="At most so many in every case.")
@seed_option
@backend_option
@quiet_option
@click.pass_context
def stability(
    context: click.Context,
    output: Path,
    cases: tuple[str, ...],
    presets: tuple[str, ...],
    iterations: int | None,
    seed: int,
    backend: str | None,
    quiet: bool,
) -> None:
    """Try every preset on hard cases: odd images, odd starts, rates too high.

    Writes stability.jsonl, and where the case "smooth" is among them stability-tiles.png: what
    tiling looks like. All cases take some ten minutes; the case "large" takes gigabytes. After
    Ctrl-C the same command goes on.

    \b
    Examples:
      eigengs-dr bench stability -o stability/
      eigengs-dr bench stability -o stability/ --case black --case smooth --preset default
      eigengs-dr bench stability -o quick/ --iterations 100
    """
    from .bench.cases import CASES

    unknown = [name for name in cases if name not in CASES]
    if unknown:
        raise ValueError(f"case {unknown[0]!r} is unknown; use one of {', '.join(CASES)}")
    chosen = [CASES[name] for name in dict.fromkeys(cases or CASES)]
    if iterations is not None:
        chosen = [case._replace(iterations=min(case.iterations, iterations)) for case in chosen]
    smooth = next((case for case in chosen if case.name == "smooth"), None)
    output.mkdir(parents=True, exist_ok=True)
    results, pictures = output / "stability.jsonl", output / "stability-tiles.png"
    check_outputs([results, pictures], [])
    select(backend)
    from .bench import rows, tiling
    from .bench import stability as benchmark
    from .bench.charts import new_figure
    from .bench.table import as_text

    if smooth:
        new_figure(1, 1)  # says now that matplotlib is missing, not after ten minutes
    jobs = benchmark.jobs(chosen, tuple(dict.fromkeys(presets)) or NAMES, seed, backend)
    with progress_bar(quiet) as show:
        run = describe_run(context, backend)
        measured = rows.measure(results, jobs, run, partial(show, "stability"))
        if smooth:
            image, shown = smooth.image(), {}
            for done, (name, times) in enumerate(SHOWN):
                show("tiles", done, len(SHOWN))
                longer = smooth._replace(iterations=times * smooth.iterations)
                last = benchmark.moments(longer, image, name, seed, backend)[-1]
                shown[f"{name}, {last.iteration:,} steps"] = last.picture
            tiling.save_pictures(pictures, image, shown)
    if quiet:
        return
    for table in benchmark.tables(measured):
        click.echo(as_text(table) + "\n")
    for line in benchmark.defects(measured):
        click.echo(f"defect of default: {line}")
