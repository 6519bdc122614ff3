"""Planes of pixels with ``info.json``: the files that the viewers relight and OpenLIME show.

The format is that of RelightLab's "bilinear" basis in the colour space "mrgb"
(github.com/cnr-isti-vclab/relight, ``src/rti.cpp``; OpenLIME, ``src/ShaderRTI.js``):

- ``plane_0.jpg``, ``plane_1.jpg``, ...: three planes each, as red, green and blue, not YCbCr.
- A pixel v of plane k stands for ``(v / 255 - bias_k) scale_k``, where 1 is white.
- "basis" holds numbers of 8 bits: for the mean and for each plane, for each of R x R directions,
  for each colour. The mean is in 1 / 255; a number b of plane k stands for ``(b - 127) / range_k``.
- Directions lie on an octahedron that is turned by 45 degrees: a corner of the grid is on an axis.
- Numbers of planes are multiples of 3.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from ..backend.types import ArrayLike, Doubles, Record, Singles
from ..raster.render import picture_of
from ..storage.atomic import atomic_folder
from .lights import check_lights
from .model import Relightable

RESOLUTION = 16
"""Directions along each side of the grid. relight's default is 8, and its limit 20."""

QUALITY = 95
"""Quality of the JPEG files, relight's default."""

INFO, MAX_INFO = "info.json", 1 << 24
"""Name of the file with all but the pixels, and its largest size in bytes."""

MAX_PLANES, MAX_RESOLUTION, MAX_PIXELS = 66, 64, 1 << 28
"""Largest numbers that are read."""


class PixelPlanes(NamedTuple):
    """Planes of pixels, and their factors on a grid of directions.

    Attributes
    ----------
    images : ndarray of float32, shape (H, W, K)
        K is a multiple of 3.
    grid : ndarray of float64, shape (R, R, 3, K + 1)
        For rows y and columns x of the grid: the factors of the planes in each colour, and last
        the mean.
    """

    images: Singles
    grid: Doubles

    @classmethod
    def of(cls, model: Relightable, resolution: int = RESOLUTION) -> PixelPlanes:
        """Render the planes of a model, and evaluate its table on the grid."""
        planes = model.planes
        shape = (planes.height, planes.width, planes.channels)
        padding = -planes.channels % 3
        images = np.pad(picture_of(planes).reshape(shape), ((0, 0), (0, 0), (0, padding)))
        factors = model.table.at(directions(resolution))
        mean = factors[..., -1:]
        factors = np.pad(factors[..., :-1], ((0, 0), (0, 0), (0, padding)))
        whole = np.concatenate([factors, mean], axis=2)
        return cls(images, whole.reshape(resolution, resolution, 3, -1))

    def picture(self, light: ArrayLike) -> Singles:
        """Return what viewers show under a light, (H, W, 3), in sRGB codes that may leave [0, 1].

        They interpolate linearly between the directions of the grid.
        """
        [[x, y, z]] = check_lights(np.asarray(light, np.float64)[None], "light")
        last = len(self.grid) - 1
        turned = np.array([x + y, y - x]) / (abs(x) + abs(y) + max(z, 0))
        place = (turned + 1) / 2 * last
        column, row = np.clip(np.floor(place), 0, last - 1).astype(int)
        (right, down), cell = place - (column, row), self.grid[row : row + 2, column : column + 2]
        weights = np.outer([1 - down, down], [1 - right, right])
        factors = np.tensordot(weights, cell, 2).astype(np.float32)
        return np.asarray(self.images @ factors[:, :-1].T + factors[:, -1])

    def write(self, folder: str | os.PathLike[str], quality: int = QUALITY) -> None:
        """Write a folder, which does not exist or is empty, in one step.

        Raises
        ------
        OSError
            If the folder cannot be created, or is not empty.
        """
        height, width, count = self.images.shape
        low, high = self.images.min((0, 1)), self.images.max((0, 1))
        scale = np.where(high > low, high - low, 1).astype(np.float64)
        bias = -low / scale
        codes = np.rint((self.images / scale + bias) * 255).clip(0, 255).astype(np.uint8)
        factors, mean = np.moveaxis(self.grid[..., :-1], 3, 0), self.grid[..., -1]
        largest = abs(factors).max((1, 2, 3))
        ranges = 127 / np.where(largest > 0, largest, 1)
        rows = np.rint(127 + factors * ranges[:, None, None, None])
        basis = np.concatenate([np.rint(255 * mean.clip(0, 1))[None], rows])
        info = {
            "width": width,
            "height": height,
            "format": "jpg",
            "type": "bilinear",
            "resolution": len(self.grid),
            "colorspace": "mrgb",
            "nplanes": count,
            "quality": quality,
            "basis": basis.astype(int).ravel().tolist(),
            "materials": [{"range": list(ranges), "scale": list(scale), "bias": list(bias)}],
        }
        with atomic_folder(folder) as place:
            (place / INFO).write_text(json.dumps(info), encoding="utf-8")
            for k in range(0, count, 3):
                picture = Image.fromarray(np.ascontiguousarray(codes[..., k : k + 3]))
                name = place / f"plane_{k // 3}.jpg"
                picture.save(name, quality=quality, optimize=True, keep_rgb=True)

    @classmethod
    def read(cls, folder: str | os.PathLike[str]) -> PixelPlanes:
        """Read a folder with a bilinear basis, from this package or from relight.

        Raises
        ------
        ValueError
            If a file is missing, damaged, or of another type: one line that names it.
        """
        path = Path(folder) / INFO
        try:
            if path.stat().st_size > MAX_INFO:
                raise ValueError(f"it has more than {MAX_INFO} bytes")
            info = json.loads(path.read_text(encoding="utf-8"))
            return cls(*_checked(info, Path(folder)))
        except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else error
            raise ValueError(f"{path}: is no bilinear basis of planes; {what}") from None


