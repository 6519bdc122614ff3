"""Checkpoint of a training: a folder beside the model, from which a stopped run continues."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import npz
from .atomic import atomic_write

FORMAT, VERSION = "eigengs_dr.checkpoint", 1

MAX_ENTRIES = 1 << 31
"""Largest number of elements of one array; the components of large images need so large a limit."""


class Checkpoint:
    """A folder with the named sets of arrays of one run.

    As a context manager it deletes the folder at the end of the block. If the block raises, the
    folder stays, unless it holds no work.

    Parameters
    ----------
    output : path-like
        The file of the model; the folder has the same name with ".checkpoint" added.
    settings : dict
        Options on which the result depends, with values that JSON can hold.
    files : list of str
        Images to train on. If the folder exists, its list replaces this one.

    Attributes
    ----------
    folder : Path
    files : list of str
        Images of the run, in the order of its first start.
    resumed : bool
        Whether the folder existed, so that the run continues an earlier run.

    Raises
    ------
    ValueError
        If the folder belongs to a run with other settings, or is damaged.
    OSError
        If the folder cannot be created.
    """

    def __init__(
        self, output: str | os.PathLike[str], settings: dict[str, Any], files: list[str]
    ) -> None:
        # JSON has no tuples, and no numbers of NumPy.
        settings = json.loads(json.dumps(settings, default=lambda number: number.item()))
        self.folder = Path(f"{os.fspath(output)}.checkpoint")
        self.files = files
        self.resumed = self.folder.exists()
        head = self.folder / "run.json"
        if not self.resumed:
            self.folder.mkdir()
            with atomic_write(head) as temporary:
                temporary.write_text(json.dumps({"settings": settings, "files": files}))
            return
        try:
            found = json.loads(head.read_text())
            known, self.files = found["settings"], [str(name) for name in found["files"]]
        except (OSError, ValueError, KeyError, TypeError):
            raise ValueError(
                f"{self.folder}: not a readable checkpoint; delete the folder to start again"
            ) from None
        different = [key for key in settings if known.get(key) != settings[key]]
        if different:
            key = different[0]
            raise ValueError(
                f"{self.folder}: holds an interrupted run with {key} {known.get(key)} "
                f"instead of {settings[key]}; use its settings, or delete the folder"
            )

    def __enter__(self) -> Checkpoint:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Delete the folder if the block ended without an error or nothing was saved."""
        if error is None or not self.holds_work:
            shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def holds_work(self) -> bool:
        """Whether the folder holds arrays."""
        return any(self.folder.glob("[!.]*.npz"))

    def save(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
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

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
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


def write_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays of any names and types to a file, in one step.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file does not change.
    """
    fields = {key: [array.dtype.str[1:], array.ndim] for key, array in arrays.items()}
    layout = np.frombuffer(json.dumps(fields).encode(), np.uint8)
    npz.write(path, FORMAT, VERSION, {"layout": layout, **arrays}, compressed=False)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
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
            for key, (kind, ndim) in json.loads(layout.tobytes()).items()
        }
    except (ValueError, AttributeError, TypeError):
        raise ValueError(f"{path}: layout is damaged") from None
    return npz.read(path, FORMAT, VERSION, fields)
