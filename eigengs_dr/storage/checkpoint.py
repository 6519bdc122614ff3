"""Checkpoints: a folder beside the output of a run, from which a stopped run continues."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..backend.interrupts import undone_at_end
from ..backend.messages import warn
from ..backend.types import Arrays, Record
from . import npz
from .atomic import atomic_folder, lock_output, refuse_link, remove_folder, remove_stale

FORMAT, VERSION = "eigengs_dr.checkpoint", 1

MAX_ENTRIES = 1 << 31
"""Largest number of elements of one array, as the components of large images need."""


HEAD = "run.json"
"""Name of the file with the settings and the images; it is created together with the folder."""


@contextmanager
def open_checkpoint(
    output: str | os.PathLike[str], settings: Record, files: list[str]
) -> Iterator[Checkpoint]:
    """Lock an output during a block, and open the folder with the state of its run.

    The folder is deleted at the end of the block. If the block raises, the folder is kept unless
    it is empty. A folder without saved state, left by a run that was killed before its first save
    or during the deletion, is replaced; a warning says so if its head cannot be read.

    Parameters
    ----------
    output : path-like
        The file of the result; the folder has the same name with ".checkpoint" added.
    settings : dict
        Options on which the result depends, with values that JSON can hold.
    files : list of str
        Images to train on. If the folder exists, its list replaces this one.

    Raises
    ------
    ValueError
        If the folder belongs to a run with other settings, or holds other files.
    OSError
        If another run writes the output, the folder cannot be created, or it is or holds a link.
    """
    folder = Path(f"{os.fspath(output)}.checkpoint")
    with lock_output(output):
        remove_stale(folder.absolute().parent)
        checkpoint = _resumed(folder, to_json(settings))
        if checkpoint is None:
            with atomic_folder(folder) as temporary:
                head = {"settings": to_json(settings), "files": files}
                (temporary / HEAD).write_text(json.dumps(head), encoding="utf-8")
            checkpoint = Checkpoint(folder, files, resumed=False)
        try:
            with undone_at_end(checkpoint.close):
                yield checkpoint
        except BaseException:
            checkpoint.close()
            raise
        with suppress(OSError):
            remove_folder(folder)


def _resumed(folder: Path, settings: Record) -> Checkpoint | None:
    """Return the checkpoint in a folder; delete a folder that holds none."""
    refuse_link(folder)
    if not folder.exists():
        return None
    remove_stale(folder)
    if folder.is_dir():
        for path in folder.iterdir():
            refuse_link(path)
    try:
        head = read_json(folder / HEAD)
        stored, files = dict(head["settings"]), [str(name) for name in head["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        is_ours = folder.is_dir() and all(
            path.suffix == ".npz" or path.name == HEAD for path in folder.iterdir()
        )
        if not is_ours:
            raise ValueError(f"{folder}: not a readable checkpoint; move it away") from None
        if any(folder.iterdir()):
            warn(f"{folder}: {HEAD} is unreadable; the interrupted run begins anew")
        remove_folder(folder)
        return None
    if all(path.name == HEAD for path in folder.iterdir()):
        remove_folder(folder)
        return None
    if changes := difference(stored, settings):
        raise ValueError(
            f"{folder}: holds an interrupted run with {changes}; use its settings, or delete "
            "the folder"
        )
    return Checkpoint(folder, files, resumed=True)


@dataclass
class Checkpoint:
    """A folder with named sets of arrays of one run, see `open_checkpoint`.

    Attributes
    ----------
    folder : Path
    files : list of str
        Images of the run, in the order of its first start.
    resumed : bool
        Whether the folder existed, so that this run continues an earlier one.
    """

    folder: Path
    files: list[str]
    resumed: bool

    def close(self) -> None:
        """Delete the folder if it holds no arrays."""
        if not self.holds_work:
            with suppress(OSError):
                remove_folder(self.folder)

    @property
    def holds_work(self) -> bool:
        """Whether the folder holds arrays."""
        return any(self.folder.glob("[!.]*.npz"))

    def save(self, name: str, arrays: Arrays) -> None:
        """Write arrays under a name, and replace older arrays of this name in one step.

        Raises
        ------
        OSError
            If the file cannot be written; an existing file does not change.
        """
        write_arrays(self.folder / f"{name}.npz", arrays)

    def holds(self, name: str) -> bool:
        """Return whether arrays were saved under a name."""
        return (self.folder / f"{name}.npz").exists()

    def load(self, name: str) -> Arrays | None:
        """Return the arrays that were saved under a name, or None.

        Raises
        ------
        ValueError
            If the file is damaged.
        """
        return read_arrays(self.folder / f"{name}.npz") if self.holds(name) else None

    def remove(self, pattern: str) -> None:
        """Delete the arrays that were saved under a name, or under all names of a pattern."""
        for path in self.folder.glob(f"{pattern}.npz"):
            path.unlink(missing_ok=True)


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays of any names and types to a file, in one step.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file does not change.
    """
    fields = {key: [array.dtype.str[1:], array.ndim] for key, array in arrays.items()}
    layout = np.frombuffer(json.dumps(fields).encode(), np.uint8)
    npz.write(path, FORMAT, VERSION, {"layout": layout, **arrays}, compressed=False)


