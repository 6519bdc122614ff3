"""What becomes of each image of a run: the row for the user, and the records between the stages."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians

Pixels = NDArray[np.float32]


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


class Outcome(NamedTuple):
    """Result of the work on one image.

    Attributes
    ----------
    gaussians : Gaussians or None
        None if the image failed.
    result : Any
        What `ImageRow.result` holds.
    figures : dict
        Other attributes of the `ImageRow`.
    """

    gaussians: Gaussians | None
    result: Any
    figures: dict[str, Any]


class Finished(NamedTuple):
    """An image whose result, if any, is written.

    Attributes
    ----------
    row : ImageRow
        In this process with the result, whether or not there is an output folder.
    pixels : ndarray of float32, shape (H, W, C), or None
        None if nothing was done, or if a worker of a cluster did it.
    place : int
        Place of the image among the images of the run, from 0.
    may_pass : bool
        Whether a failure may pass by itself: a full disk, a network.
    """

    row: ImageRow
    pixels: Pixels | None = None
    place: int = 0
    may_pass: bool = False


def collect(
    total: int | None,
    finished: Generator[Finished, None, None],
    keep_results: bool,
    progress: RowProgress | None,
) -> list[ImageRow]:
    """Return the rows of a run, in the order of the images.

    Raises
    ------
    RunInterrupted
        If the run, or `progress`, raises `KeyboardInterrupt`.
    """
    rows = dict[int, ImageRow]()
    try:
        with closing(finished):
            for row, _, place, _ in finished:
                rows[place] = row if keep_results else replace(row, result=None)
                if progress:
                    progress(len(rows), total, rows[place])
    except KeyboardInterrupt:
        raise RunInterrupted(_in_order(rows)) from None
    return _in_order(rows)


def _in_order(rows: dict[int, ImageRow]) -> list[ImageRow]:
    return [rows[place] for place in sorted(rows)]
