"""Gaussians for the scenes: ``python scenes/assets.py [FOLDER]``.

The script fits photos of scikit-image and a pattern that it computes. It keeps existing files.
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

import eigengs_dr as eg
from eigengs_dr.image.resize import resample

FOLDER = Path(__file__).parent.parent / "build" / "scenes"
"""Default folder of the sets in all scenes."""

PALETTE = np.array([[0.05, 0.23, 0.35], [0.07, 0.42, 0.47], [0.86, 0.80, 0.66], [0.80, 0.45, 0.13]])
"""Colours of the glazes, as coded sRGB in [0, 1]."""

JOINT = 0.04
"""Half the width of the joint between two tiles, in widths of a tile."""


def fitted(folder, name, image, gaussians, color):
    """Fit a set of Gaussians and save it, unless the file exists.

    Parameters
    ----------
    folder : Path
        An existing folder.
    name : str
        Name of the file without suffix.
    image : ndarray
        As for `eigengs_dr.fit`.
    gaussians : int
        Number of Gaussians.
    color : str
        As for `eigengs_dr.fit`.

    Returns
    -------
    Path
        The file.
    """
    return _kept(folder, name, lambda: eg.fit(image, gaussians, 300, space=color).gaussians)


def fitted_material(folder, name, maps, gaussians):
    """Fit the maps of a material and save it, unless the file exists.

    Parameters
    ----------
    folder, name
        As for `fitted`.
    maps : dict of str to ndarray
        As for `eigengs_dr.fit`.
    gaussians : int
        Number of Gaussians.

    Returns
    -------
    Path
        The file.
    """
    return _kept(folder, name, lambda: eg.fit(maps, gaussians, 300).gaussians)


def _kept(folder, name, fit):
    """Save what a fit returns, unless the file exists; return the file."""
    path = folder / f"{name}.npz"
    if not path.exists():
        started = time.perf_counter()
        fit().save(path)
        print(f"wrote {path} in {time.perf_counter() - started:.1f} s")
    return path


def floor():
    """Return the photo of the floor, a square of 400 pixels."""
    return eg.sample("coffee")[:, 100:500]


def tiles(count=4, side=256, seed=3):
    """Draw a periodic picture of glazed tiles in staggered rows.

    Parameters
    ----------
    count : int, optional
        Number of rows, and of tiles in a row; even.
    side : int, optional
        Side of the picture in pixels.
    seed : int, optional

    Returns
    -------
    color : ndarray, shape (side, side, 3)
        Coded sRGB in [0, 1].
    roughness : ndarray, shape (side, side)
        In [0, 1].
    normals : ndarray, shape (side, side, 3)
        Normals, mapped from [-1, 1] to [0, 1] as in a normal map.
    """
    random = np.random.default_rng(seed)
    v, u = (np.mgrid[:side, :side] + 0.5) / side * count
    row = np.floor(v).astype(int)
    u = u + 0.5 * (row % 2)
    column = np.floor(u).astype(int) % count
    # The distance from the edge of the tile; its corners are round.
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
    """Fit all missing sets."""
    folder.mkdir(parents=True, exist_ok=True)
    color, roughness, normals = tiles()
    cat = eg.sample("chelsea")[:, 100:400]
    # The power brightens the portrait, because it is the only light of a room.
    portrait = resample(eg.sample("astronaut"), 384, 384).clip(0, 1) ** 0.7
    # Emission and reflectance are linear, so that filters average light. The camera is close to
    # the poster, where coded colours look the same.
    fitted(folder, "floor", floor(), 4000, "linear")
    fitted(folder, "picture", portrait, 5000, "linear")
    fitted(folder, "poster", cat, 5000, "ycbcr")
    maps = {"albedo": color, "roughness": roughness, "normal": normals}
    fitted_material(folder, "tiles", maps, 4000)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
