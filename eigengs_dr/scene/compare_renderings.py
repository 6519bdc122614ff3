"""Renderings of a scene by bitmaps and of the scene by Gaussians, and their difference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..image.color import to_coded
from ..image.io import save_image
from ..image.metrics import psnr
from .passes import render_in_passes

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
