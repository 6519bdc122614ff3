"""The rows of a trace: PSNRs of a set of Gaussians, from sums in one kernel.

A lane converts some pixels of a rendering to what people look at, and compares them with the image.
A few bytes go to the host.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, Float, types_of
from ..backend.recording import exclusive, record
from ..gaussian.gaussians import Gaussians, whole
from ..image.color import (
    RGB_TO_YCBCR,
    decode,
    from_log,
    rendered_as,
    to_coded,
    to_linear,
    to_pu21,
    unit_codes,
)
from ..image.metrics import float_space, psnr_from_mse
from ..raster.binning.lists import TileLists
from ..raster.kernels import forward, sum_by_image
from ..raster.parameters import (
    detached_shape,
    gather_run,
    kernel_radius,
    pack_parameters,
)
from ..raster.render import batch_to_tiles, bin_gaussians, pixels_inside

Row: TypeAlias = dict[str, Any]
"""A row of a trace: its numbers by name, and under "maps" those of every map."""


class Shown(NamedTuple):
    """What some channels of a set show.

    Attributes
    ----------
    image : ndarray of float32, shape (H, W, C) or (M, H, W, C)
        sRGB or data; of several images of a batch.
    space : str
        Space of the channels, one of `eigengs_dr.image.color.SPACES`.
    channels : slice
        The channels of the set, by default all.
    weight : float
        Factor of the channels in the set.
    base : ndarray of float32, shape (H, W, C), or None
        RGB that comes on top of the rendering.
    """

    image: NDArray[np.float32]
    space: str
    channels: slice = slice(None)
    weight: float = 1.0
    base: NDArray[np.float32] | None = None


def measure(
    gaussians: Gaussians,
    image: NDArray[np.float32],
    started: float,
    base_image: NDArray[np.float32] | None = None,
) -> Row:
    """Return the seconds, psnr_ycbcr and psnr_rgb of a set for a row of a trace."""
    parts = [Shown(image, gaussians.space, base=base_image)]
    [[[ycbcr], [rgb]]] = psnrs(gaussians, parts).tolist()
    return {"seconds": time.perf_counter() - started, "psnr_ycbcr": ycbcr, "psnr_rgb": rgb}


@exclusive()
def psnrs(gaussians: Gaussians, parts: Sequence[Shown]) -> NDArray[np.float64]:
    """Compute the PSNRs of a set, as `eigengs_dr.psnr` does of its picture.

    Cost: tile lists, a rendering, and the upload of the images.

    Parameters
    ----------
    gaussians : Gaussians
        For a batch, the Gaussians of all images, image after image.
    parts : sequence of Shown

    Returns
    -------
    ndarray of float64, shape (parts, 2, images)
        In dB, in `eigengs_dr.image.metrics.float_space` and in "rgb". The sums of the squared
        errors of 4 pixels are in the precision of the set, those of the image in double.
    """
    first = parts[0].image
    images = len(first) if first.ndim == 4 else 1
    types = types_of(gaussians.mean)
    with dr.suspend_grad():
        lists = bin_gaussians(gaussians, adjoint=False, images=images)
        shape, color = detached_shape(gaussians), whole(gaussians.color, gaussians)
        uploads = [_upload(types, part) for part in parts]
        background = list(gaussians.background)
        sums = _squared_errors(shape, color, background, lists, gaussians.cutoff, uploads)
        dr.eval(sums)
    sizes = [part.image.size // images for part in parts for _ in range(2)]
    mse = np.array([s.numpy() / size for s, size in zip(sums, sizes, strict=True)])
    return np.vectorize(psnr_from_mse)(mse).reshape(len(parts), 2, images)


def _upload(types: ArrayTypes, part: Shown) -> tuple:
    """Return the space, the first channel, the weight, the image and the base of a part."""
    image, base = (None if v is None else batch_to_tiles(types, v) for v in (part.image, part.base))
    return part.space, part.channels.start or 0, dr.opaque(types.Float, part.weight), image, base


@record
def _squared_errors(
    shape: list, color: list, background: list, lists: TileLists, cutoff: float, parts: list
) -> list:
    """Return the squared errors of parts in both spaces each, Float64 of shape (images,).

    A lane owns the pixels of a row of a tile. The parts are from `_upload`.
    """
    types, grid = types_of(shape[0]), lists.grid
    rendered = forward(pack_parameters([*shape, *color]), background, lists, kernel_radius(cutoff))
    dr.eval(rendered)
    length = grid.tile[0]
    run = dr.arange(types.UInt, grid.tiles * grid.pixels // length)

    def read(image: Float) -> list:
        channels = dr.width(image) // (grid.tiles * grid.pixels)
        values = gather_run(types, image, run, length * channels, True)
        return [values[k * channels : (k + 1) * channels] for k in range(length)]

    pixels, inside = read(rendered), read(pixels_inside(types, grid))
    found = []
    for space, first, weight, image, base in parts:
        totals = [types.Float(0), types.Float(0)]
        for k, own in enumerate(read(image)):
            sums = pixels[k][first : first + len(own)]
            shown = show(space, [s / weight for s in sums])
            if base is not None:
                shown = [s + b for s, b in zip(shown, read(base)[k], strict=True)]
            for n, kind in enumerate((float_space(space), "rgb")):
                error = squared_difference(shown, own, kind)
                totals[n] += dr.select(inside[k][0] > 0, error, 0)
        Double = dr.float64_array_t(types.Float)
        found += [sum_by_image(Double(total), grid) for total in totals]
    return found


def show(space: str, sums: list) -> list:
    """Convert the channels of a pixel as `eigengs_dr.picture_of` does, light to sRGB."""
    if space == "log":
        sums = [from_log(channel) for channel in sums]
    elif space == "normal":
        sums = unit_codes(sums)
    if rendered_as(space) == "linear":
        return [to_coded(dr.maximum(channel, 0)) for channel in sums]
    return decode(space, sums)


def squared_difference(a: list, b: list, space: str) -> Float:
    """Return the squared difference of two pixels, lists of channels, as `eigengs_dr.psnr` does."""
    if space == "rgb":
        a, b = ([dr.round(dr.clip(v, 0, 1) * 255) * (1 / 255) for v in pixel] for pixel in (a, b))
    if space == "pu21":
        a, b = ([to_pu21(to_linear(v)) for v in pixel] for pixel in (a, b))
    difference = [u - v for u, v in zip(a, b, strict=True)]
    if space == "ycbcr":
        difference = [
            sum(m * d for m, d in zip(row, difference, strict=True))
            for row in RGB_TO_YCBCR.tolist()
        ]
    return sum(dr.square(d) for d in difference)