def _checked(info: Record, folder: Path) -> tuple[Singles, Doubles]:
    """Return the planes and the grid of a folder."""

    def integer(name: str, largest: int) -> int:
        value = info[name]
        if not isinstance(value, int) or not 2 <= value <= largest:
            raise ValueError(f"{name} is {str(value)[:20]}; expected 2 to {largest}")
        return value

    def numbers(source: object, name: str, count: int) -> Doubles:
        values = np.array(source, np.float64)
        if values.shape != (count,) or not np.isfinite(values).all():
            raise ValueError(f"{name} has shape {values.shape}; expected {count} finite numbers")
        return values

    for name, expected in (("type", "bilinear"), ("colorspace", "mrgb")):
        if info[name] != expected:
            raise ValueError(f"{name} is {str(info[name])[:20]!r}; expected {expected!r}")
    width, height = (integer(name, MAX_PIXELS) for name in ("width", "height"))
    count, side = integer("nplanes", MAX_PLANES), integer("resolution", MAX_RESOLUTION)
    if count % 3 or width * height > MAX_PIXELS:
        raise ValueError(f"it has {count} planes of {width}x{height}; expected a multiple of 3")
    [material] = info["materials"]
    ranges, scale, bias = (numbers(material[k], k, count) for k in ("range", "scale", "bias"))
    if not (ranges > 0).all():
        raise ValueError("range must be above 0")
    basis = numbers(info["basis"], "basis", 3 * (count + 1) * side**2)
    mean, *rows = basis.reshape(count + 1, side, side, 3)
    grid = np.stack([*((r - 127) / k for r, k in zip(rows, ranges, strict=True)), mean / 255], 3)
    parts = []
    for k in range(count // 3):
        with Image.open(folder / f"plane_{k}.jpg", formats=["JPEG"]) as file:
            if file.size != (width, height) or file.mode != "RGB":
                raise ValueError(f"plane_{k}.jpg is {file.size} {file.mode}; expected RGB")
            parts.append(np.asarray(file, np.float32) / 255)
    images = (np.concatenate(parts, axis=2) - bias) * scale
    return images.astype(np.float32), grid


def directions(resolution: int) -> Doubles:
    """Return the directions of a grid, row by row: unit vectors (R^2, 3) above the horizon."""
    across = np.linspace(-1, 1, resolution)
    column, row = np.meshgrid(across, across)
    x, y = (column - row).ravel() / 2, (column + row).ravel() / 2
    found = np.stack([x, y, np.maximum(1 - abs(x) - abs(y), 0)], axis=1)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))