def read_arrays(path: Path) -> Arrays:
    """Read arrays that `write_arrays` wrote.

    Raises
    ------
    ValueError
        If the file is damaged.
    OSError
        If the file cannot be opened.
    """
    layout = npz.read(path, FORMAT, VERSION, {"layout": npz.Field("u1", 1)})["layout"]
    try:
        fields = {
            key: npz.Field(kind, ndim, MAX_ENTRIES)
            for key, (kind, ndim) in parse_json(layout.tobytes()).items()
        }
    except (ValueError, AttributeError, TypeError):
        raise ValueError(f"{path}: layout is damaged") from None
    return npz.read(path, FORMAT, VERSION, fields)


def to_json(settings: Record) -> Record:
    """Return settings as JSON stores them: without tuples and NumPy numbers."""
    plain: Record = json.loads(json.dumps(settings, default=lambda number: number.item()))
    return plain


def difference(stored: Record, settings: Record, of: str = "") -> str:
    """Describe settings that differ, as in "gaussians 500 instead of 900"; empty if none does.

    Those that only one of the two has, because another version wrote the file, are ignored. What
    differs inside of one is named by its path, as in "method.rates.mean 0.4 instead of 0.2".
    """
    changes = []
    for key in settings if not of else dict.fromkeys([*stored, *settings]):
        old, new, name = stored.get(key), settings.get(key), f"{of}{key}"
        if old == new or not (of or key in stored):
            continue
        if isinstance(old, list) and isinstance(new, list):
            old, new = ({str(k): one for k, one in enumerate(v)} for v in (old, new))
        if isinstance(old, dict) and isinstance(new, dict) and old.get("class") == new.get("class"):
            changes.append(difference(old, new, f"{name}."))
        else:
            changes.append(f"{name} {_brief(old)} instead of {_brief(new)}")
    return ", ".join(changes)


def _brief(value: Any) -> str:
    """Return a stored value in a line; of an object, the name of its class."""
    text = str(value.get("class", value) if isinstance(value, dict) else value)
    return " ".join(text.split())[:80]


# --- JSON, which may come from elsewhere ----------------------------------------------------------

MAX_DEPTH = 64
"""Levels of nesting of a value; files of the package have fewer than ten."""

MAX_BYTES = 1 << 26
"""Bytes of a file that holds one value."""


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text.

    Raises
    ------
    ValueError
        If the text is no JSON, or is nested deeper than `MAX_DEPTH`: whoever prints or compares
        such a value reaches Python's limit of recursion.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError(f"JSON is nested deeper than {MAX_DEPTH} levels") from None
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [
            child
            for parent in level
            if isinstance(parent, (list, dict))
            for child in (parent.values() if isinstance(parent, dict) else parent)
        ]
        if not level:
            return value
    raise ValueError(f"JSON is nested deeper than {MAX_DEPTH} levels")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Return the value of a JSON file.

    Raises
    ------
    ValueError
        As `parse_json`; also if the file has more than `MAX_BYTES`.
    OSError
        If the file cannot be read.
    """
    with Path(path).open("rb") as file:
        text = file.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise ValueError(f"JSON has more than {MAX_BYTES} bytes")
    return parse_json(text)
