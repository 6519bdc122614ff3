"""The channels of a set: what they should show, in the unit of a fit, and their PSNRs.

A fit works on values ``(v - offset) / scale`` of a space, times the factor of their map; `Target`,
`Channels` and `Picture` know how to come and go. `psnrs` measures a set on the device: a lane
converts some pixels of a rendering to display values (sRGB), and compares them with the image. Only
a few bytes go to the host.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, gather_run, types_of, upload
from ..backend.recording import record
from ..backend.types import Float, Record
from ..gaussian.channels import TextureMap
from ..gaussian.gaussians import Gaussians, broadcast_rows
from ..image.color import RGB_TO_YCBCR, exposed, to_linear, to_pu21
from ..image.metrics import psnr_from_mse
from ..image.space import Affine, Extent, Space
from ..raster.kernels import image_of, pixels_inside, spread, sum_by_image
from ..raster.lists import TileLists
from ..raster.parameters import detached_shape, kernel_radius, pack_parameters
from ..raster.render import bin_gaussians, to_tiles

Image = NDArray[np.float32]


class Picture(NamedTuple):
    """What some channels of a set show, for a PSNR.

    Attributes
    ----------
    space : Space
        Space of the channels.
    image : Float
        In tile layout: sRGB; or the data as they are fitted.
    first : int
        The first of its channels of the set.
    scale, offset : Float, shape (images,)
        ``scale s + offset`` of a fitted value s is in units of the space; of data, with the peak 1.
    exposure : Float, shape (images,)
        Factor of light that may exceed 1 before it is compared.
    weight : Float, shape (pixels,), or None
        Factor of the squared errors, in tile layout.
    base : Float or None
        RGB that is added to the rendering, in tile layout.
    has_codes : bool
        Whether the values are displayed in 8 bits: colours, normals, and data between 0 and 1.
    """

    space: Space
    image: Float
    first: int
    scale: Float
    offset: Float
    exposure: Float
    weight: Float | None = None
    base: Float | None = None
    has_codes: bool = True


class Target(NamedTuple):
    """An image that some channels should show.

    Attributes
    ----------
    pixels : ndarray of float32, shape (H, W, C)
        Display values: sRGB, above 1 for light above 1; normals or data.
    values : ndarray of float32, shape (H, W, C)
        In the space of the channels and the unit of the fit.
    unit : Affine
    """

    pixels: Image
    values: Image
    unit: Affine

    @classmethod
    def of(cls, pixels: Image, space: Space, unit: Affine | None = None) -> Target:
        """Convert pixels to the values of a space, ``(v - offset) / scale``.

        By default the unit is that of the pixels; give one if they are a part of a larger image.
        """
        values = space.values_of(pixels)
        unit = unit or space.unit(Extent.of(values))
        if unit != Affine():
            values = (values - np.float32(unit.offset)) / np.float32(unit.scale)
        return cls(pixels, values, unit)


class Channels(NamedTuple):
    """Some channels of a set: those of an image, or of one map.

    Attributes
    ----------
    name : str
        Name of the map; "" for an image.
    space : Space
    part : slice
        The channels of the set.
    targets : tuple of Target
        What they should show, one for each image of a batch; () if only a loss knows.
    factor : float
        Factor of the fitted values, and so of the errors.
    goal : float or None
        The PSNR in dB that the map must reach.
    """

    name: str
    space: Space
    part: slice
    targets: tuple[Target, ...] = ()
    factor: float = 1.0
    goal: float | None = None

    @property
    def number(self) -> int:
        """Number of channels."""
        return int(self.part.stop - self.part.start)

    def unit(self, image: int = 0) -> Affine:
        """Return the map from sums of the fit to values of the space, for an image of a batch."""
        scale, offset = self.targets[image].unit if self.targets else Affine()
        return Affine(scale / self.factor, offset)

    @property
    def peak(self) -> float:
        """The peak of a PSNR in the unit of the fit, before the factor."""
        pixels, _, unit = self.targets[0]
        return 1 / unit.scale if self.space.has_codes(pixels) else 1.0

    @property
    def map(self) -> TextureMap:
        """The map of the finished set, whose weight is the factor of its errors in the fit."""
        return TextureMap(self.name, self.space, self.number, 1 / self.unit().scale)

    def values(self) -> Image:
        """Return the fitted values, shape (images, H, W, C), or (H, W, C) for one image."""
        return self._stacked([target.values for target in self.targets])

    def placement_images(self) -> Image:
        """Return the images that place Gaussians, of the shape of `values`."""
        trivial = Affine()
        return self._stacked(
            [
                self.space.placement_image(values, pixels if unit == trivial else None)
                for pixels, values, unit in self.targets
            ]
        )

    def weights(self) -> Image | None:
        """Return the factors of the squared errors, of the shape of `values`; None for 1."""
        weights = [self.space.weight(target.values) for target in self.targets]
        known = [weight for weight in weights if weight is not None]
        return (np.stack(known) if len(known) > 1 else known[0]) if known else None

    def _stacked(self, images: list[Image]) -> Image:
        stacked = np.stack(images) if len(images) > 1 else images[0]
        return stacked if self.factor == 1 else stacked * np.float32(self.factor)

    def picture(self, types: ArrayTypes, weight: Image | None = None) -> Picture:
        """Return the display values on the device, for the PSNRs.

        Data are measured with their range as the peak, or 1 if they are codes. Light that may
        exceed 1 is exposed, see `Space.exposure`.

        Parameters
        ----------
        types : ArrayTypes
        weight : ndarray of float32, shape (H, W) or (H, W, C), optional
            Factor of the squared errors.
        """
        images, codes = [target.pixels for target in self.targets], True
        units = [self.unit(k) for k in range(len(images))]
        exposures = [self.space.exposure(pixels) for pixels in images]
        if self.space.by_range:
            codes = all(map(self.space.has_codes, images))
            shown = self.values()
            if not codes:
                units = [Affine(1 / self.factor, u.offset / u.scale) for u in units]
        else:
            images = [exposed(*pair) for pair in zip(images, exposures, strict=True)]
            shown = np.stack(images) if len(images) > 1 else images[0]
        weights = None
        if weight is not None:
            weights = to_tiles(types, np.atleast_3d(weight).mean(axis=2, keepdims=True))
        rows = np.array([*zip(*units, strict=True), exposures])
        scale, offset, exposure = (upload(types.Float, row) for row in rows)
        return Picture(
            self.space,
            to_tiles(types, shown),
            self.part.start,
            scale,
            offset,
            exposure,
            weights,
            has_codes=codes,
        )


def restored(gaussians: Gaussians, units: Sequence[Affine]) -> Gaussians:
    """Return a set in the units of an image, from the unit of each channel of the fit."""
    if all(unit == Affine() for unit in units):
        return gaussians
    kind = type(gaussians.color)
    color = [row * unit.scale for row, unit in zip(gaussians.color, units, strict=True)]
    background = [
        row * unit.scale + unit.offset
        for row, unit in zip(gaussians.background, units, strict=True)
    ]
    return replace(gaussians, color=kind(color), background=kind(background))


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
    squares = np.array([s.numpy() for s in sums]).reshape(len(pictures), 3, images)
    mse = squares[:, :2] / squares[:, 2:]
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

    Each picture has those in the space of floats, those in 8 bits, and the sum of the weights of
    all values. A lane owns the pixels of a row of a tile.
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
    results: list[Float] = []
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
        results += [sum_by_image(Double(total), grid) for total in totals]
    return results


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
