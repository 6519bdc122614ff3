"""`fit`: one image to Gaussians, from the placement of splats to the refined set."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import place as places
from .adaptive import adaptive
from .color import rgb_to_ycbcr
from .gaussians import Gaussians
from .images import check_image
from .interrupt import deferred
from .presets import PRESETS, Preset
from .refine import Progress, refine
from .rendering import render
from .solve import solve

INITS = {"random": places.random, "grid": places.grid, "adaptive": adaptive}
"""Initialisers by name."""


class Fit(NamedTuple):
    """Result of `fit`.

    Attributes
    ----------
    gaussians : Gaussians
    trace : list of dict
        Rows with iteration, seconds, psnr_ycbcr, psnr_rgb; row 0 is before refinement. Seconds
        count from the call of `fit`: placement, upload and colour solve are in them, and what it
        takes to compute the rows.
    image : ndarray of float32, shape (H, W, 3)
        The picture that the set makes: RGB, not clamped.
    seconds, seconds_init : float
        All of it, and the part before refinement.
    iterations : int
        Steps of refinement taken.
    stopped : str
        Why it ended: "iterations", "plateau" or "interrupted".
    """

    gaussians: Gaussians
    trace: list[dict[str, Any]]
    image: NDArray[np.float32]
    seconds: float
    seconds_init: float
    iterations: int
    stopped: str


def fit(
    image: ArrayLike,
    gaussians: int = 5000,
    iterations: int = 1000,
    init: str = "auto",
    preset: str = "default",
    solve_steps: int = 10,
    color: str = "ycbcr",
    seed: int = 0,
    backend: str | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit Gaussians to an image.

    Splats are placed, their colours solved for, and all parameters refined by gradient descent on
    the squared error.

    Parameters
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
        RGB or grey, float in [0, 1] or unsigned integers.
    gaussians : int, optional
        Number of splats, at most one a pixel.
    iterations : int, optional
        Most steps of refinement; 0 keeps what the colour solve gave.
    init : {"auto", "adaptive", "grid", "random"}, optional
        Where splats start. "auto" is what the preset does best with.
    preset : {"default", "gaussianimage"}, optional
        The method, see `eigengs_dr.presets`.
    solve_steps : int, optional
        Steps of conjugate gradients in the colour solve.
    color : {"ycbcr", "rgb"}, optional
        Space of the colours and of the squared error.
    seed : int, optional
        Of the random numbers; one seed gives one result on one machine and backend.
    backend : {"llvm", "cuda"}, optional
        By default "cuda" where there is a GPU.
    progress : callable, optional
        ``progress(iteration, iterations, row)`` every 10 steps, with the last row of the trace.

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
    pixels = check_image(image)
    _check(pixels, gaussians, iterations, init, preset, solve_steps, color, seed)
    method = PRESETS[preset]
    target = rgb_to_ycbcr(pixels) if color == "ycbcr" else pixels
    with deferred() as interrupted:
        place = INITS[method.init if init == "auto" else init]
        start = _start(target, gaussians, place, method, solve_steps, color, seed, backend)
        seconds_init = time.perf_counter() - started
        refined = refine(
            start,
            target,
            pixels,
            method.schedule,
            iterations,
            started=started,
            progress=progress,
            interrupted=interrupted,
        )
    return Fit(
        gaussians=refined.gaussians,
        trace=refined.trace,
        image=render(refined.gaussians).numpy(),
        seconds=time.perf_counter() - started,
        seconds_init=seconds_init,
        iterations=refined.iterations,
        stopped=refined.stopped,
    )


def _start(
    target: NDArray[np.float32],
    gaussians: int,
    place: Callable[..., Any],
    method: Preset,
    solve_steps: int,
    color: str,
    seed: int,
    backend: str | None,
) -> Gaussians:
    """Place splats and give them colours."""
    generator = np.random.default_rng(seed)
    mean, factor = place(target, gaussians, generator)
    colors = np.zeros((gaussians, 3)) if method.solves else generator.uniform(0, 1, (gaussians, 3))
    size = (target.shape[1], target.shape[0])
    start = Gaussians.from_arrays(mean, factor, colors, size=size, space=color, backend=backend)
    start = start.bounded()
    return solve(start, target, solve_steps).gaussians if method.solves else start


def _check(
    pixels: NDArray[np.float32],
    gaussians: int,
    iterations: int,
    init: str,
    preset: str,
    solve_steps: int,
    color: str,
    seed: int,
) -> None:
    """Raise ValueError for the first argument that is out of range."""
    counts = {"gaussians": gaussians, "iterations": iterations, "solve_steps": solve_steps}
    for name, count in {**counts, "seed": seed}.items():
        if not isinstance(count, (int, np.integer)) or count < 0:
            raise ValueError(f"{name} is {count!r}; it must be at least 0, and whole")
    height, width = pixels.shape[:2]
    if not 1 <= gaussians <= width * height:
        raise ValueError(
            f"gaussians is {gaussians}; an image of {width}x{height} takes 1 to {width * height}"
        )
    for name, value, known in (
        ("init", init, ("auto", *INITS)),
        ("preset", preset, tuple(PRESETS)),
        ("color", color, ("ycbcr", "rgb")),
    ):
        if value not in known:
            raise ValueError(f"{name} {value!r} is unknown; use one of {', '.join(known)}")
