"""Checkpoints of a training: a folder beside the model, from which a killed run goes on."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import npz as archive
from .atomic import atomic_write

FORMAT, VERSION = "eigengs_dr.checkpoint", 1

MAX_ENTRIES = 1 << 31
"""Largest array: the components of large images are."""


class Checkpoint:
    """Named sets of arrays in a folder, all of one run.

    A context manager: the folder is deleted when its block ends, but kept when the block raises.

    Parameters
    ----------
    output : path-like
        The model that is trained; the folder is named like it, with ".checkpoint" added.
    settings : dict
        What decides the result, as JSON has it. A folder of other settings is refused.
    files : list of str
        Images to train on. Those of a run that is gone on with replace them, see `files`.

    Raises
    ------
    ValueError
        If the folder is of a run with other settings, or damaged.
    OSError
        If it cannot be made.
    """

    def __init__(
        self, output: str | os.PathLike[str], settings: dict[str, Any], files: list[str]
    ) -> None:
        self.folder = Path(f"{os.fspath(output)}.checkpoint")
        self.files = files
        """Images of the run, in order: those that the folder held when it began."""
        self.resumed = self.folder.exists()
        """Whether the run goes on with the work of another."""
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
                f"{self.folder}: is no readable checkpoint; delete the folder to start anew"
            ) from None
        different = [key for key in settings if known.get(key) != settings[key]]
        if different:
            key = different[0]
            raise ValueError(
                f"{self.folder}: holds a run that was interrupted, with {key} {known.get(key)} "
                f"instead of {settings[key]}; go on with its settings, or delete the folder"
            )

    def __enter__(self) -> Checkpoint:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Delete the folder where the work is done, or nothing was saved in it."""
        if error is None or not self.holds_work:
            shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def holds_work(self) -> bool:
        """Whether anything was saved."""
        return any(self.folder.glob("[!.]*.npz"))

    def save(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Keep arrays under a name; those that were there are replaced in one step."""
        fields = {key: [array.dtype.str[1:], array.ndim] for key, array in arrays.items()}
        layout = np.frombuffer(json.dumps(fields).encode(), np.uint8)
        members = {"layout": layout, **arrays}
        archive.write(self.folder / f"{name}.npz", FORMAT, VERSION, members, compressed=False)

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return what was saved under a name, or None.

        Raises
        ------
        ValueError
            If the file is damaged.
        """
        path = self.folder / f"{name}.npz"
        if not path.exists():
            return None
        layout = archive.read(path, FORMAT, VERSION, {"layout": archive.Field("u1", 1)})["layout"]
        try:
            fields = {
                key: archive.Field(kind, ndim, MAX_ENTRIES)
                for key, (kind, ndim) in json.loads(layout.tobytes()).items()
            }
        except (ValueError, AttributeError, TypeError):
            raise ValueError(f"{path}: layout is damaged") from None
        return archive.read(path, FORMAT, VERSION, fields)

    def remove(self, name: str) -> None:
        """Delete what was saved under a name."""
        (self.folder / f"{name}.npz").unlink(missing_ok=True)
