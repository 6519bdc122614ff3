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
from typing import NamedTuple

import numpy as np
from PIL import Image

from ..backend.types import Doubles, Singles
from ..raster.render import picture_of
from ..storage.atomic import atomic_folder
from .directions import Octahedron
from .model import Relightable

RESOLUTION = 16
"""Directions along each side of the grid. relight's default is 8, and its limit 20."""

QUALITY = 95
"""Quality of the JPEG files, relight's default."""

INFO = "info.json"
"""Name of the file with all but the pixels."""


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
        factors = model.table.at(Octahedron(resolution).directions())
        mean = factors[..., -1:]
        factors = np.pad(factors[..., :-1], ((0, 0), (0, 0), (0, padding)))
        whole = np.concatenate([factors, mean], axis=2)
        return cls(images, whole.reshape(resolution, resolution, 3, -1))

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
