"""A made-up environment map of high dynamic range: sky, sun, houses with lit windows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SUN = 5_000.0
"""Light of the disc of the sun, with 1 for white; the real one has 1e5 of that of a sky."""

SUN_RADIUS = 0.008
"""Radius of the sun in radians, twice the real one, so that it has pixels at 1,024 x 512."""

HOUSES = 40
"""Number of houses along the horizon."""


def environment(width: int = 1024, height: int = 512, seed: int = 0) -> NDArray[np.float32]:
    """Draw an environment map in equirectangular projection.

    Parameters
    ----------
    width, height : int
        Pixels; the map is drawn at twice the size and averaged.
    seed : int
        Seed of the houses, their windows and the ground.

    Returns
    -------
    ndarray of float32, shape (height, width, 3)
        Linear light: the ground has 0.05 to 0.3, dark walls 0.01, the sky 0.3 to 2, windows 2 to
        30, and the sun 5,000.
    """
    generator = np.random.default_rng(seed)
    v, u = (np.mgrid[: 2 * height, : 2 * width] + 0.5) / (2 * height)  # both in half turns
    elevation, azimuth = np.pi * (0.5 - v), np.pi * u
    sky = _sky(elevation, azimuth)
    light = np.where((elevation > 0)[..., None], sky, _ground(elevation, azimuth))
    for house in range(HOUSES):
        _draw_house(light, azimuth, elevation, house, generator)
    fine = light.reshape(height, 2, width, 2, 3)
    return fine.mean(axis=(1, 3)).astype(np.float32)


def _sky(elevation: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a gradient from zenith to horizon, thin clouds, and the sun with its glow."""
    high = np.clip(elevation, 0, None)[..., None] / (np.pi / 2)
    light = np.array([0.25, 0.45, 1.0]) * high**0.5 + np.array([1.6, 1.3, 1.1]) * (1 - high) ** 4
    clouds = np.sin(5 * azimuth + 3 * np.sin(9 * elevation)) * np.sin(21 * elevation + azimuth)
    light += 0.5 * np.clip(clouds, 0, 1)[..., None] ** 3
    east, up = 1.9, 0.7
    cosine = np.sin(elevation) * np.sin(up)
    cosine += np.cos(elevation) * np.cos(up) * np.cos(azimuth - east)
    angle = np.arccos(np.clip(cosine, -1, 1))[..., None]
    warm = np.array([1.0, 0.9, 0.7])
    return light + warm * (np.where(angle < SUN_RADIUS, SUN, 0) + 20 * np.exp(-angle / 0.05))


def _ground(elevation: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return paving stones in perspective."""
    distance = 1 / np.tan(np.clip(-elevation, 0.03, None))
    x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
    stone = (np.floor(2 * x) + np.floor(2 * y)) % 2
    return (0.08 + 0.12 * stone + 0.02 * np.sin(17 * x))[..., None] * np.array([1.0, 0.95, 0.85])


def _draw_house(
    light: NDArray[np.float64],
    azimuth: NDArray[np.float64],
    elevation: NDArray[np.float64],
    number: int,
    generator: np.random.Generator,
) -> None:
    """Draw a wall from the horizon up, with rows of windows of which some are lit."""
    turn = 2 * np.pi
    width, top = generator.uniform(0.08, 0.16), generator.uniform(0.15, 0.45)
    left = turn * number / HOUSES
    column, row = (azimuth - left) % turn / width, elevation / top
    wall = (column < 1) & (row < 1) & (elevation > -0.03)
    light[wall] = generator.uniform(0.005, 0.15) * generator.uniform(0.6, 1, 3)
    across, floors = generator.integers(3, 6), generator.integers(3, 9)
    for floor in range(floors):
        for place in range(across):
            x, y = column * across - place, row * floors - floor
            pane = wall & (abs(x - 0.5) < 0.3) & (abs(y - 0.5) < 0.3)
            lit = generator.random() < 0.4
            bright = 10 ** generator.uniform(0.3, 1.5) if lit else 0.02
            light[pane] = bright * np.array([1.0, 0.8, 0.5] if lit else [0.6, 0.8, 1.0])
