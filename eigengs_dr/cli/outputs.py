"""Names of output files, which are checked before work starts, and JSON reports."""

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
from ..storage import npz
from ..storage.atomic import lock_output, remove_stale, require_writable
from .console import NAME


def name_outputs(
    inputs: Sequence[Path], output: Path | None, suffixes: Sequence[str], folder: bool = False
) -> list[Path]:
    """Name one output file for each input.

    Parameters
    ----------
    inputs : sequence of Path or str
        The input files.
    output : Path or None
        The output file or folder. Several inputs need a folder, which is created if it is missing.
        Files in a folder are named after the inputs. None is the current folder.
    suffixes : sequence of str
        Valid suffixes of the file; files in a folder get the first one.
    folder : bool, optional
        Whether a single input needs a folder too.

    Returns
    -------
    list of Path
        One path for each input.

    Raises
    ------
    ValueError
        If the file has another suffix, the output of several inputs is a file, or two inputs have
        the same output.
    OSError
        If the folder cannot be created.
    """
    output = Path() if output is None else output
    if len(inputs) == 1 and not folder and not output.is_dir():
        if output.suffix.lower() not in suffixes:
            packs = "; 'eigengs-dr pack' writes .egs files" * (output.suffix.lower() == ".egs")
            raise ValueError(f"{output}: the name must end in {' or '.join(suffixes)}{packs}")
        return [output]
    if not output.is_dir() and (output.exists() or output.suffix.lower() in suffixes):
        raise ValueError(f"{output}: is a file; several images, or a folder of them, need a folder")
    names = [path.stem + suffixes[0] for path in inputs]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        pairs = zip(inputs, names, strict=True)
        first, second = [path for path, name in pairs if name == twice[0]][:2]
        raise ValueError(
            f"{output / twice[0]}: {first} and {second} have this name; give an image once, or "
            "rename one of them"
        )
    output.mkdir(parents=True, exist_ok=True)
    files = [output / name for name in names]
    for file in files:  # sets of Gaussians alone are looked at before they are replaced
        if file.is_symlink() and not (file.suffix == ".npz" and file.exists()):
            raise ValueError(f"{file}: is a link, which is not followed; move it away")
    return files


def name_pictures(
    inputs: Sequence[Path], output: Path | None, folder: bool = False
) -> list[Path | None]:
    """Name a picture for each input, as `name_outputs` does; None for each without an output."""
    from ..image.formats import PICTURE_SUFFIXES

    if output is None:
        return [None for _ in inputs]
    return list(name_outputs(inputs, output, PICTURE_SUFFIXES, folder))


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | str]) -> None:
    """Check that every output can be written and overwrites neither an input nor another output.

    Files that killed runs left beside the outputs are deleted.

    Parameters
    ----------
    outputs : iterable of Path or None
        The files to write; None is skipped.
    inputs : iterable of Path or str
        The files to read.

    Raises
    ------
    ValueError
        If a file occurs twice.
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
        is_first = folder not in folders  # each folder is checked once, for 100,000 files too
        if is_first or (os.path.exists(real) and not os.path.isfile(real)):
            require_writable(output)
        if is_first:
            folders.add(folder)
            remove_stale(Path(folder))


def lock_outputs(*outputs: Path) -> None:
    """Lock outputs against other runs until the command ends; see `lock_output`."""
    for output in outputs:
        click.get_current_context().with_resource(lock_output(output))


def check_replaceable(output: Path, maps: bool) -> None:
    """Check that a fit, of maps or of one image, may replace a file.

    Raises
    ------
    ValueError
        If the file is not such a result. It is never replaced.
    """
    if not output.exists():
        return
    try:
        kind = npz.format_of(output)
    except ValueError:
        kind = ""
    if kind != (MATERIAL if maps else FORMAT):
        name = "material" if maps else "set of Gaussians"
        raise ValueError(f"{output}: exists and is not a {name}; choose another name with -o")


def describe_run(context: click.Context, backend: str | None) -> dict[str, object]:
    """Return the command line and the machine, for a report."""
    return {"command": shlex.join([NAME, *context.obj]), **describe(backend)}


def plain(value: object) -> Any:
    """Convert a value to JSON types: arrays to lists, paths to strings, infinity and NaN to None.

    JSON has neither infinity, the PSNR of two equal images, nor NaN.
    """
    text = json.dumps(value, default=lambda v: v.tolist() if hasattr(v, "tolist") else str(v))
    return json.loads(text, parse_constant=lambda name: None)
