"""Gaussians for an environment map: as cameras see it, and as it lights a scene.

A renderer samples other directions from a set than from a bitmap, so renderings with few samples
differ by their noise and cannot judge. Instead the pictures are compared, twice: as 8-bit sRGB,
which is how cameras and mirrors see them, and as the light on white surfaces, for all normals.
"""

from __future__ import annotations

import math
from itertools import product

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom
from skimage.transform import resize_local_mean

from ..fitting.fit import fit
from ..fitting.options import Goal
from ..gaussian.gaussians import Gaussians, with_colors
from ..image.color import to_coded
from ..image.metrics import psnr
from ..image.space import LINEAR, LOG, RADIANCE
from ..plugins.cone import pixel_angle
from ..raster.render import render
from .bitmaps import Unsuitable
from .fit_scene import ENOUGH, shrunk
from .rendering import Progress

FINER = 2
"""Texels of the fit along a texel that cameras resolve, and points of the comparison along one of
the fit. Without points between, a set of 5,000 Gaussians in logarithms had 1.6 times the light of
its bitmap: nothing saw them beside the texels."""

CLOSER = (-6.0, 0.0, 8.0)
"""PSNR of the fit above the goal, in dB, tried in turn, since the fit weighs light differently from
cameras."""

BYTES = 60
"""Fewest bytes of a Gaussian in memory; they limit a set to the memory of its bitmap."""

NEWTON, TINY = 4, 1e-30
"""Steps of `with_mean_of`, and a divisor for black maps."""

BLOCKS, NORMALS = (32, 64), (9, 16)
"""Rows and columns of the directions of light, and of the normals of surfaces."""


