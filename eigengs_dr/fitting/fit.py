"""`fit`: one image to Gaussians, from the placement of splats to the refined set."""

from __future__ import annotations

import os
import time
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.interrupt import defer_interrupts
from ..eigenbasis.eigengs import EigenGS
from ..gaussian.gaussians import Gaussians
from ..image.color import SPACES
from ..image.io import check_image
from ..raster.parameters import NUM_SHAPE_PARAMS
from ..raster.render import picture_of
from .initializers import INITS, initialize
from .presets import PRESETS
from .refine import MAX_PSNR, FitProgress, measure, refine
from .search import search_count

PIXELS_PER_FIRST_GAUSSIAN = 64
"""Pixels a splat of the first try, where the number of splats is searched for."""


class Fit(NamedTuple):
    """Result of `fit`.

    Attributes
    ----------
    gaussians : Gaussians
    trace : list of dict
        Rows with iteration, seconds, psnr_ycbcr, psnr_rgb, and gaussians where their number was
        searched for; row 0 is before refinement. Seconds
        count from the call of `fit`: placement, upload and colour solve are in them, and what it
        takes to compute the rows. For color "data" psnr_rgb is that of the data, clamped and
        rounded to 8 bits, and psnr_ycbcr that of the data as it is: no YCbCr is in it.
    image : ndarray of float32, shape (H, W, 3), or (H, W, 1) for data of one channel
        The picture that the set makes: RGB, not clamped; of linear light coded as sRGB, its light
        clamped at 0; or the data.
    seconds, seconds_init : float
        All of it, and the part before refinement.
    iterations : int
        Steps of refinement taken.
    stopped : str
        Why it ended: "iterations", "plateau", "interrupted"; or, where a PSNR was asked for, "met"
        or "out of reach".
    mean_image : ndarray of float32, shape (H, W, 3), or None
        What renderings of the set are added to, RGB: the preset "eigengs" keeps the mean image of
        its basis as pixels. It is in `image` already.
    """

    gaussians: Gaussians
    trace: list[dict[str, Any]]
    image: NDArray[np.float32]
    seconds: float
    seconds_init: float
    iterations: int
    stopped: str
    mean_image: NDArray[np.float32] | None = None


