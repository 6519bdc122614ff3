"""What a model is worth on images that it was not trained on, and as the start of a fit."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from eigengs_bench.harness.store import Progress
from eigengs_bench.harness.timing import Image
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.options import PRESETS
from eigengs_dr.fitting.refine import refine
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import render

SOLVE_STEPS = 10  # steps of conjugate gradients, as in `eigengs_dr.fit`
PLACED = ("grid", "adaptive")  # starts that look at the image alone


def run(
    model: EigenGS,
    images: Sequence[Image],
    iterations: int = 100,
    progress: Progress = lambda *_: None,
) -> dict[str, float]:
    """Compare starts of a fit: by a model, and by the image alone, with as many Gaussians.

    For every start S, ``S_psnr_ycbcr`` and ``S_psnr_rgb`` in dB are means over the images, and
    ``S_seconds`` medians, the start included. S is "projected" or "exact" (`EigenGS.encode`),
    "solved" (projected, then conjugate gradients), or one of `PLACED`. ``encode_S_ms`` are medians
    of `EigenGS.encode` alone. With 0 iterations the starts themselves are measured.
    """
    for colors in ("exact", "projected"):  # factors, and kernels
        model.encode(images[0], colors)
    rows: dict[str, list[float]] = {}
    for done, image in enumerate(images, 1):
        for name, value in _measure(model, image, iterations):
            rows.setdefault(name, []).append(value)
        progress("eigen", done, len(images))
    return {
        name: float(np.mean(values) if "psnr" in name else np.median(values))
        for name, values in rows.items()
    }


def _measure(model: EigenGS, image: Image, iterations: int) -> Any:
    space = model.gaussians.space
    target = rgb_to_ycbcr(image) if space == "ycbcr" else image
    for colors in ("exact", "projected"):
        started = time.perf_counter()
        model.encode(image, colors)
        yield f"encode_{colors}_ms", 1e3 * (time.perf_counter() - started)

    projected = partial(model.encode, image, "projected")
    starts: dict[str, Callable[[], Gaussians]] = {
        "projected": projected,
        "exact": partial(model.encode, image),
        "solved": lambda: solve(projected(), target, SOLVE_STEPS, warm_start=True)[0],
    }
    schedule = PRESETS["default"].schedule
    for name, start in starts.items():
        started = time.perf_counter()
        problem = FitProblem(start().bounded(), target)
        refined = refine(problem, image, schedule, iterations, started=started)
        picture = render(refined.gaussians).numpy()
        yield from _row(name, image, picture, time.perf_counter() - started)
    for name in PLACED:
        fitted = fit(image, len(model.gaussians), iterations, init=name, space=space)
        yield from _row(name, image, fitted.image, fitted.seconds)


def _row(name: str, image: Image, picture: Image, seconds: float) -> Any:
    for space in ("ycbcr", "rgb"):
        yield f"{name}_psnr_{space}", psnr(image, picture, space)
    yield f"{name}_seconds", seconds
