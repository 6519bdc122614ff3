"""Fits of several images of one size in one program.

The Gaussians of all images are one set, image after image, and the tiles of all images are one
list of tiles. A small image alone would wait for launches most of the time.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of, upload
from ..backend.feedback import defer_interrupts
from ..backend.recording import exclusive
from ..fitting.density_control import relocate
from ..fitting.descent import FitProblem, run
from ..fitting.fit import Fit
from ..fitting.options import FitOptions
from ..fitting.placement.adaptive import density_for_error, place_adaptive, squared_error
from ..fitting.refine import trace_steps
from ..fitting.schedule import Relocation
from ..fitting.solvers.conjugate_gradient import solve_batch
from ..fitting.start import PLACEMENTS
from ..fitting.target import make_target
from ..gaussian.gaussians import Gaussians, like
from ..image.color import from_sum, to_picture
from ..image.metrics import MAX_PSNR, float_space, psnr
from ..raster.kernels import forward
from ..raster.parameters import kernel_parameters, kernel_radius, pack_parameters
from ..raster.render import batch_from_tiles, bin_gaussians, decode_parameters

Images = NDArray[np.float32]


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
        options.placement in PLACEMENTS
        and options.method.solves
        and options.target_psnr is None
        and options.levels is None
        and options.cutoff <= MAX_CUTOFF
        and max(pixels.shape[:2]) <= MAX_SIDE
        and options.count_for(pixels) <= MAX_GAUSSIANS
    )


@exclusive()
def fit_batch(images: Images, options: FitOptions) -> list[Fit]:
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
    schedule, marks = options.method.schedule, trace_steps(options.iterations)
    problem = _start(images, options)
    seconds_init = time.perf_counter() - started
    records = [_Record() for _ in images]

    def after(step: int, reached: Gaussians) -> bool:
        # A set with more Gaussians than asked for does not compare, see `refine`.
        if step in marks and len(reached) == len(problem.gaussians):
            seconds = (time.perf_counter() - started) / len(images)
            shown = _pictures(reached, len(images))
            for record, picture, pixels in zip(records, shown, images, strict=True):
                if record.stopped != "exact":
                    record.judge(step, seconds, reached, picture, pixels)
            if all(record.stopped == "exact" for record in records):
                return True
        if step % 10 == 0:
            dr.sync_thread()
        if interrupted():
            raise KeyboardInterrupt
        return False

    with defer_interrupts() as interrupted:
        run(problem, schedule, options.iterations, after)
    share = (time.perf_counter() - started) / len(images)
    return _results(records, share, seconds_init / len(images))


@dataclass
class _Record:
    """The trace and the best set of one image."""

    trace: list[dict[str, Any]] = field(default_factory=list)
    highest: float = -math.inf
    psnr_rgb: float = -math.inf
    best: Gaussians | None = None
    picture: Images | None = None
    stopped: str = "iterations"

    def judge(
        self,
        step: int,
        seconds: float,
        reached: Gaussians,
        shown: Images,
        pixels: Images,
    ) -> None:
        """Add a row to the trace, and keep the best set."""
        figures = {
            "iteration": step,
            "seconds": seconds,
            "psnr_ycbcr": psnr(shown, pixels, space=float_space(reached.space)),
            "psnr_rgb": psnr(shown, pixels, space="rgb"),
        }
        self.trace.append(figures)
        if figures["psnr_ycbcr"] > self.highest:
            self.best, self.highest, self.picture = reached, figures["psnr_ycbcr"], shown
            self.psnr_rgb = figures["psnr_rgb"]
        if figures["psnr_ycbcr"] > MAX_PSNR:
            self.stopped = "exact"


def _start(images: Images, options: FitOptions) -> FitProblem:
    """Place the Gaussians of every image, and solve for the colours of all of them."""
    place = PLACEMENTS[str(options.placement)]
    targets = [make_target(pixels, options.space) for pixels in images]
    shown = [target.shown for target in targets]
    count = options.count_for(images[0])
    placed = [place(s, count, np.random.default_rng(options.seed)) for s in shown]
    values = np.stack([t.values for t in targets])
    weights = [t.weight for t in targets if t.weight is not None]
    weight = np.stack(weights) if weights else None
    like = _stack(placed, values.shape, options)
    start = solve_batch(like, values, options.solve_steps).gaussians
    return FitProblem(start, values, weight, _BatchControl(shown, values, weight, options))


def _stack(placed: list, shape: tuple[int, ...], options: FitOptions) -> Gaussians:
    """Return the Gaussians of all images as one set, without colours."""
    mean, factor = (np.concatenate(parts) for parts in zip(*placed, strict=True))
    return Gaussians.from_arrays(
        mean,
        factor,
        np.zeros((len(mean), shape[3]), np.float32),
        size=(shape[2], shape[1]),
        space=options.space,
        backend=options.backend,
        cutoff=options.cutoff,
    ).bounded()


class _BatchControl(NamedTuple):
    """The density control of all images; see `eigengs_dr.fitting.descent.Control`."""

    shown: list[Images]
    values: Images
    weight: Images | None
    options: FitOptions

    @property
    def redistributes(self) -> bool:
        """Whether all sets are placed anew after a first phase."""
        return self.options.placement == "adaptive"

    def redistribute(self, gaussians: Gaussians, count: int) -> Gaussians:
        """Place all sets anew, as `redistribute` does for one."""
        shown, values, weight, options = self
        missed = values - _sum(replace(gaussians, space="data"), len(values))
        means = _numpy(gaussians.mean).reshape(len(values), -1, 2)
        placed = []
        for k, image in enumerate(shown):
            error = squared_error(missed[k], None if weight is None else weight[k])
            density = density_for_error(means[k], error)
            placed.append(place_adaptive(image, count // len(values), density=density))
        return solve_batch(
            _stack(placed, values.shape, options), values, options.solve_steps
        ).gaussians

    def relocate(self, gaussians: Gaussians, how: Relocation) -> Gaussians:
        """Relocate in every image, as `eigengs_dr.fitting.density_control.relocate` does."""
        _, values, weight, _ = self
        weights = [None] * len(values) if weight is None else list(weight)
        arrays = _arrays(gaussians)
        moved = [
            relocate(_cut(arrays, k, gaussians), how, values[k], weights[k]).to_arrays()
            for k in range(len(values))
        ]
        mean, factor, color = (np.concatenate([m[name] for m in moved]) for name in _OWN)
        stacked = like(gaussians, mean, factor, color)
        types = types_of(gaussians.mean)
        rows = np.stack([m["background"] for m in moved], axis=1)
        return replace(stacked, background=types.FloatX([upload(types.Float, row) for row in rows]))


_OWN = ("mean", "factor", "color")
"""The arrays of a batch that hold the Gaussians of image after image."""


def _arrays(gaussians: Gaussians) -> dict[str, NDArray[Any]]:
    """Return the arrays of a batch; the background has a row for each image."""
    return {name: _numpy(getattr(gaussians, name)) for name in (*_OWN, "background")}


def _cut(arrays: dict[str, NDArray[Any]], k: int, batch: Gaussians) -> Gaussians:
    """Return the Gaussians of image k out of the `_arrays` of a batch."""
    count = len(arrays["mean"]) // len(arrays["background"])
    mean, factor, color = (arrays[name][k * count : (k + 1) * count] for name in _OWN)
    return like(batch, mean, factor, color, arrays["background"][k])


def _pictures(gaussians: Gaussians, images: int) -> Images:
    """Render all images for display: as `eigengs_dr.raster.render.picture_of` does one."""
    shown = _sum(gaussians, images)
    return to_picture(gaussians.space, from_sum(gaussians.space, shown))


def _sum(gaussians: Gaussians, images: int) -> Images:
    """Render all images: RGB for a set in YCbCr."""
    plain = gaussians.space == "data"
    parameters = kernel_parameters(gaussians) if plain else decode_parameters(gaussians)
    lists = bin_gaussians(gaussians, adjoint=False, images=images)
    packed = pack_parameters([*parameters.shape, *parameters.color])
    radius = kernel_radius(gaussians.cutoff)
    image = forward(packed, parameters.background, lists, radius)
    return batch_from_tiles(image, lists.grid, len(parameters.background))


def _numpy(rows: Any) -> NDArray[Any]:
    """Return nested Dr.Jit arrays as the columns of a NumPy array."""
    return np.stack([row.numpy() for row in rows], axis=1)


def _results(records: list[_Record], seconds: float, seconds_init: float) -> list[Fit]:
    """Cut the best set of every image out of the sets of all images."""
    arrays: dict[int, dict[str, NDArray[Any]]] = {}
    results = []
    for k, record in enumerate(records):
        best, picture = record.best, record.picture
        assert best is not None and picture is not None
        if id(best) not in arrays:  # `records` keeps every set, so that an id stays its own
            arrays[id(best)] = _arrays(best)
        gaussians = _cut(arrays[id(best)], k, best)
        results.append(
            Fit(
                gaussians=gaussians,
                trace=record.trace,
                image=picture,
                seconds=seconds,
                seconds_init=seconds_init,
                iterations=record.trace[-1]["iteration"],
                stopped=record.stopped,
                psnr_ycbcr=record.highest,
                psnr_rgb=record.psnr_rgb,
            )
        )
    return results