def fit(
    image: ArrayLike,
    gaussians: int | None = None,
    iterations: int = 1000,
    init: str = "auto",
    basis: str | os.PathLike[str] | EigenGS = "natural",
    preset: str = "default",
    solve_steps: int = 10,
    color: str = "ycbcr",
    seed: int = 0,
    backend: str | None = None,
    progress: FitProgress | None = None,
    target_psnr: float | None = None,
    target_space: str = "ycbcr",
    max_gaussians: int | None = None,
) -> Fit:
    """Fit Gaussians to an image: so many, or the fewest that reach a quality.

    Splats are placed, their colours solved for, and all parameters refined by gradient descent on
    the squared error.

    Parameters
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
        RGB or grey, float in [0, 1] or unsigned integers.
    gaussians : int, optional
        Number of splats, at most one a pixel. By default that of the basis where it places them,
        else 5000 or one a pixel if these are fewer.
    iterations : int, optional
        Most steps of refinement; 0 keeps what the colour solve gave.
    init : {"auto", "adaptive", "grid", "random", "eigen"}, optional
        Where splats start. "auto" is what the preset does best with: "adaptive" for "default".
    basis : str, path-like or EigenGS, optional
        What "eigen" starts from: the name of a basis of this package, the file of another, or a
        model.
    preset : {"default", "gaussianimage", "eigengs"}, optional
        The method, see `eigengs_dr.fitting.presets`.
    solve_steps : int, optional
        Steps of conjugate gradients in the colour solve; "eigen" needs none at its own size.
    color : {"ycbcr", "rgb", "linear", "data"}, optional
        Space of the colours and of the squared error. "linear" decodes sRGB, so that the Gaussians
        sum to linear light, as textures need it; errors weigh more in the dark. "data" takes the
        channels as they are, one or three (roughness, normals, heights).
    seed : int, optional
        Of the random numbers; one seed gives one result on one machine and backend.
    backend : {"llvm", "cuda"}, optional
        By default "cuda" where there is a GPU.
    progress : callable, optional
        ``progress(iteration, iterations, row)`` every 10 steps, with the last row of the trace.
    target_psnr : float, optional
        Instead of `gaussians`: decibels to reach with as few splats as possible, see
        `eigengs_dr.fitting.search`. `iterations` are then those of a fit of a known number; the
        search takes up to about twice as many.
    target_space : {"ycbcr", "rgb"}, optional
        Where `target_psnr` is measured, as psnr_ycbcr or as psnr_rgb.
    max_gaussians : int, optional
        Most splats for `target_psnr`; by default as many as have as many parameters as the image
        has numbers, 3 for 8 pixels in colour.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If the image is unusable or an argument out of range; one line.
    BackendError
        If the backend is not there.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> result = eg.fit(eg.sample("coffee")[:64, :64], gaussians=300, iterations=20)
    >>> len(result.gaussians), result.image.shape
    (300, (64, 64, 3))
    """
    started = time.perf_counter()
    pixels = check_image(image, keep_grey=color == "data")
    check_options(pixels, gaussians, iterations, init, preset, solve_steps, color, seed)
    method = PRESETS[preset]
    if target_psnr is None and (max_gaussians is not None or target_space != "ycbcr"):
        raise ValueError("max_gaussians and target_space belong to target_psnr; give it, too")
    if target_psnr is not None:
        _check_target(gaussians, init, preset, target_psnr, target_space, pixels, max_gaussians)
        most = max_gaussians or max_gaussians_for(pixels)
        gaussians = min(
            most, max(1, pixels.shape[0] * pixels.shape[1] // PIXELS_PER_FIRST_GAUSSIAN)
        )
    with defer_interrupts() as interrupted:
        start = initialize(
            pixels, gaussians, init, basis, method, solve_steps, color, seed, backend=backend
        )
        seconds_init = time.perf_counter() - started
        if target_psnr is None:
            refined = refine(
                start.gaussians,
                start.target,
                pixels,
                method.schedule,
                iterations,
                started=started,
                base_image=start.base_image,
                weight=start.weight,
                redistribute=start.redistribute,
                progress=progress,
                interrupted=interrupted,
            )
        else:
            refined = search_count(
                start,
                partial(measure, image=pixels, started=started),
                f"psnr_{target_space}",
                target_psnr,
                most,
                method.schedule,
                iterations,
                progress=progress,
                interrupted=interrupted,
            )
    rendered = picture_of(refined.gaussians)
    return Fit(
        gaussians=refined.gaussians,
        trace=refined.trace,
        image=rendered if start.base_image is None else rendered + start.base_image,
        seconds=time.perf_counter() - started,
        seconds_init=seconds_init,
        iterations=refined.iterations,
        stopped=refined.stopped,
        mean_image=start.base_image,
    )


def check_options(
    pixels: NDArray[np.float32],
    gaussians: int | None,
    iterations: int,
    init: str = "auto",
    preset: str = "default",
    solve_steps: int = 0,
    color: str = "ycbcr",
    seed: int = 0,
) -> None:
    """Raise ValueError for the first argument of `fit` that is out of range."""
    counts = {"iterations": iterations, "solve_steps": solve_steps, "seed": seed}
    if gaussians is not None:
        counts["gaussians"] = gaussians
    for name, count in counts.items():
        if not isinstance(count, (int, np.integer)) or count < 0:
            raise ValueError(f"{name} is {count!r}; it must be at least 0, and whole")
    height, width = pixels.shape[:2]
    if gaussians is not None and not 1 <= gaussians <= width * height:
        raise ValueError(
            f"gaussians is {gaussians}; an image of {width}x{height} takes 1 to {width * height}"
        )
    for name, value, known in (
        ("init", init, INITS),
        ("preset", preset, tuple(PRESETS)),
        ("color", color, SPACES),
    ):
        if value not in known:
            raise ValueError(f"{name} {value!r} is unknown; use one of {', '.join(known)}")
    if PRESETS[preset].mean == "dense" and init not in ("auto", "eigen"):
        raise ValueError(f"preset {preset!r} starts from a basis; use init 'auto', not {init!r}")


def max_gaussians_for(pixels: NDArray[np.float32]) -> int:
    """Splats that have as many parameters as an image has numbers; at least one."""
    channels = pixels.shape[2]
    return max(1, pixels.size // (NUM_SHAPE_PARAMS + channels))


def _check_target(
    gaussians: int | None,
    init: str,
    preset: str,
    target_psnr: float,
    target_space: str,
    pixels: NDArray[np.float32],
    max_gaussians: int | None,
) -> None:
    """Raise ValueError where a search for the fewest splats is asked for what it cannot do."""
    if gaussians is not None:
        raise ValueError("gaussians and target_psnr exclude each other; give one of them")
    if preset != "default" or init not in ("auto", "adaptive"):
        raise ValueError(
            f"target_psnr works with preset 'default' and init 'adaptive', not with {preset!r} and "
            f"{init!r}"
        )
    if not 0 < target_psnr <= MAX_PSNR:
        raise ValueError(
            f"target_psnr is {target_psnr}; it must be above 0 and at most {MAX_PSNR:g}"
        )
    if target_space not in ("ycbcr", "rgb"):
        raise ValueError(f"target_space {target_space!r} is unknown; use ycbcr or rgb")
    height, width = pixels.shape[:2]
    if max_gaussians is not None and not (
        isinstance(max_gaussians, (int, np.integer)) and 1 <= max_gaussians <= width * height
    ):
        raise ValueError(
            f"max_gaussians is {max_gaussians}; an image of {width}x{height} takes 1 to "
            f"{width * height}"
        )
