"""The function `fit`, which fits Gaussians to one image."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.feedback import defer_interrupts, shows_progress, to_html
from ..backend.recording import exclusive
from ..gaussian.file import CUTOFF, FitFigures, write
from ..gaussian.gaussians import Gaussians
from ..image.metrics import float_space, target_key
from ..raster.render import picture_of
from .descent import FitProblem
from .options import FitOptions, Start, named_options
from .refine import FitProgress, Refinement, measure, refine
from .search import search_count
from .start import initialize, load_start, mean_picture
from .target import in_unit, read_pixels, unit_of


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of `fit`.

    Attributes
    ----------
    gaussians : Gaussians
        The fitted set.
    trace : list of dict
        Rows with the keys iteration, seconds, psnr_ycbcr and psnr_rgb. A search for the number of
        Gaussians adds the key gaussians. Row 0 shows the set before refinement. Seconds count from
        the call of `fit`; they include placement, upload, the colour solve and the measurements.
        A descent has more Gaussians than asked for in its first two thirds, see
        `eigengs_dr.fitting.schedule.surplus_for`; those sets have no rows.
        With space "data" or "normal", psnr_rgb is the PSNR of the data after clamping and rounding
        to 8 bits, and psnr_ycbcr the PSNR of the unchanged data; for values above 1.5, the largest
        of them is the peak. With space "radiance" or "log", psnr_ycbcr is in PU21, see
        `eigengs_dr.psnr`.
    image : ndarray of float32, shape (H, W, 3), or (H, W, 1) for data of one channel
        The rendering of the set: RGB without clamping; for light, sRGB clamped at 0; or the data.
    seconds, seconds_init : float
        The whole time, and the time before refinement.
    iterations : int
        Number of refinement steps.
    stopped : str
        Why the fit ended: "iterations", "plateau" or "interrupted"; a search for the number of
        Gaussians ends with "met", "out of reach" or "interrupted".
    mean_image : ndarray of float32, shape (H, W, 3), or None
        RGB image to add to renderings of the set. The preset "eigengs" keeps the mean image of the
        model as pixels. The attribute `image` includes the mean image.
    psnr_ycbcr, psnr_rgb : float
        PSNR of the set in dB, from its row of the trace.
    source : str
        Name of the image, if it was a file or a URL.
    """

    gaussians: Gaussians
    trace: list[dict[str, Any]] = field(repr=False)
    image: NDArray[np.float32] = field(repr=False)
    seconds: float
    seconds_init: float = field(repr=False)
    iterations: int
    stopped: str
    mean_image: NDArray[np.float32] | None = field(default=None, repr=False)
    psnr_ycbcr: float = math.nan
    psnr_rgb: float = math.nan
    source: str = field(default="", repr=False)

    def __repr__(self) -> str:
        space = float_space(self.gaussians.space)
        return (
            f"Fit({len(self.gaussians)} Gaussians, "
            f"{self.image.shape[1]}x{self.image.shape[0]} pixels, {self.iterations} iterations, "
            f"psnr_{space}={self.psnr_ycbcr:.2f}, psnr_rgb={self.psnr_rgb:.2f}, "
            f"seconds={self.seconds:.2f}, stopped={self.stopped!r})"
        )

    _repr_html_ = to_html  # what a notebook shows

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set with its PSNR, steps and source; see `eigengs_dr.Gaussians.save`."""
        figures = FitFigures(self.psnr_ycbcr, self.psnr_rgb, self.iterations, self.source)
        write(path, self.gaussians.data(), figures)


class FitInterrupted(KeyboardInterrupt):
    """The error of a fit that Ctrl-C or SIGTERM interrupted.

    Attributes
    ----------
    result : Fit or MaterialFit
        The best set so far.
    """

    def __init__(self, result: Any) -> None:
        super().__init__("the fit was interrupted; .result holds the best set so far")
        self.result = result


@named_options
@shows_progress
def fit(
    image: ArrayLike | os.PathLike[str],
    gaussians: int | None = None,
    iterations: int = 1000,
    init: str = "auto",
    start: Start | None = None,
    preset: str = "default",
    solve_steps: int = 10,
    space: str = "ycbcr",
    seed: int = 0,
    backend: str | None = None,
    progress: Any = None,
    target_psnr: float | None = None,
    target_space: str = "rgb",
    max_gaussians: int | None = None,
    cutoff: float = CUTOFF,
    encoding: str | None = None,
) -> Fit:
    """Fit an image by a given number of Gaussians, or by as few as a target PSNR needs.

    Parameters
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W); or path-like or URL
        A file, see `eigengs_dr.load_image`, or pixels, see `eigengs_dr.image.io.check_image`.
    gaussians : int, optional
        Number of Gaussians, at most one per pixel. By default 5000, or one per pixel for smaller
        images; with a start, the number of its Gaussians.
    iterations : int, optional
        Largest number of refinement steps; 0 keeps the colours of the solve.
    init : {"auto", "adaptive", "grid", "random"}, optional
        Placement by the image alone. "auto" is that of the preset: "adaptive" for "default".
    start : Gaussians, Fit, path-like or EigenGS, optional
        Instead of a placement, Gaussians to start from, scaled to the size of the image: the set of
        the frame before of a film, a file, ``model.encode(image)``. A model stands for the set that
        it makes of the image, which suits many images.
    preset : {"default", "gaussianimage", "eigengs"}, optional
        The method, see `eigengs_dr.fitting.options`; "eigengs" needs a model as the start.
    solve_steps : int, optional
        Steps of conjugate gradients in the colour solve. With a start they go on from its colours;
        those of a model need none, unless the image and the model differ in size.
    space : {"ycbcr", "rgb", "linear", "radiance", "log", "normal", "data"}, optional
        Space of the colours and of the squared error. "linear" decodes sRGB: the Gaussians sum to
        linear light, as textures need it, and errors weigh more in the dark. "data" uses one or
        three channels unchanged (roughness, heights). "normal" uses the codes ``(n + 1) / 2`` of a
        normal map; renderings have normals of length 1. "radiance" is "linear" without an
        upper bound. "log" suits light above 1 best: the Gaussians sum to logarithms of light, see
        `eigengs_dr.image.radiance.to_log`. For an image of light above 1, "linear" becomes
        "radiance", and "ycbcr" and "rgb" become "log": a texture would clamp their sums.
    seed : int, optional
        Seed of the random numbers. Only the placement "random" and presets without a colour
        solve use random numbers; the preset "default" gives one result for all seeds.
    backend : {"llvm", "cuda"}, optional
        By default "cuda" if there is a GPU.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        Called every 10 steps as ``progress(iteration, iterations, row)`` with the last row of the
        trace, or a row of a set with more Gaussians than asked for.
    target_psnr : float, optional
        PSNR in dB to reach with as few Gaussians as possible; excludes `gaussians`. The search
        takes up to about twice `iterations` steps, see `eigengs_dr.fitting.search`.
    target_space : {"rgb", "ycbcr"}, optional
        Whether `target_psnr` is a psnr_rgb or a psnr_ycbcr of an image. Data, normals and light
        above 1 have one PSNR alone, see `eigengs_dr.image.metrics.float_space`.
    max_gaussians : int, optional
        Largest number of Gaussians for `target_psnr`. By default the Gaussians have at most as
        many parameters as the image has numbers: 3 Gaussians for 8 pixels in colour.
    cutoff : float, optional
        Radius of a Gaussian in standard deviations, in (0, 12]; the set keeps it.
    encoding : {"srgb", "linear"}, optional
        What the pixels of the image are: sRGB codes, or light as in renderings. By default what the
        image says (`eigengs_dr.load_image` marks light, a ``mitsuba.Bitmap`` has a flag), else
        "srgb". Data are used as they are.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If the image is unusable or an argument is out of range.
    BackendError
        If the backend is not available.
    FitInterrupted
        After Ctrl-C or SIGTERM: a `KeyboardInterrupt` that holds the best set so far.

    Notes
    -----
    On one machine and backend, one seed gives the same result bit for bit.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> result = eg.fit(eg.sample("coffee")[:64, :64], gaussians=300, iterations=20)
    >>> len(result.gaussians), result.image.shape
    (300, (64, 64, 3))
    """
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        init=init,
        start=start,
        preset=preset,
        solve_steps=solve_steps,
        space=space,
        seed=seed,
        backend=backend,
        cutoff=cutoff,
        target_psnr=target_psnr,
        target_space=target_space,
        max_gaussians=max_gaussians,
        encoding=encoding,
    )
    result = fit_image(image, options, progress)
    if not isinstance(image, (str, os.PathLike)):
        return result
    return replace(result, source=os.path.basename(image))


@exclusive()
def fit_image(image: Any, options: FitOptions, progress: FitProgress | None = None) -> Fit:
    """Fit an image with the options of one record; see `fit` for results and errors."""
    started = time.perf_counter()
    pixels, options = read_pixels(image, options)
    options.check_image(pixels)
    unit = unit_of(pixels, options.space)
    if unit != 1:
        pixels = pixels / np.float32(unit)
    if options.start is not None:
        start = load_start(options.start, options.backend)
        whole = in_unit(start, 1 / unit) if isinstance(start, Gaussians) else start
        options = replace(options, start=whole)
    mean_image = mean_picture(options, pixels.shape[1], pixels.shape[0])
    with defer_interrupts() as interrupted:
        problem = initialize(pixels, options.first_try(pixels))
        seconds_init = time.perf_counter() - started
        if options.target_psnr is None:
            found = refine(
                problem,
                pixels,
                options.method.schedule,
                options.iterations,
                started=started,
                progress=progress,
                interrupted=interrupted,
                score=partial(measure, image=pixels, started=started, base_image=mean_image),
            )
        else:
            found = _search(problem, pixels, options, started, progress, interrupted)
    return finish(found, in_unit(found.gaussians, unit), mean_image, started, seconds_init)


def _search(
    start: FitProblem,
    pixels: NDArray[np.float32],
    options: FitOptions,
    started: float,
    progress: FitProgress | None,
    interrupted: Callable[[], bool],
) -> Refinement:
    """Search for the smallest number of Gaussians that reaches the target PSNR."""
    assert options.target_psnr is not None
    return search_count(
        start,
        partial(measure, image=pixels, started=started),
        target_key(start.gaussians.space, options.target_space),
        options.target_psnr,
        options.most_for(pixels),
        options.method.schedule,
        options.iterations,
        progress=progress,
        interrupted=interrupted,
    )


def finish(
    found: Refinement,
    gaussians: Gaussians,
    base_image: NDArray[np.float32] | None,
    started: float,
    seconds_init: float,
) -> Fit:
    """Render the result of a refinement and return it as a `Fit`.

    Raises
    ------
    FitInterrupted
        If the refinement was interrupted.
    """
    rendered = picture_of(gaussians)
    result = Fit(
        gaussians=gaussians,
        trace=found.trace,
        image=rendered if base_image is None else rendered + base_image,
        seconds=time.perf_counter() - started,
        seconds_init=seconds_init,
        iterations=found.iterations,
        stopped=found.stopped,
        mean_image=base_image,
        psnr_ycbcr=found.row["psnr_ycbcr"],
        psnr_rgb=found.row["psnr_rgb"],
    )
    if found.stopped == "interrupted":
        raise FitInterrupted(result)
    return result
