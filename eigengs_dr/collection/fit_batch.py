"""Fits of several images of one size in one program.

The Gaussians of all images are one set, image after image, and the tiles of all images are one
list of tiles. A small image alone would wait for launches most of the time.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.interrupts import defer_interrupts
from ..backend.recording import exclusive
from ..fitting.descent import run
from ..fitting.fit import Fit, finish
from ..fitting.measure import Row, Shown, psnrs
from ..fitting.options import INITS, FitOptions
from ..fitting.refine import Refinement, trace_steps
from ..fitting.start import start_from_placement
from ..fitting.target import FitTarget, make_target
from ..gaussian.gaussians import Gaussians, like
from ..image.metrics import MAX_PSNR

MAX_SIDE = 256
"""Longer side, in pixels, of the largest images that are fitted in batches."""

MAX_GAUSSIANS = 1 << 15
"""Most Gaussians of an image of a batch: Dr.Jit adds up to so many numbers in one order, more in
parts that depend on how many sums there are."""

MAX_CUTOFF = 3.1
"""Largest cutoff at which no Gaussian of a fit is steep, see `eigengs_dr.raster.evaluate.is_steep`.
One steep Gaussian changes the arithmetic of all, so those of another image may not share it."""


def fits_in_batches(options: FitOptions, pixels: NDArray[np.float32]) -> bool:
    """Return whether `fit_batch` fits images like `pixels` (H, W, C) bit for bit as alone."""
    return (
        options.placement in INITS
        and options.method.solves
        and options.target_psnr is None
        and options.levels is None
        and options.cutoff <= MAX_CUTOFF
        and max(pixels.shape[:2]) <= MAX_SIDE
        and options.count_for(pixels) <= MAX_GAUSSIANS
    )


@exclusive()
def fit_batch(images: NDArray[np.float32], options: FitOptions) -> list[Fit]:
    """Fit several images of one size together.

    Parameters
    ----------
    images : ndarray of float32, shape (M, H, W, C)
        Images from `eigengs_dr.image.io.check_image`, of which `fits_in_batches` is true.
    options : FitOptions

    Returns
    -------
    list of Fit
        The results of `eigengs_dr.fit`, on llvm bit for bit: sums run in the same order, and no
        image changes the arithmetic of another. The seconds are an equal share of the whole time.

    Raises
    ------
    ValueError
        If the options do not fit the size of the images.
    KeyboardInterrupt
        After Ctrl-C or SIGTERM; there is no result then.
    """
    started = time.perf_counter()
    options.check_image(images[0])
    target = _stack([make_target(pixels, options.space) for pixels in images])
    problem = start_from_placement(target, options)
    start = problem.gaussians
    seconds_init = (time.perf_counter() - started) / len(images)
    found = [Refinement(start, [], 0, "iterations", {}) for _ in images]
    marks = trace_steps(options.iterations)

    def after(step: int, batch: Gaussians) -> bool:
        # A set with more Gaussians than asked for does not compare, see `refine`.
        if step in marks and len(batch) == len(start):
            figures = psnrs(batch, [Shown(images, options.space)])[0].T.tolist()
            seconds = (time.perf_counter() - started) / len(images)
            for k, (ycbcr, rgb) in enumerate(figures):
                if found[k].stopped != "exact":
                    row = {"seconds": seconds, "psnr_ycbcr": ycbcr, "psnr_rgb": rgb}
                    found[k] = _judge(found[k], batch, {"iteration": step, **row})
        if step % 10 == 0:
            dr.sync_thread()
        if interrupted():
            raise KeyboardInterrupt
        return all(one.stopped == "exact" for one in found)

    with defer_interrupts() as interrupted:
        run(problem, options.method.schedule, options.iterations, after)
    batches = {id(one.gaussians): one.gaussians for one in found}
    sets = {name: _split(batch) for name, batch in batches.items()}
    fits = [
        finish(one, sets[id(one.gaussians)][k], None, started, seconds_init)
        for k, one in enumerate(found)
    ]
    share = (time.perf_counter() - started) / len(images)
    return [replace(fit, seconds=share) for fit in fits]


def _judge(found: Refinement, batch: Gaussians, row: Row) -> Refinement:
    """Add a row to the trace of an image, and keep the batch with its best set."""
    found.trace.append(row)
    if row["psnr_ycbcr"] > found.row.get("psnr_ycbcr", -math.inf):
        found = found._replace(gaussians=batch, row=row)
    stopped = "exact" if row["psnr_ycbcr"] > MAX_PSNR else found.stopped
    return found._replace(iterations=row["iteration"], stopped=stopped)


def _stack(targets: list[FitTarget]) -> FitTarget:
    """Return the targets of all images as one, of arrays (M, H, W, C)."""
    values = np.stack([target.values for target in targets])
    shown = values
    if targets[0].shown is not targets[0].values:
        shown = np.stack([target.shown for target in targets])
    weights = [target.weight for target in targets if target.weight is not None]
    pixels = np.stack([target.pixels for target in targets])
    return FitTarget(pixels, values, shown, np.stack(weights) if weights else None)


def _split(batch: Gaussians) -> list[Gaussians]:
    """Return the sets of all images."""
    backgrounds = np.stack([row.numpy() for row in batch.background], axis=1)
    parts = (
        np.split(np.stack([row.numpy() for row in getattr(batch, name)], axis=1), len(backgrounds))
        for name in _OWN
    )
    return [like(batch, *arrays) for arrays in zip(*parts, backgrounds, strict=True)]


_OWN = ("mean", "factor", "color")
"""The arrays that hold the Gaussians of image after image."""
