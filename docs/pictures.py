"""Compose pictures of how-to pages: ``python docs/pictures.py`` writes docs/images/how-to-*.jpg.

All of them show fits of photos that scikit-image ships. They take half a minute on two cores.
"""

from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Dr.Jit: it finds libLLVM)
import drjit as dr
import numpy as np
from PIL import Image

IMAGES = Path(__file__).parent / "images"
CELL, GAP = 240, 6  # pixels: side of a picture, and white between two
ERROR_GAIN = 4  # errors are shown as absolute differences of sRGB values, times this


def main() -> None:
    """Make each picture and write it."""
    cat, portrait = eg.sample("chelsea")[20:260, 90:330], eg.sample("astronaut")
    write("levels", [levels(cat)])
    write("number", numbers(cat))
    write("blocks", [seams(portrait)])
    write("own-loss", [foveated(cat)])
    write("weights", [strokes(cat)])


def levels(photo: np.ndarray) -> list[np.ndarray]:
    """Render the first 78, 312, 1,250 and 5,000 Gaussians of one set."""
    counts = eg.level_counts(5000, 4)
    gaussians = eg.fit(photo, counts).gaussians
    return [eg.picture_of(gaussians[:count]) for count in counts]


def numbers(photo: np.ndarray) -> list[list[np.ndarray]]:
    """Fit three numbers of Gaussians; the second row has their errors."""
    fits = [eg.fit(photo, count).image.clip(0, 1) for count in (300, 1200, 4800)]
    return [fits, [ERROR_GAIN * abs(fit - photo) for fit in fits]]


def seams(photo: np.ndarray) -> list[np.ndarray]:
    """Fit blocks each for itself, and by `eigengs_dr.fit_large`.

    All pictures show the same 80 x 80 pixels around the corner of four blocks.
    """
    side, pixels = 128, 150  # of a block, and for each Gaussian
    alone = np.empty_like(photo)
    for top, left in np.ndindex(4, 4):
        part = np.s_[side * top : side * (top + 1), side * left : side * (left + 1)]
        alone[part] = eg.fit(photo[part], side**2 // pixels, iterations=300).image
    count = photo[..., 0].size // pixels
    large = eg.fit_large(photo, gaussians=count, iterations=300, block=side)
    return [one[88:168, 216:296] for one in (photo, alone, eg.picture_of(large.gaussians))]


def foveated(photo: np.ndarray) -> list[np.ndarray]:
    """Fit a photo, and fit it with a foveated loss, like that of the page, around the left eye."""
    y, x = np.indices(photo.shape[:2]) - np.array([110, 70])[:, None, None]
    fovea = np.exp(-(x**2 + y**2) / (2 * 45**2))[..., None].astype(np.float32)
    plain = eg.fit(photo, 600, space="rgb")
    tensor = type(eg.render(plain.gaussians))
    weight, wanted = tensor(fovea), tensor(photo)

    def loss(picture: dr.ArrayBase, step: int) -> dr.ArrayBase:
        error = picture - wanted
        blocks = dr.mean(dr.reshape(error, (30, 8, 30, 8, 3)), axis=(1, 3))
        near = dr.mean(weight * dr.square(error), axis=None)
        return near + 0.2 * dr.mean(dr.square(blocks), axis=None)

    sharp = eg.fit(photo, 600, space="rgb", loss=loss)
    return [photo, np.repeat(fovea, 3, 2), plain.image, sharp.image]


def strokes(photo: np.ndarray) -> list[np.ndarray]:
    """Hide strokes of a photo, and fit it without them."""
    y, x = np.indices(photo.shape[:2])
    hidden = ((x + y) % 40 < 8) | ((x - y) % 40 < 8)
    weight = np.where(hidden, 0, 1).astype(np.float32)
    result = eg.fit(np.where(hidden[..., None], np.nan, photo), 3000, weight=weight)
    shown = np.where(hidden[..., None], 1, photo)
    return [shown, np.repeat(weight[..., None], 3, 2), result.image]


def write(name: str, rows: list[list[np.ndarray]]) -> None:
    """Write rows of pictures as one."""
    lines = [between([np.asarray(cell_of(picture)) for picture in row], axis=1) for row in rows]
    path = IMAGES / f"how-to-{name}.jpg"
    Image.fromarray(between(lines, axis=0)).save(path, quality=78, optimize=True)


def between(parts: list[np.ndarray], axis: int) -> np.ndarray:
    """Join pictures with a white gap between each two."""
    shape = [*parts[0].shape]
    shape[axis] = GAP
    gap = np.full(shape, 255, np.uint8)
    return np.concatenate([one for part in parts for one in (part, gap)][:-1], axis)


def cell_of(picture: np.ndarray) -> Image.Image:
    """Bring a picture to the size of a cell; pixels that are magnified stay squares."""
    codes = Image.fromarray(np.uint8(255 * picture.clip(0, 1) + 0.5))
    is_magnified = codes.width < CELL
    resampling = Image.Resampling.NEAREST if is_magnified else Image.Resampling.LANCZOS
    return codes.resize((CELL, CELL), resampling)


if __name__ == "__main__":
    main()
