"""What makes a command of an experiment: its options, its folder, and its output."""

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from eigengs_bench.harness.store import Row, Task, code_state, other_code
from eigengs_bench.names import SAMPLES, SETS
from eigengs_dr.backend.selection import select
from eigengs_dr.cli import options
from eigengs_dr.cli.console import bar, say
from eigengs_dr.cli.outputs import check_outputs, describe_run, write_report

output_option = click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    metavar="FOLDER",
    help="For results, which are continued; made where it is missing.",
)
data_argument = click.argument("data", type=options.FOLDER, required=False, metavar="[DATA]")


def count_option(name: str, default: int, text: str = "", least: int = 1) -> Any:
    """Make an option that takes a number of things."""
    kind = click.IntRange(min=least)
    return click.option(name, type=kind, default=default, show_default=True, help=text)


def counts_option(name: str, default: tuple[int, ...], text: str, least: int = 1) -> Any:
    """Make an option that takes several numbers, each from `least` on."""
    kind: Any = {"type": click.IntRange(min=least), "default": default, "show_default": True}
    return click.option(name, multiple=True, callback=_each_once, help=text, **kind)


def many_option(name: str, to: str, values: Any, text: str) -> Any:
    """Make an option that takes some of several words and may be repeated."""
    text, kind = f"{text}; may be repeated.", click.Choice(list(values))
    return click.option(name, to, multiple=True, type=kind, callback=_each_once, help=text)


def _each_once(context: Any, option: Any, values: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(dict.fromkeys(values))


def set_options(images: int, usual: str = SAMPLES) -> Any:
    """Make the options of commands that fit sets; without DATA or --set they fit `SAMPLES`."""
    text = f"Images to fit, by default {usual} with DATA, and samples without"

    def decorate(command: Callable[..., Any]) -> Any:
        @wraps(command)
        def wrapped(task: Task, names: tuple[str, ...], **settings: Any) -> Any:
            return command(task, names or (usual if task.data else SAMPLES,), **settings)

        chosen = many_option("--set", "names", [SAMPLES, *SETS], text)
        return data_argument(chosen(count_option("--images", images, "Of each set.")(wrapped)))

    return decorate


def about(context: click.Context, backend: str | None) -> Row:
    """Describe a run for rows and reports: command, machine, versions, commit of the code."""
    return {**describe_run(context, backend), **code_state()}


def measures_rows(file: str, iterations: int | None = 1000, least: int = 1) -> Any:
    """Make a function of a task into a command that keeps rows in a file of a folder.

    The command prints the tables of the `Section` that the function returns, and writes its charts
    to the folder. It prints a note if the file holds rows of other code. With `iterations` None it
    has no option of that name.
    """

    def decorate(command: Callable[..., Any]) -> Any:
        if iterations is not None:
            text = "Steps of every fit, or the most."
            command = count_option("--iterations", iterations, text, least)(command)

        @output_option
        @options.seed_option
        @options.backend_option
        @options.quiet_option
        @click.pass_context
        @wraps(command)
        def wrapped(context: click.Context, output: Path, quiet: bool, **settings: Any) -> None:
            shared = {name: settings.pop(name) for name in Task._fields if name in settings}
            if not shared.get("data") and set(settings.get("names", ())) - {SAMPLES}:
                raise ValueError("--set needs DATA, the folder of the set, for all but samples")
            output.mkdir(parents=True, exist_ok=True)
            check_outputs([output / file], [])
            select(shared["backend"])
            run = about(context, shared["backend"])
            if note := other_code(output / file, run):
                say(f"note: {note}")
            with bar(quiet) as show:
                task = Task(output, run, progress=show, **shared)
                section = command(task, **settings)
            save(section, output, quiet)

        return wrapped

    return decorate


def save(section: Any, output: Path, quiet: bool) -> None:
    """Write the charts of a section as SVG into a folder; print its tables."""
    from eigengs_bench.report.charts import save_figure
    from eigengs_bench.report.frames import as_text

    for name, (_, figure) in section.charts.items():
        save_figure(output / f"{name}.svg", figure)
    if not quiet:
        click.echo("\n\n".join(map(as_text, section.tables)))
        click.echo("".join(f"\nchart: {output / name}.svg" for name in section.charts))


def prints_figures(command: Callable[..., Any]) -> Any:
    """Make a function into a command that prints the figures that it returns, and reports them.

    The command calls it with ``show``, see `bar`. A text beside the figures replaces them.
    """

    @options.report_option
    @options.quiet_option
    @click.pass_context
    @wraps(command)
    def wrapped(context: click.Context, report: Path | None, quiet: bool, **settings: Any) -> None:
        check_outputs([report], [])
        backend = settings.get("backend", settings.get("variant", "").split("_")[0] or None)
        select(backend)
        with bar(quiet) as show:
            figures, text = command(show=show, **settings)
        choices = {k: str(v) if isinstance(v, Path) else v for k, v in settings.items()}
        write_report(report, {**about(context, backend), **choices, **figures})
        if not quiet:
            click.echo(text or "\n".join(f"{k:24} {value:.4g}" for k, value in figures.items()))

    return wrapped
