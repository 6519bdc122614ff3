"""Where results go: file names, checked before the work starts."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..storage.atomic import require_writable


def name_outputs(
    inputs: Sequence[Path], output: Path | None, suffixes: Sequence[str]
) -> list[Path]:
    """Name one output file for each input.

    Parameters
    ----------
    inputs : sequence of Path
        The files to work on.
    output : Path or None
        The file to write, or a folder to write into. Several inputs need a folder, which is made if
        it is missing. Files in a folder are named like the inputs. None is the current folder.
    suffixes : sequence of str
        Suffixes that the file may have; files in a folder have the first.

    Returns
    -------
    list of Path
        One path for each input.

    Raises
    ------
    ValueError
        If the file has another suffix, several inputs have a file as output, or two inputs would be
        written to one file.
    OSError
        If the folder cannot be made.
    """
    output = Path() if output is None else output
    if len(inputs) == 1 and not output.is_dir():
        if output.suffix.lower() not in suffixes:
            raise ValueError(f"{output}: the name must end in {' or '.join(suffixes)}")
        return [output]
    if not output.is_dir() and (output.exists() or output.suffix.lower() in suffixes):
        raise ValueError(f"{output}: is a file; several images need a folder")
    names = [path.stem + suffixes[0] for path in inputs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise ValueError(f"{output / twice}: two of the images have this name; rename one of them")
    output.mkdir(parents=True, exist_ok=True)
    return [output / name for name in names]


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path]) -> None:
    """Check that every output can be written and overwrites neither an input nor another output.

    Parameters
    ----------
    outputs : iterable of Path or None
        The files to write; None for one that was not asked for.
    inputs : iterable of Path
        The files that are read.

    Raises
    ------
    ValueError
        If one file is named twice.
    OSError
        If a file cannot be written.
    """
    taken = {os.path.realpath(path): "is read" for path in inputs}
    for output in outputs:
        if output is None:
            continue
        real = os.path.realpath(output)
        if real in taken:
            raise ValueError(f"{output}: {taken[real]} too; write to another file")
        taken[real] = "is written"
        require_writable(output)
