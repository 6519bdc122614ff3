"""What becomes of an image, and the manifest of an output folder: a row for each image.

The files of results are whole or not there, so they say what a run need not do again. During a run
``manifest.jsonl`` grows by a line for each image, a JSON object; the last line of an image counts.
The end of a run leaves one line an image, sorted by name.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ..storage.atomic import atomic_write, lock_folder, remove_stale


@dataclass(frozen=True)
class ImageRow:
    """What became of one of many images.

    Attributes
    ----------
    name : str
        Stem of the file, or the number of the array with six digits.
    status : str
        "done", "skipped" because the output exists, or "failed".
    input : Path, str or None
        The image file or its URL, if there is one.
    output : Path or None
        The file of the result, if there is one.
    width, height, gaussians : int or None
        Size of the image in pixels, and the number of Gaussians. A skipped image has the figures
        of the manifest, see `eigengs_dr.collection.manifest`.
    psnr_ycbcr, psnr_rgb : float or None
        PSNR of the fit in dB, see `eigengs_dr.Fit`; None for encoded images.
    seconds : float or None
        Time of the work on the image, without reading and writing; None if it was not done. Images
        in one group share their time.
    iterations : int or None
        Number of refinement steps; None for encoded images.
    stopped : str
        Why the fit ended, see `eigengs_dr.Fit`; empty for encoded images.
    error : str
        One line that names the image and the reason, if the status is "failed".
    result : Fit, Gaussians or None
        The result, if there is no output folder.
    """

    name: str
    status: str
    input: Path | str | None = None
    output: Path | None = None
    width: int | None = None
    height: int | None = None
    gaussians: int | None = None
    psnr_ycbcr: float | None = None
    psnr_rgb: float | None = None
    seconds: float | None = None
    iterations: int | None = None
    stopped: str = ""
    error: str = ""
    result: Any = field(default=None, repr=False)


RowProgress = Callable[[int, int | None, ImageRow], None]
"""``progress(done, total, row)`` after every image; the total is None if it is unknown."""


class RunInterrupted(KeyboardInterrupt):
    """The error of a run over many images that Ctrl-C or SIGTERM interrupted.

    Attributes
    ----------
    rows : list of ImageRow
        The images until then. The image that was interrupted has no row and no file.
    """

    def __init__(self, rows: list[ImageRow]) -> None:
        super().__init__(f"interrupted after {len(rows)} images; .rows holds their results")
        self.rows = rows


NAME = "manifest.jsonl"
"""Name of the file in the output folder."""

STATUSES = ("done", "skipped", "failed")

KEYS = [field.name for field in fields(ImageRow) if field.name != "result"]
"""Keys of a row."""

Row = dict[str, Any]


class Manifest:
    """The manifest of a folder; a context manager that holds the lock of the folder.

    Parameters
    ----------
    folder : Path
        An existing folder.

    Attributes
    ----------
    rows : dict of str to dict
        The last row of each image, by its name.

    Raises
    ------
    OSError
        If another run writes into the folder, or the file cannot be read or written.
    ValueError
        If the file is no manifest.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self.rows: dict[str, Row] = {}

    def __enter__(self) -> Manifest:
        with ExitStack() as stack:
            stack.enter_context(lock_folder(self.path.parent))
            remove_stale(self.path.parent)
            self.rows, clean = read_manifest(self.path)
            if not clean:
                self._rewrite()  # else the next row would continue a half line
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *details: Any) -> None:
        """Leave one row an image, and free the folder."""
        with self._stack:
            os.close(self._file)  # Windows replaces no file that is open
            # If the disk is too full for a second file, the longer one holds the same rows.
            with suppress(OSError):
                self._rewrite()
                remove_stale(self.path.parent)

    def add(self, row: ImageRow) -> None:
        """Record what became of an image. A skipped image keeps the row of its result."""
        if row.status == "skipped" and self.rows.get(row.name, {}).get("status") == "done":
            return
        self.rows[row.name] = _to_json(row)
        text = (json.dumps(self.rows[row.name]) + "\n").encode()
        try:
            while text:  # a disk that is nearly full takes a part of it
                text = text[os.write(self._file, text) :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def output(self, name: str) -> Path:
        """Return the file of the result of an image."""
        return self.path.with_name(f"{name}.npz")

    def _rewrite(self) -> None:
        with atomic_write(self.path) as temporary:
            lines = (json.dumps(self.rows[name]) + "\n" for name in sorted(self.rows))
            temporary.write_text("".join(lines), encoding="utf-8")


def read_manifest(path: Path) -> tuple[dict[str, Row], bool]:
    """Read a manifest.

    Parameters
    ----------
    path : Path
        The file; it need not exist.

    Returns
    -------
    rows : dict of str to dict
        The last row of each image, by its name.
    clean : bool
        False if the last line is cut off, as after a crash; it is then left out.

    Raises
    ------
    ValueError
        If the file holds something else than rows.
    OSError
        If the file cannot be read.
    """
    rows: dict[str, Row] = {}
    if not path.exists():
        return rows, True
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    for number, line in enumerate(lines[:-1], 1):
        try:
            row = json.loads(line)
            if row["status"] not in STATUSES or not isinstance(row["name"], str):
                raise ValueError
        except (ValueError, TypeError, KeyError):
            raise ValueError(
                f"{path}: line {number} is no row of a manifest; move the file, or use another "
                "folder"
            ) from None
        rows[row["name"]] = row
    return rows, not lines[-1]


def _to_json(row: ImageRow) -> Row:
    """Return a row as types of JSON; the output without its folder, which may move."""
    plain: Row = {}
    for key in KEYS:
        value = getattr(row, key)
        if isinstance(value, Path):
            value = value.name if key == "output" else str(value)
        if isinstance(value, float) and not math.isfinite(value):
            value = None
        plain[key] = value.item() if hasattr(value, "item") else value
    return plain
