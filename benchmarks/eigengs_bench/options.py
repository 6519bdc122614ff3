"""What makes a command of an experiment: its options, its folder, and how it tells its rows."""

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from eigengs_bench.harness.store import Row, Task, code_state, other_code
from eigengs_bench.names import SAMPLES, SETS
from eigengs_dr.backend.selection import select
from eigengs_dr.cli.console import progress_bar, say
from eigengs_dr.cli.options import (
    FOLDER,
    backend_option,
    describe_run,
    quiet_option,
    report_option,
    seed_option,
)
from eigengs_dr.cli.outputs import check_outputs
from eigengs_dr.cli.report import write_report

output_option = click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    metavar="FOLDER",
    help="For results, which are continued; made where it is missing.",
)
data_argument = click.argument("data", type=FOLDER, required=False, metavar="[DATA]")


def count_option(name: str, default: int, text: str = "", least: int = 1) -> Any:
    """Make an option that takes a number of things."""
    kind = click.IntRange(min=least)
    return click.option(name, type=kind, default=default, show_default=True, help=text)


def many_option(name: str, to: str, values: Any, text: str) -> Any:
    """Make an option that takes some of several words and may be repeated."""
    text = f"{text}; may be repeated."
    return click.option(name, to, multiple=True, type=click.Choice(list(values)), help=text)


def set_options(images: int, usual: str = f"{SAMPLES}, photos of scikit-image") -> Any:
    """Make what the commands that fit sets of images take: where they are, which, how many."""
    names = many_option("--set", "names", [SAMPLES, *SETS], f"Images to fit, by default {usual}")
    return _chain(data_argument, names, count_option("--images", images, "Of each set."))


def chosen_sets(names: tuple[str, ...], data: Path | None, usual: str = SAMPLES) -> tuple[str, ...]:
    """Sets to measure on, each once; without data `SAMPLES` alone, `ValueError` for others."""
    wanted = tuple(dict.fromkeys(names)) or (SAMPLES if data is None else usual,)
    if data is None and set(wanted) - {SAMPLES}:
        raise ValueError("--set needs DATA, the folder that holds the set, for all but samples")
    return wanted


def about(context: click.Context, backend: str | None) -> Row:
    """Describe a run for rows and reports: command, machine, versions, commit of the code."""
    return {**describe_run(context, backend), **code_state()}


def measures_rows(file: str, iterations: int = 1000, least: int = 1) -> Any:
    """Make a function of a task into a command that keeps rows in a file of a folder.

    The function returns a `Told`: its tables are printed, and its charts and points are written to
    the folder. A note is printed if the file holds rows of other code.
    """

    def decorate(command: Callable[..., Any]) -> Any:
        @wraps(command)
        def wrapped(
            context: click.Context,
            output: Path,
            iterations: int,
            seed: int,
            backend: str | None,
            quiet: bool,
            data: Path | None = None,
            images: int = 0,
            names: tuple[str, ...] = (),
            **settings: Any,
        ) -> None:
            chosen_sets(names if data is None else (), data)
            output.mkdir(parents=True, exist_ok=True)
            check_outputs([output / file], [])
            select(backend)
            run = about(context, backend)
            if note := other_code(output / file, run):
                say(f"note: {note}")
            with progress_bar(quiet) as show:
                task = Task(output, data, run, images, iterations, seed, backend, show)
                told = command(task, names=names, **settings)
            save(told, output, quiet)

        steps = count_option("--iterations", iterations, "Steps of every fit, or the most.", least)
        options = (output_option, steps, seed_option, backend_option, quiet_option)
        return _chain(*options, click.pass_context)(wrapped)

    return decorate


def save(told: Any, output: Path, quiet: bool) -> None:
    """Write charts as SVG and their points as CSV into a folder; print the tables."""
    from eigengs_bench.report.charts import save_figure
    from eigengs_bench.report.frames import as_text
    from eigengs_dr.storage.atomic import atomic_write

    for name, (_, figure) in told.charts.items():
        save_figure(output / f"{name}.svg", figure)
    for name, points in told.points.items():
        with atomic_write(output / f"{name}.csv") as temporary:
            points.to_csv(temporary, index=False)
    if not quiet:
        click.echo("\n\n".join(map(as_text, told.tables)))
        click.echo("".join(f"\nchart: {output / name}.svg" for name in told.charts))


def prints_figures(command: Callable[..., Any]) -> Any:
    """Make a function into a command that prints the figures that it returns, and reports them.

    It is called with ``show``, see `progress_bar`, and returns the backend, settings and figures.
    """

    @wraps(command)
    def wrapped(context: click.Context, report: Path | None, quiet: bool, **settings: Any) -> None:
        check_outputs([report], [])
        with progress_bar(quiet) as show:
            backend, told, figures = command(show=show, **settings)
        if report:
            write_report(report, {**about(context, backend), **told, **figures})
        if not quiet:
            click.echo("\n".join(f"{key:24} {value:.4g}" for key, value in figures.items()))

    return _chain(report_option, quiet_option, click.pass_context)(wrapped)


def _chain(*decorators: Any) -> Callable[[Any], Any]:
    """Join decorators of click, the first outermost."""

    def decorate(command: Any) -> Any:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate
