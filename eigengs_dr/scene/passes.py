"""Renderings in passes of samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

# isort: split
import mitsuba as mi

SAMPLES_PER_PASS = 1 << 24
"""Most samples in one pass. The state of a sample takes some 20 bytes; progress and Ctrl-C wait
for the end of a pass."""


def render_in_passes(
    scene: Any, camera: int, spp: int | None, show: Callable[[int, int], None] = lambda *_: None
) -> tuple[NDArray[np.float32], int]:
    """Render a scene by one of its cameras; each pass has its own seed.

    Parameters
    ----------
    scene : mitsuba.Scene
    camera : int
    spp : int or None
        Samples per pixel, by default those of the camera.
    show : callable, optional
        ``show(done, total)`` after each pass, in samples per pixel.

    Returns
    -------
    pixels : ndarray of float32, shape (H, W, C)
        Linear light, and the channels of AOVs.
    spp : int
        Samples per pixel.
    """
    sensor = scene.sensors()[camera]
    width, height = sensor.film().crop_size()
    total = spp or sensor.sampler().sample_count()
    most = max(1, SAMPLES_PER_PASS // (width * height))
    pixels, done = np.zeros(()), 0
    while done < total:
        count = min(most, total - done)
        part = mi.render(scene, sensor=camera, spp=count, seed=done)
        pixels = pixels + count * np.array(part, np.float64)
        done += count
        show(done, total)
    return (pixels / total).astype(np.float32), total
