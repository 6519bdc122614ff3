"""Renderings of a scene in passes of samples, and pictures of a scene before and after."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..image.color import to_coded
from ..image.io import save_image
from ..image.metrics import psnr

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


LOUDER = 8.0
"""Factor of the differences in their pictures."""

Progress = Callable[[str, int, int], None]


def compare_renderings(
    before: Any, after: Any, folder: Path, spp: int | None, progress: Progress
) -> list[float]:
    """Render two scenes by each camera, with the same random numbers, and write the pictures.

    Parameters
    ----------
    before, after : mitsuba.Scene
        With the same cameras.
    folder : Path
        Gets before-1.png, after-1.png and difference-1.png, 8 times louder, and so on.
    spp : int or None
        Samples per pixel, by default those of the camera.
    progress : callable
        ``progress(label, done, total)``.

    Returns
    -------
    list of float
        psnr_rgb in dB for each camera.
    """
    found, cameras = [], len(before.sensors())
    for number in range(cameras):
        progress("renderings", number, cameras)
        pair = [_picture(scene, number, spp) for scene in (before, after)]
        loud = np.clip(LOUDER * np.abs(pair[0] - pair[1]), 0, 1)
        for name, picture in zip(("before", "after", "difference"), [*pair, loud], strict=True):
            save_image(folder / f"{name}-{number + 1}.png", picture)
        found.append(psnr(pair[0], pair[1]))
    progress("renderings", cameras, cameras)
    return found


def _picture(scene: Any, camera: int, spp: int | None) -> NDArray[np.float32]:
    """Render a scene in sRGB, shape (H, W, 3) or (H, W, 1)."""
    light, _ = render_in_passes(scene, camera, spp)
    channels = 3 if light.shape[2] >= 3 else 1
    shown = to_coded(np.maximum(light[..., :channels], 0))
    return np.clip(shown, 0, 1).astype(np.float32)
