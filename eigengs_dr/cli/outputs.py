"""Names of output files, checked before the work starts, and reports of all figures as JSON."""

import json
import os
import shlex
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import click

from ..backend.selection import describe
from ..gaussian.file import FORMAT, MATERIAL
from ..image.remote import stem_of
from ..storage import npz
from ..storage.atomic import atomic_write, remove_stale, require_writable
from ..storage.locks import lock_output
from .console import NAME


def name_outputs(
    inputs: Sequence[Path | str], output: Path | None, suffixes: Sequence[str], folder: bool = False
) -> list[Path]:
    """Name one output file for each input.

    Parameters
    ----------
    inputs : sequence of Path or str
        The input files, or their URLs.
    output : Path or None
        The output file or folder. Several inputs need a folder; it is created if it is missing.
        Files in a folder have the names of the inputs. None is the current folder.
    suffixes : sequence of str
        Valid suffixes of the file; files in a folder get the first.
    folder : bool, optional
        Whether one input needs a folder too, as several inputs do.

    Returns
    -------
    list of Path
        One path for each input.

    Raises
    ------
    ValueError
        If the file has another suffix, the output of several inputs is a file, or two inputs have
        one output.
    OSError
        If the folder cannot be created.
    """
    output = Path() if output is None else output
    if len(inputs) == 1 and not folder and not output.is_dir():
        if output.suffix.lower() not in suffixes:
            raise ValueError(f"{output}: the name must end in {' or '.join(suffixes)}")
        return [output]
    if not output.is_dir() and (output.exists() or output.suffix.lower() in suffixes):
        raise ValueError(f"{output}: is a file; several images, or a folder of them, need a folder")
    names = [stem_of(path) + suffixes[0] for path in inputs]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        advice = "give an image once, or rename one of them"
        raise ValueError(f"{output / twice[0]}: two images have this name; {advice}")
    output.mkdir(parents=True, exist_ok=True)
    return [output / name for name in names]


def name_pictures(
    inputs: Sequence[Path | str], output: Path | None, folder: bool = False
) -> list[Path | None]:
    """Name a picture for each input, as `name_outputs`; None for each without an output."""
    from ..image.formats import PICTURE_SUFFIXES

    if output is None:
        return [None for _ in inputs]
    return list(name_outputs(inputs, output, PICTURE_SUFFIXES, folder))


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | str]) -> None:
    """Check that every output can be written and overwrites neither an input nor another output.

    What killed runs left beside the outputs goes.

    Parameters
    ----------
    outputs : iterable of Path or None
        The files to write; None is skipped.
    inputs : iterable of Path or str
        The files to read, or their URLs.

    Raises
    ------
    ValueError
        If one file occurs twice.
    OSError
        If a file cannot be written.
    """
    uses = {os.path.realpath(path): "is read" for path in inputs}
    folders: set[str] = set()
    for output in outputs:
        if output is None:
            continue
        real = os.path.realpath(output)
        if real in uses:
            raise ValueError(f"{output}: {uses[real]} too; write to another file")
        uses[real] = "is written"
        folder = os.path.dirname(real)
        is_first = folder not in folders  # one look at a folder, of perhaps 100,000 files
        if is_first or (os.path.exists(real) and not os.path.isfile(real)):
            require_writable(output)
        if is_first:
            folders.add(folder)
            remove_stale(Path(folder))


def claim(*outputs: Path) -> None:
    """Let no other run write outputs until the command ends; see `lock_output`."""
    for output in outputs:
        click.get_current_context().with_resource(lock_output(output))


def check_replaceable(output: Path, maps: bool) -> None:
    """Check that a fit, of maps or of one image, may replace a file.

    Raises
    ------
    ValueError
        If the file is something else than such a result. It is never replaced.
    """
    if not output.exists():
        return
    try:
        kind = npz.format_of(output)
    except ValueError:
        kind = ""
    if kind != (MATERIAL if maps else FORMAT):
        name = "material" if maps else "set of Gaussians"
        raise ValueError(f"{output}: exists and is no {name}; choose another name with -o")


def describe_run(context: click.Context, backend: str | None) -> dict[str, object]:
    """Return the command as typed and the machine, for a report."""
    return {"command": shlex.join([NAME, *context.obj]), **describe(backend)}


def write_json(path: Path, figures: dict[str, object]) -> None:
    """Write figures as JSON, all or nothing; see `plain`.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file is then unchanged.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(plain(figures), indent=2) + "\n", encoding="utf-8")


def plain(value: object) -> Any:
    """Convert a value to types of JSON: arrays to lists, paths to texts, infinity and NaN to None.

    Infinity is the PSNR of two equal images; JSON has neither.
    """
    text = json.dumps(value, default=lambda v: v.tolist() if hasattr(v, "tolist") else str(v))
    return json.loads(text, parse_constant=lambda name: None)
