"""Photos of a made-up object under known lights: a shaded sphere on a plane, by NumPy."""

import numpy as np


def directions(count, lowest=0.3):
    """Lights on a spiral from the pole down to z = `lowest`."""
    z = np.linspace(0.98, lowest, count)
    turn = np.arange(count) * 2.4
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], 1)


def photos(lights, side=24):
    """sRGB codes (n, side, side, 3) in [0, 1]: Lambert's law on a smooth bump, y of lights up."""
    y, x = (np.mgrid[:side, :side] + 0.5) / side * 2 - 1
    height = 0.6 * np.exp(-2 * (x**2 + y**2))
    slope = np.stack([4 * x * height, -4 * y * height, np.ones_like(x)], -1)
    normal = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    albedo = np.stack([0.8 - 0.2 * x, 0.6 + 0.2 * y, np.full_like(x, 0.5)], -1)
    shade = np.maximum(np.einsum("hwk,nk->nhw", normal, np.asarray(lights)), 0)
    return ((albedo[None] * shade[..., None]) ** (1 / 2.2)).astype(np.float32)
