"""Fit the sets of Gaussians that the scenes use: ``python scenes/assets.py [FOLDER]``.

They come from photos that ship with scikit-image, and from a pattern that is computed here. What
is there already is kept.
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

import eigengs_dr as eg
from eigengs_dr.image.resize import resample

FOLDER = Path(__file__).parent.parent / "build" / "scenes"
"""Where the scenes look for the sets unless told otherwise."""

PALETTE = np.array([[0.05, 0.23, 0.35], [0.07, 0.42, 0.47], [0.86, 0.80, 0.66], [0.80, 0.45, 0.13]])
"""Glazes, as sRGB codes them."""

JOINT = 0.04
"""Half of the joint between two tiles, in widths of a tile."""


def fitted(folder, name, image, gaussians, color):
    """Fit a set and save it, unless it is there already.

    Parameters
    ----------
    folder : Path
        Must exist.
    name : str
        Of the file, without suffix.
    image : ndarray
    gaussians : int
    color : str
        As for `eigengs_dr.fit`.

    Returns
    -------
    Path
    """
    path = folder / f"{name}.npz"
    if not path.exists():
        started = time.perf_counter()
        eg.fit(image, gaussians=gaussians, iterations=300, color=color).gaussians.save(path)
        print(f"wrote {path} in {time.perf_counter() - started:.1f} s")
    return path


def floor():
    """Pixels of the photo that tiles the floor: a square of 400."""
    return eg.sample("coffee")[:, 100:500]


def tiles(count=4, side=256, seed=3):
    """Draw glazed tiles in staggered rows; the picture repeats.

    Parameters
    ----------
    count : int, optional
        Of rows, even, and of tiles in a row.
    side : int, optional
        In pixels.
    seed : int, optional

    Returns
    -------
    color : ndarray, shape (side, side, 3)
        As sRGB codes it.
    roughness : ndarray, shape (side, side)
    normals : ndarray, shape (side, side, 3)
        Mapped from [-1, 1] to [0, 1], as normal maps are.
    """
    random = np.random.default_rng(seed)
    v, u = (np.mgrid[:side, :side] + 0.5) / side * count
    row = np.floor(v).astype(int)
    u = u + 0.5 * (row % 2)
    column = np.floor(u).astype(int) % count
    # Distance from the edge of the tile, whose corners are round.
    beyond = [np.maximum(np.abs(x % 1 - 0.5) - 0.38, 0) for x in (u, v)]
    inside = 0.12 - JOINT - np.hypot(*beyond)
    glaze = np.clip(inside / 0.05 + 0.5, 0, 1)

    shade = random.choice(len(PALETTE), (count, count), p=[0.35, 0.3, 0.2, 0.15])
    glazes = PALETTE[shade] * random.normal(1, 0.12, (count, count, 1))
    mortar = (1 - glaze[..., None]) * [0.55, 0.53, 0.50]
    color = glaze[..., None] * glazes[row, column] + mortar

    polish = random.uniform(0.12, 0.3, (count, count))
    roughness = glaze * polish[row, column] + (1 - glaze) * 0.8

    height = gaussian_filter(np.clip(inside, 0, 0.1), side / 128, mode="wrap")
    dy, dx = np.gradient(0.12 * side * height)
    normals = np.stack([-dx, -dy, np.ones_like(height)], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return color.clip(0, 1), roughness, 0.5 + 0.5 * normals


def main(folder=FOLDER):
    """Fit what is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    color, roughness, normals = tiles()
    cat = eg.sample("chelsea")[:, 100:400]
    # Brighter than it is, as the only light of a room.
    portrait = resample(eg.sample("astronaut"), 384, 384).clip(0, 1) ** 0.7
    # Emission and reflectance are light, which sums and filters right as it is. A coded picture
    # looks the same where it is looked at closely.
    fitted(folder, "floor", floor(), 4000, "linear")
    fitted(folder, "picture", portrait, 5000, "linear")
    fitted(folder, "poster", cat, 5000, "ycbcr")
    fitted(folder, "tiles-color", color, 3000, "linear")
    fitted(folder, "tiles-roughness", roughness, 3000, "data")
    fitted(folder, "tiles-normals", normals, 4000, "data")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
