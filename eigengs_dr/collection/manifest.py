"""The row of an image, and the manifest of an output folder with a row for each image.

Result files are complete or missing, so a run need not fit images again whose file exists. During a
run, ``manifest.jsonl`` grows by one line per image, a JSON object; the last line of an image
counts. At the end of a run there is one line per image, sorted by name. A row holds the options of
its result, so that a run is only continued with the same options.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from ..backend.types import Record
from ..gaussian.gaussians import Gaussians
from ..storage.atomic import atomic_write, lock_folder, refuse_link, remove_stale
from ..storage.settings import Settings, difference, to_json


@dataclass(frozen=True)
class ImageRow:
    """The result of one of many images.

    Attributes
    ----------
    name : str
        Stem of the file, or the index of the array with six digits.
    status : str
        "done", "skipped" because the output exists, or "failed".
    input : Path, str or None
        The image file or its URL, if there is one.
    output : Path or None
        The file of the result, if there is one.
    width, height, gaussians : int or None
        Size of the image in pixels, and the number of Gaussians. For a skipped image, the figures
        come from the manifest, see `eigengs_dr.collection.manifest`.
    psnr_ycbcr, psnr_rgb : float or None
        PSNR of the fit in dB, see `eigengs_dr.Fit`; None for encoded images.
    seconds : float or None
        Time of the work on the image, without reading and writing; None if there was none. The
        time of a group is divided equally.
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
    """A run over many images was interrupted by Ctrl-C or SIGTERM.

    Attributes
    ----------
    rows : list of ImageRow
        The finished images. The interrupted image has neither row nor file.
    """

    def __init__(self, rows: list[ImageRow]) -> None:
        super().__init__(f"interrupted after {len(rows)} images; .rows holds their results")
        self.rows = rows


NAME = "manifest.jsonl"
"""Name of the file in the output folder."""

STATUSES = ("done", "skipped", "failed")

KEYS = [*(field.name for field in fields(ImageRow) if field.name != "result"), "options"]
"""Keys of a row."""

Row = Record


@contextmanager
def open_manifest(folder: Path, options: Settings | None = None) -> Iterator[Manifest]:
    """Lock an existing folder during a block, and open its manifest.

    Parameters
    ----------
    folder : Path
    options : dict, optional
        Options on which the results of the run depend, with values that JSON can hold.

    Raises
    ------
    OSError
        If another run writes into the folder, or the file is a link or cannot be read or written.
    ValueError
        If the file is not a manifest.
    """
    path, settings = folder / NAME, to_json(options or {})
    with lock_folder(folder):
        remove_stale(folder)
        refuse_link(path)
        rows, clean = read_manifest(path)
        if not clean:
            write_manifest(path, rows)  # otherwise the next row would extend a truncated line
        file = path.open("ab")
        try:
            yield Manifest(path, rows, file, settings)
        finally:
            # If the disk is too full for a second file, the longer file with the same rows stays.
            with suppress(OSError):
                file.close()  # Windows cannot replace an open file
                write_manifest(path, rows)
                remove_stale(folder)


class Manifest(NamedTuple):
    """The manifest of a folder.

    Attributes
    ----------
    path : Path
    rows : dict of str to dict
        The last row of each image, by name.
    file : file
        File to which new rows are appended.
    options : dict
        The options of new rows.
    """

    path: Path
    rows: dict[str, Row]
    file: BinaryIO
    options: Settings

    def other_options(self, names: Collection[str]) -> str:
        """Return a message if some of the named options differ from those of results, else "".

        Rows of older versions have no options.
        """
        options = {name: value for name, value in self.options.items() if name in names}
        for row in self.rows.values():
            stored = row.get("options") if row["status"] == "done" else None
            if isinstance(stored, dict) and (changes := difference(stored, options)):
                return (
                    f"{self.path.parent}: holds results with {changes}; use their options or "
                    "another folder, or fit all images again with --overwrite (overwrite=True)"
                )
        return ""

    def add(self, row: ImageRow) -> None:
        """Append the row of an image. A skipped image keeps the row of its result.

        If a run was killed after it wrote a result but before its row, the figures are those of
        the file.
        """
        if row.status == "skipped":
            if self.rows.get(row.name, {}).get("status") == "done":
                return
            if row.psnr_rgb is not None:
                row = replace(row, status="done")
        self.rows[row.name] = _to_json(row) | {"options": self.options}
        try:
            self.file.write(json.dumps(self.rows[row.name]).encode() + b"\n")
            self.file.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error


def write_manifest(path: Path, rows: dict[str, Row]) -> None:
    """Write a manifest with one line per image, sorted by name."""
    with atomic_write(path) as temporary:
        lines = (json.dumps(rows[name]) + "\n" for name in sorted(rows))
        temporary.write_text("".join(lines), encoding="utf-8")


def read_manifest(path: Path) -> tuple[dict[str, Row], bool]:
    """Read a manifest, which need not exist.

    Returns
    -------
    rows : dict of str to dict
        The last row of each image, by name.
    clean : bool
        False if the last line is truncated, as after a crash; it is then left out.

    Raises
    ------
    ValueError
        If the file holds anything other than rows.
    OSError
        If the file cannot be read.
    """
    rows: dict[str, Row] = {}
    if not path.exists():
        return rows, True
    *lines, rest = path.read_text(encoding="utf-8", errors="replace").split("\n")
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            if row["status"] not in STATUSES or not isinstance(row["name"], str):
                raise ValueError
        except (ValueError, TypeError, KeyError):
            raise ValueError(
                f"{path}: line {number} is not a row of a manifest; move the file, or use another "
                "folder"
            ) from None
        rows[row["name"]] = row
    return rows, not rest


def fingerprint(gaussians: Gaussians) -> str:
    """Return a hash that identifies a set among options."""
    arrays = gaussians.to_arrays().values()
    data = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(data).hexdigest()[:16]


def _to_json(row: ImageRow) -> Row:
    """Return a row in JSON types; the output without its folder, which may be moved."""
    plain: Row = {key: getattr(row, key) for key in KEYS if key != "options"}
    plain["input"] = None if row.input is None else str(row.input)
    plain["output"] = None if row.output is None else row.output.name
    infinite = [k for k, v in plain.items() if isinstance(v, float) and not math.isfinite(v)]
    return plain | dict.fromkeys(infinite)
