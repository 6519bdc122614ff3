"""High dynamic range: an environment map by Gaussians, against the same through 8 bits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eigengs_bench.harness.environment import environment
from eigengs_bench.harness.store import Progress
from eigengs_dr.fitting.fit import fit
from eigengs_dr.image.color import to_coded, to_linear, to_pu21
from eigengs_dr.image.io import to_8bit
from eigengs_dr.image.pixels import LinearImage
from eigengs_dr.image.resize import join_pictures, text_line

Light = NDArray[np.float32]

STOPS = (0, -4)
"""Exposures of the picture, in powers of 2."""

CROP = slice(70, 290), slice(60, 480)
"""Part of an environment of 1,024x512 pixels that the picture shows: houses, and the sun."""


def run(
    width: int = 1024,
    gaussians: int = 20_000,
    iterations: int = 1000,
    progress: Progress = lambda *_: None,
) -> tuple[dict[str, float], dict[str, Light]]:
    """Fit a made-up environment map in several ways.

    Returns
    -------
    figures : dict of str to float
        For each way, the PSNR in PU21 (`pu21_`), the root mean square of the difference of the
        decimal logarithms of light above 0.001 (`log10_`), and the PSNR of the picture after the
        tone curve of Reinhard et al. 2002, ``I / (1 + I)``, in sRGB (`tone_`).
    lights : dict of str to ndarray
        The environment and its fits.
    """
    light = environment(width, width // 2)
    clipped = (to_8bit(to_coded(light)) / 255).astype(np.float32)
    results = {"reference": light, "8bit_image": to_linear(clipped)}
    ways: dict[str, tuple[Any, str]] = {
        "log": (light.view(LinearImage), "log"),
        "radiance": (light.view(LinearImage), "radiance"),
        "8bit": (clipped, "linear"),
    }
    for number, (name, (image, color)) in enumerate(ways.items()):

        def step(done: int, total: int, row: Any, number: int = number) -> None:
            progress("fits", number * total + done, len(ways) * total)

        found = fit(image, gaussians, iterations, space=color, progress=step)
        shown = np.clip(found.image, 0, 1) if name == "8bit" else found.image
        results[name] = to_linear(shown)
    figures = {
        f"{measure}_{name}": function(result, light)
        for name, result in results.items()
        if name != "reference"
        for measure, function in MEASURES.items()
    }
    return figures, results


def comparison(results: dict[str, Light]) -> NDArray[Any]:
    """Show the environment, its fit and the one through 8 bits at several exposures."""
    rows = []
    for stop in STOPS:
        parts = []
        for name in ("reference", "log", "8bit"):
            part = np.clip(to_coded(results[name][CROP] * np.float32(2.0**stop)), 0, 1)
            title = text_line(f"{name}, {stop:+d} stops" if stop else name, part.shape[1], 14)
            parts.append(join_pictures([title, part], 0, 0))
        rows.append(join_pictures(parts, 1))
    return join_pictures(rows, 0)


def _pu21(found: Light, light: Light) -> float:
    return _psnr(to_pu21(found.astype(np.float64)), to_pu21(light.astype(np.float64)))


def _log10(found: Light, light: Light) -> float:
    a, b = (np.log10(np.maximum(x, 1e-3, dtype=np.float64)) for x in (found, light))
    return float(np.sqrt(np.mean(np.square(a - b))))


def _tone(found: Light, light: Light) -> float:
    a, b = (to_coded(np.maximum(x, 0) / (1 + np.maximum(x, 0))) for x in (found, light))
    return _psnr(a.astype(np.float64), b.astype(np.float64))


def _psnr(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(-10 * np.log10(np.mean(np.square(a - b))))


MEASURES = {"pu21": _pu21, "log10": _log10, "tone": _tone}
"""Measures of `run`."""