def fit_environment(
    scene: mi.Scene,
    pixels: NDArray[np.float32],
    target_psnr: float,
    iterations: int,
    max_bytes: int,
    tell: Progress = lambda done, total, row: None,
) -> tuple[Gaussians, float]:
    """Find the fewest Gaussians that show an environment map at a PSNR.

    Parameters
    ----------
    scene : mitsuba.Scene
        Its cameras decide how fine the map must be; texels smaller than half a pixel are merged.
    pixels : ndarray of float32, shape (H, W, 3)
        Linear light.
    target_psnr : float
        Goal for what cameras see, and for the light.
    iterations : int
        Steps of the fits.
    max_bytes : int
        Largest memory of a set.
    tell : callable, optional
        ``tell(done, total, row)``, whose row has the ``stage`` "search" and the figures of the fit.

    Returns
    -------
    gaussians : Gaussians
        Of the size of the map.
    psnr : float
        The lower of the two, in dB.

    Raises
    ------
    Unsuitable
        If the map has light below 0 or that is not finite, is too small, or no set is close enough.
    """
    height, width = pixels.shape[:2]
    if min(height, width) < 8:
        raise Unsuitable(f"an environment map of {width}x{height} texels is small")
    if not np.isfinite(pixels).all() or pixels.min() < -1e-3:
        raise Unsuitable("an environment map with light below 0, or that is not finite")
    target = np.repeat(pixels.clip(0), 3 // pixels.shape[2], axis=2)
    target = _as_seen(target, scene)
    spaces = (LOG, RADIANCE) if target.max() > 1 + 1e-3 else (LINEAR,)
    max_count, reached = max(1, max_bytes // BYTES), list[str]()
    for space, more in product(spaces, CLOSER):
        asked = min(max(target_psnr + more, 1.0), 99.0)
        goal = Goal(asked, max_gaussians=min(max_count, target[..., 0].size))
        result = fit(
            target,
            target_psnr=goal,
            iterations=iterations,
            space=space,
            encoding="linear",
            progress=lambda step, steps, row: tell(step, steps, row | {"stage": "search"}),
        )
        balanced = with_mean_of(target, result.gaussians)
        kept = closeness(_means(balanced), target)
        if kept >= target_psnr:
            return balanced.scaled(width, height), kept
        reached.append(f"{kept:.1f} dB with {len(balanced):,} Gaussians")
    raise Unsuitable(f"an environment map: {', '.join(reached)} for a goal of {target_psnr:g} dB")


def with_mean_of(target: NDArray[np.float32], gaussians: Gaussians) -> Gaussians:
    """Return a set whose light has the mean of a map over the sphere, in each channel.

    A sun has most of the light of a map and few of its texels, so a fit of logarithms may miss the
    mean by a few percent. Light is multiplied by a factor. Logarithms c become ``c + g c + s``: of
    all g and s that give the mean, those with the smallest ``sum of (g c + s)^2``, by Newton steps.

    Parameters
    ----------
    target : ndarray of float32, shape (H, W, 3)
        Linear light.
    gaussians : Gaussians
        Of three channels, near the target, in the space "linear", "radiance" or "log".

    Returns
    -------
    Gaussians
        With other colours and another background.
    """
    space = gaussians.space
    codes = np.float64(space.from_light(_means(gaussians)))
    area = _areas(target) / _areas(target).sum()
    arrays = gaussians.to_arrays()
    rows = np.float64(np.vstack([arrays["color"], arrays["background"].reshape(1, -1)]))
    for channel, wanted in enumerate(np.einsum("hwc,hw->c", target, area)):
        code, change = codes[..., channel], np.zeros(1 if space.affine else 2)
        moves = np.stack([code, np.ones_like(code)][: len(change)])
        metric = np.linalg.pinv(np.einsum("ihw,jhw,hw->ij", moves, moves, area))
        for _ in range(NEWTON):
            light = code + np.tensordot(change, moves, 1)
            slope, light = space.slope(light), space.to_light(light)
            rate = np.einsum("ihw,hw->i", moves, slope * area)
            step = metric @ rate
            change += step * (wanted - (light * area).sum()) / max(rate @ step, TINY)
        rows[:, channel] *= 1 + change[0]
        rows[-1, channel] += change[1:].sum()
    return with_colors(gaussians, rows, gaussians.space)


def _means(gaussians: Gaussians) -> NDArray[np.float32]:
    """Return means of the picture of a set over texels."""
    width, height = gaussians.width, gaussians.height
    points = render(gaussians, FINER * width, FINER * height).numpy().clip(0)
    return points.reshape(height, FINER, width, FINER, -1).mean(axis=(1, 3))


def _as_seen(pixels: NDArray[np.float32], scene: mi.Scene) -> NDArray[np.float32]:
    """Return a map with `FINER` texels along each one that the cameras resolve."""
    angles = [pixel_angle(s) for s in scene.sensors() if "x_fov" in mi.traverse(s)]
    texels = min(angles, default=0.0) * pixels.shape[1] / (2 * math.pi * ENOUGH)  # in half a pixel
    times = 2 ** max(0, int(math.log2(max(1.0, texels))))
    if times >= FINER:
        return shrunk(pixels, times // FINER)
    around = np.pad(pixels, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    finer = zoom(around, (FINER, FINER, 1), order=1, mode="nearest", grid_mode=True)
    return np.ascontiguousarray(finer[:, FINER:-FINER])


def closeness(texels: NDArray[np.float32], target: NDArray[np.float32]) -> float:
    """Return the lower PSNR in dB of two maps, shape (H, W, 3): as pictures, and as light."""
    area = _areas(target)
    codes = [to_coded(k.clip(0, 1)) for k in (texels, target)]
    seen = psnr(codes[0], codes[1], weight=area)
    lights = [_irradiance(k * area[..., None]) for k in (texels, target)]
    white = max(float(lights[1].max()), 1e-12)
    return min(seen, psnr(*(to_coded((k / white).clip(0, 1)) for k in lights)))


def _areas(light: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the areas on the sphere of the texels of a map, but for a factor, shape (H, W)."""
    theta = (np.arange(len(light)) + 0.5) * (np.pi / len(light))
    return np.repeat(np.sin(theta)[:, None], light.shape[1], axis=1)


def _irradiance(light: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the light on surfaces by their normals, ``sum of L max(n . d, 0)``.

    Parameters
    ----------
    light : ndarray, shape (H, W, 3)
        Times the area of texels.
    """
    blocks = resize_local_mean(np.asarray(light, np.float64), BLOCKS, channel_axis=2)
    cosine = np.maximum(_directions(*NORMALS) @ _directions(*BLOCKS).T, 0)
    return (cosine @ blocks.reshape(-1, light.shape[2])).reshape(*NORMALS, light.shape[2])


def _directions(rows: int, columns: int) -> NDArray[np.float64]:
    """Return the directions of the centres of cells, shape (rows * columns, 3)."""
    theta, phi = np.meshgrid(
        (np.arange(rows) + 0.5) * (np.pi / rows),
        (np.arange(columns) + 0.5) * (2 * np.pi / columns),
        indexing="ij",
    )
    d = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return np.stack(d, axis=-1).reshape(-1, 3)
