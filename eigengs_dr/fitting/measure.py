"""The rows of a trace: PSNRs of a set of Gaussians, from sums in one kernel.

A lane converts some pixels of a rendering to display values (sRGB), and compares them with the
image. Only a few bytes go to the host.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..backend.recording import record
from ..backend.types import Float, Record
from ..gaussian.gaussians import Gaussians, broadcast_rows
from ..image.color import RGB_TO_YCBCR, to_linear, to_pu21
from ..image.metrics import psnr_from_mse
from ..raster.kernels import image_of, pixels_inside, sum_by_image
from ..raster.lists import TileLists
from ..raster.parameters import (
    detached_shape,
    gather_run,
    kernel_radius,
    pack_parameters,
)
from ..raster.render import bin_gaussians
from .channels import Picture
from .solve import spread

Row: TypeAlias = Record
"""A row of a trace: its numbers by name, and under "maps" those of every map."""


class Measured(NamedTuple):
    """A measurement of a set.

    Attributes
    ----------
    row : dict
        What a row of a trace holds of it.
    margin : float
        Decibels above the goal of a search.
    """

    row: Row
    margin: float = math.inf


def psnrs(gaussians: Gaussians, pictures: Sequence[Picture]) -> NDArray[np.float64]:
    """Compute the PSNRs of a set, as `eigengs_dr.psnr` does for its picture.

    Cost: tile lists, and a rendering.

    Parameters
    ----------
    gaussians : Gaussians
        In the units of the fit. For a batch, the Gaussians of all images, image after image.
    pictures : sequence of Picture

    Returns
    -------
    ndarray of float64, shape (pictures, 2, images)
        In dB, in the `figure` of the space and in "rgb", which is NaN for data that
        have no codes. The sums of the squared errors of 4 pixels are in the precision of the set,
        those of the image in double.
    """
    images = dr.width(pictures[0].scale)
    with dr.suspend_grad():
        lists = bin_gaussians(gaussians, adjoint=False, images=images)
        shape, color = detached_shape(gaussians), broadcast_rows(gaussians.color, gaussians)
        background = list(gaussians.background)
        cutoff = gaussians.cutoff
        sums = _squared_errors(shape, color, background, lists, cutoff, list(pictures))
        dr.eval(sums)
    *squares, areas = np.split(np.array([s.numpy() for s in sums]), 3, axis=0)
    mse = np.stack(squares, axis=1) / areas[:, None]
    decibels: NDArray[np.float64] = np.vectorize(psnr_from_mse)(mse)
    decibels[[not p.has_codes for p in pictures], 1] = np.nan
    return decibels


@record
def _squared_errors(
    shape: list,
    color: list,
    background: list,
    lists: TileLists,
    cutoff: float,
    pictures: list[Picture],
) -> list:
    """Return the squared errors of pictures in both spaces each, Float64 of shape (images,).

    First those in the space of floats, then those in 8 bits, then the sums of the weights of all
    values. A lane owns the pixels of a row of a tile.
    """
    types, grid = types_of(shape[0]), lists.grid
    packed = pack_parameters([*shape, *color])
    rendered = image_of(packed, background, lists, kernel_radius(cutoff))
    length = grid.tile[0]
    run = dr.arange(types.UInt, grid.tiles * grid.pixels // length)
    owner = lists.layout.image_of(run // (grid.pixels // length))

    def read(image: Float) -> list:
        channels = dr.width(image) // (grid.tiles * grid.pixels)
        values = gather_run(types, image, run, length * channels, True)
        return [values[k * channels : (k + 1) * channels] for k in range(length)]

    pixels, inside = read(rendered), pixels_inside(types, grid)
    results: list[list[Float]] = []
    for picture in pictures:
        space, first, weight, base = picture.space, picture.first, picture.weight, picture.base
        a, b, light = (spread(v, owner) for v in (picture.scale, picture.offset, picture.exposure))
        totals = [types.Float(0)] * 3
        factors = read(inside if weight is None else weight)
        bases = None if base is None else read(base)
        for k, seen in enumerate(read(picture.image)):
            sums = pixels[k][first : first + len(seen)]
            if space.by_range:
                # Differences of the fitted values keep their digits.
                error = sum(dr.square((s - v) * a) for s, v in zip(sums, seen, strict=True))
                rendering, seen = ([dr.fma(v, a, b) for v in pixel] for pixel in (sums, seen))
            else:
                decoded = space.decode([dr.fma(s, a, b) for s in sums])
                rendering = [space.display(v * light) for v in decoded]
                if bases is not None:
                    rendering = [s + v for s, v in zip(rendering, bases[k], strict=True)]
                error = sum(map(dr.square, DIFFERENCES[space.figure](rendering, seen)))
            in_codes = sum(map(dr.square, DIFFERENCES["rgb"](rendering, seen)))
            errors = error, in_codes, types.Float(len(seen))
            f = factors[k][0]
            totals = [t + dr.select(f > 0, e * f, 0) for t, e in zip(totals, errors, strict=True)]
        Double = dr.float64_array_t(types.Float)
        results.append([sum_by_image(Double(total), grid) for total in totals])
    return [value for group in zip(*results, strict=True) for value in group]


def _minus(a: list, b: list) -> list:
    return [u - v for u, v in zip(a, b, strict=True)]


def _in_8bit(pixel: list) -> list:
    return [dr.round(dr.clip(v, 0, 1) * 255) * (1 / 255) for v in pixel]


def _to_pu21(pixel: list) -> list:
    return [to_pu21(to_linear(v)) for v in pixel]


def _times_ycbcr(pixel: list) -> list:
    rows = RGB_TO_YCBCR.tolist()
    return [sum(m * v for m, v in zip(row, pixel, strict=True)) for row in rows]


DIFFERENCES: dict[str, Callable[[list, list], list]] = {
    "rgb": lambda a, b: _minus(_in_8bit(a), _in_8bit(b)),
    "pu21": lambda a, b: _minus(_to_pu21(a), _to_pu21(b)),
    "ycbcr": lambda a, b: _times_ycbcr(_minus(a, b)),
    "data": _minus,
}
"""Differences of the channels of two pixels, by the space of `eigengs_dr.psnr`."""
