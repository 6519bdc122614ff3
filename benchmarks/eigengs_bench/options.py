"""Options that the commands share, and what surrounds a measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from eigengs_bench.harness.store import Row, code_state, other_code
from eigengs_bench.names import SAMPLES, SETS
from eigengs_dr.backend import select
from eigengs_dr.cli_shared import FOLDER, backend_option, described, quiet_option, seed_option
from eigengs_dr.console import progress_bar, say
from eigengs_dr.outputs import check_outputs
from eigengs_dr.report import write_report

output_option = click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    metavar="FOLDER",
    help="For results, which are continued; made where it is missing.",
)
data_argument = click.argument("data", type=FOLDER, required=False, metavar="[DATA]")


def chain(*decorators: Any) -> Callable[[Any], Any]:
    """Join decorators of click, the first outermost."""

    def decorate(command: Any) -> Any:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


def count_option(name: str, default: int | None, text: str = "", least: int = 1) -> Any:
    """Make an option that takes a number of things."""
    kind = click.IntRange(min=least)
    return click.option(name, type=kind, default=default, show_default=True, help=text)


def many_option(name: str, to: str, values: Any, text: str) -> Any:
    """Make an option that takes some of several words and may be repeated."""
    text = f"{text}; may be repeated."
    return click.option(name, to, multiple=True, type=click.Choice(list(values)), help=text)


run_options = chain(seed_option, backend_option, quiet_option, click.pass_context)


def set_options(usual: str, images: int) -> Any:
    """Make what the commands that fit sets of images take: where they are, which, how many."""
    return chain(
        data_argument,
        output_option,
        many_option("--set", "names", [SAMPLES, *SETS], f"Images to fit, by default {usual}"),
        count_option("--images", images, "Of each set."),
        count_option("--iterations", 1000),
        run_options,
    )


def chosen_sets(names: tuple[str, ...], data: Path | None, usual: str = SAMPLES) -> tuple[str, ...]:
    """Sets to measure on, each once; without data `SAMPLES` alone.

    Raises
    ------
    ValueError
        If a set is named that needs data.
    """
    wanted = tuple(dict.fromkeys(names)) or (SAMPLES if data is None else usual,)
    if data is None and set(wanted) - {SAMPLES}:
        raise ValueError("--set needs DATA, the folder that holds the set, for all but samples")
    return wanted


def about(context: click.Context, backend: str | None) -> Row:
    """Describe a run for rows and reports: command, machine, versions, commit of the code."""
    return {**described(context, backend), **code_state()}


@contextmanager
def measuring(
    context: click.Context,
    output: Path,
    file: str,
    backend: str | None,
    quiet: bool,
    **settings: Any,
) -> Iterator[Any]:
    """Prepare a folder for rows, and yield the `Task` of an experiment while a bar is shown.

    Parameters
    ----------
    context : click.Context
    output : Path
        The folder, made where it is missing.
    file : str
        The file of rows in it. A note is printed if it holds rows of other code.
    backend : {"llvm", "cuda"} or None
    quiet : bool
    **settings
        The other fields of the task.
    """
    output.mkdir(parents=True, exist_ok=True)
    check_outputs([output / file], [])
    select(backend)
    from eigengs_bench.harness.task import Task

    run = about(context, backend)
    if note := other_code(output / file, run):
        say(f"note: {note}")
    with progress_bar(quiet) as show:
        yield Task(output, about=run, backend=backend, progress=show, **settings)


def save(told: Any, output: Path, quiet: bool) -> None:
    """Write charts as SVG and their points as CSV into a folder; print the tables.

    Parameters
    ----------
    told : eigengs_bench.report.frames.Told
    output : Path
    quiet : bool
    """
    from eigengs_bench.report.charts import save_figure
    from eigengs_bench.report.frames import as_text
    from eigengs_dr.atomic import replacing

    drawings = [output / f"{chart.name}.svg" for chart in told.charts]
    for path, chart in zip(drawings, told.charts, strict=True):
        save_figure(path, chart.figure)
    for name, points in told.points.items():
        with replacing(output / f"{name}.csv") as temporary:
            points.to_csv(temporary, index=False)
    if not quiet:
        click.echo("\n\n".join(map(as_text, told.tables)))
        if drawings:
            click.echo(f"\ncharts: {', '.join(map(str, drawings))}")


def print_figures(figures: dict[str, float], run: Row, report: Path | None, quiet: bool) -> None:
    """Write figures and what is known of their run to a file, and print the figures."""
    if report:
        write_report(report, {**run, **figures})
    if not quiet:
        click.echo("\n".join(f"{key:24} {value:.4g}" for key, value in figures.items()))
