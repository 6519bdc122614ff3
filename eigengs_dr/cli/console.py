"""Output of the command line, one line per error or note; progress bars; cluster connection."""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import click

from ..backend.entry_points import progress_bar
from ..backend.interrupts import INTERRUPTED, NAME, terminate_as_interrupt
from ..backend.messages import printable
from ..backend.selection import BackendError
from ..cluster import ClusterError

Result = TypeVar("Result")

MISSED = 1
"""Exit code if the target PSNR cannot be reached."""

FAILED = 2
"""Exit code after an error, also if only one of several images failed."""


class Program(click.Group):
    """A group of commands that reports errors in one line and exits with code 2.

    ``context.obj`` holds the list of arguments, for reports.
    """

    def main(self, args: Sequence[str] | None = None, *rest: Any, **extra: Any) -> Any:
        """Run a command and exit; see `click.Command.main`."""
        arguments = sys.argv[1:] if args is None else list(args)
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                # Escape characters that the terminal cannot show.
                stream.reconfigure(errors="backslashreplace")
        extra.update(prog_name=NAME, standalone_mode=False, obj=list(arguments))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", UserWarning)
                # One line per warning, said once, without the line of code that issued it.
                note = cache(lambda text: print_message(f"note: {text}"))
                warnings.showwarning = lambda message, *_: note(str(message))
                sys.exit(super().main(arguments, *rest, **extra))
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
        except ERRORS as error:
            _end_if_interrupted(error)
            print_message(f"error: {_message(error)}")
        except BaseException as error:
            _end_if_interrupted(error)
            raise
        sys.exit(FAILED)


ERRORS = (click.ClickException, OSError, ValueError, ImportError, BackendError, ClusterError)
"""Errors that a user can act on."""


def _message(error: Exception) -> str:
    if isinstance(error, click.ClickException):
        return error.format_message()
    if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _end_if_interrupted(error: BaseException | None) -> None:
    """Exit if a chain of errors began with Ctrl-C.

    This happens in blocks that clean up by themselves, see `terminate_as_interrupt`. Click, Dr.Jit
    and imports convert a `KeyboardInterrupt` to other errors.
    """
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            print_message("interrupted")
            sys.exit(INTERRUPTED)
        error = error.__cause__ or error.__context__


def print_message(text: str) -> None:
    """Print one line to standard error, above a progress bar; line breaks become blanks."""
    from tqdm import tqdm

    with tqdm.external_write_mode(file=sys.stderr, nolock=True):
        click.echo(f"{NAME}: {printable(' '.join(text.split()))}", err=True)


@contextmanager
def bar(quiet: bool) -> Iterator[Callable[..., None]]:
    """Show a progress bar if a block takes long and standard error is visible.

    Yields
    ------
    callable
        ``show(label, done, total, row)``: the task, the number of finished steps, the total number
        of steps and, optionally, a row of figures. The bar shows ``psnr_rgb`` of the row. A new
        label restarts the bar.
    """
    with progress_bar(False if quiet else None) as show:

        def show_printable(label: str, *values: object) -> None:
            if show:
                show(printable(label), *values)

        yield show_printable


@contextmanager
def prefix_errors(name: Path | str) -> Iterator[None]:
    """Put the name of a file before each `ValueError` in a block, unless it begins with it."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(name)) else f"{name}: {text}") from None


def for_each(
    in_folder: bool, work: Callable[..., Result], *columns: Sequence[Any]
) -> list[Result | None]:
    """Call a function for files, and return its results.

    In a folder, a file that fails does not end the others: its error is printed, and its result
    is None.
    """
    results: list[Result | None] = []
    for file, *others in zip(*columns, strict=True):
        try:
            with prefix_errors(file):
                results.append(work(file, *others))
        except ERRORS as error:
            _end_if_interrupted(error)
            if not in_folder:
                raise
            print_message(f"error: {_message(error)}")
            results.append(None)
    return results


def exit_if_failed(results: Sequence[object]) -> None:
    """End the command with the code of an error if a file of `for_each` failed."""
    if None in results:
        click.get_current_context().exit(FAILED)


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Format rows of cells as lines; the first column is left-aligned, the others right-aligned."""
    rows = [[printable(cell) for cell in row] for row in rows]
    first, *others = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        f"{row[0]:{first}}" + "".join(f"  {c:>{w}}" for c, w in zip(row[1:], others, strict=True))
        for row in rows
    ]


@contextmanager
def open_cluster(cluster: str | None) -> Iterator[Any]:
    """Connect to a cluster during a block.

    Parameters
    ----------
    cluster : str or None
        See `eigengs_dr.cluster.executor.connect`; None stands for this process.

    Yields
    ------
    distributed.Client or None

    Raises
    ------
    ClusterError
        If Dask is missing, or the scheduler does not answer.
    ValueError
        If the text is no valid cluster.
    """
    if cluster is None:
        yield None
        return
    try:
        from ..cluster.executor import connect
    except ModuleNotFoundError as error:
        raise ClusterError(
            f"--cluster needs {error.name}; in the checkout, type: pip install -e '.[cluster]'"
        ) from None
    # Batch schedulers send SIGTERM; the workers of ``local`` have to end too.
    with terminate_as_interrupt(), connect(cluster) as client:
        yield client
