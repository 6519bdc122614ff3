"""The objective of a fit: what the picture of its Gaussians should match, on the device.

An objective gives a quadratic model around a picture p: ``1/2 sum_x h(x) (p(x) - t(x))^2`` up to a
constant, with a curvature ``h >= 0`` for every pixel. The derivative by the picture, the colour
solve, the cost of a removal, the gain of an added Gaussian and the noise follow from the model, and
none of them needs to know about weights. For the squared error with weights, `Pixels`, the
model is exact: t is the image and h the weight, for all pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, types_of, upload
from ..backend.types import Float, Record, Tensor
from ..gaussian.gaussians import Gaussians, whole
from ..image.color import to_coded, to_linear
from ..image.space import Affine, Extent, Space
from ..raster.binning.lists import TileLists
from ..raster.binning.tiles import Grid
from ..raster.kernels import channel_sums, forward, residual
from ..raster.parameters import detached_shape, kernel_radius, pack_parameters
from ..raster.render import batch_to_tiles, bin_gaussians, pixels_inside, to_tensor

if TYPE_CHECKING:
    from .state import State

Image = NDArray[np.float32]


class Quadratic(NamedTuple):
    """A quadratic model of a loss: ``1/2 sum_x h (p - t)^2`` for a picture p.

    Attributes
    ----------
    target : Float, shape (pixels * channels,), or None
        The picture t at which the model is least, in the tile layout of
        `eigengs_dr.raster.kernels`; None for 0.
    curvature : Float, shape (pixels,) or (pixels * channels,), or None
        h for all channels of a pixel, or for each; None stands for 1 at all pixels of the image.
    """

    target: Float | None
    curvature: Float | None = None

    def compare(
        self, packed: Float, background: list, lists: TileLists, radius: float
    ) -> tuple[Float, list]:
        """Return the derivative ``h (p - t)`` for a set, and the sums of ``h (p - t)^2``.

        They come from one pass, `eigengs_dr.raster.kernels.residual`.
        """
        return residual(packed, background, lists, radius, self.target, self.curvature)

    def curvatures(self, grid: Grid) -> Float:
        """Return the curvature of every pixel: one value, or one per channel; 0 outside."""
        if self.curvature is None:
            assert self.target is not None
            return pixels_inside(types_of(self.target), grid)
        return self.curvature

    def curvatures_of_values(self, grid: Grid, channels: int) -> Float:
        """Return the curvature of every value, shape (pixels * channels,); 0 outside the image."""
        h = self.curvatures(grid)
        types, number = types_of(h), dr.width(h) // (grid.tiles * grid.pixels)
        value = dr.arange(types.UInt, grid.tiles * grid.pixels * channels)
        return dr.gather(types.Float, h, value // (channels // number))

    def mean_target(self, grid: Grid, channels: int) -> list:
        """Return the mean of the target weighed by the curvature: a Float (images,) per channel."""
        assert self.target is not None
        types = types_of(self.target)
        if self.curvature is None:
            area = dr.opaque(types.Float, 1 / (grid.width * grid.height))
            return [s * area for s in channel_sums(self.target, channels, grid)]
        h = self.curvatures_of_values(grid, channels)
        weights, sums = (channel_sums(v, channels, grid) for v in (h, h * self.target))
        return [dr.select(w > 0, s / w, 0) for s, w in zip(sums, weights, strict=True)]

    def mean_curvature(self, grid: Grid, channels: int) -> Float:
        """Return the mean of the curvature over the pixels and channels, a Float (images,)."""
        assert self.target is not None
        types = types_of(self.target)
        if self.curvature is None:
            return dr.full(types.Float, 1, grid.images)
        number = dr.width(self.curvature) // (grid.tiles * grid.pixels)
        sums = channel_sums(self.curvature, number, grid)
        return sum(sums) * dr.opaque(types.Float, 1 / (number * grid.width * grid.height))


class Slope(NamedTuple):
    """The derivative of a loss at the picture of a step, instead of a model around it.

    Attributes
    ----------
    derivative : Float, shape (pixels * channels,)
        In tile layout, times half the number of values, as `Quadratic.compare` returns it.
    size : Float, shape (1,)
        0 if there is no derivative at this step, which then moves nothing.
    """

    derivative: Float
    size: Float

    def compare(
        self, packed: Float, background: list, lists: TileLists, radius: float
    ) -> tuple[Float, list]:
        """Return the derivative; there are no squares."""
        return self.derivative, []


class Picture(NamedTuple):
    """What some channels of a set show, for a PSNR.

    Attributes
    ----------
    space : Space
        Space of the channels.
    image : Float
        In tile layout: sRGB; or the data as they are fitted.
    channels : slice
        The channels of the set.
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
    channels: slice
    scale: Float
    offset: Float
    exposure: Float
    weight: Float | None = None
    base: Float | None = None
    has_codes: bool = True


class Part(NamedTuple):
    """A part of a picture, and of its Gaussians.

    Attributes
    ----------
    movable : slice
        The Gaussians that may move.
    core : (slice, slice)
        The rows and columns to which they may move.
    """

    movable: slice
    core: tuple[slice, slice]


class Data(NamedTuple):
    """An image in the space of its colours, before it is uploaded.

    Attributes
    ----------
    values : ndarray of float32, shape (H, W, C)
        The values that are fitted.
    placement_image : ndarray of float32, shape (H, W, C)
        The image that places Gaussians: linear light would put too few of them into dark parts.
    curvature : ndarray of float32, shape (H, W) or (H, W, C), or None
    affine : Affine
    """

    values: Image
    placement_image: Image
    curvature: Image | None = None
    affine: Affine = Affine()


@dataclass(frozen=True)
class Pixels:
    """The squared error of an image in the space of the colours, with weights.

    One image, a batch of images, or several maps as the channels of one image.

    Attributes
    ----------
    grid : Grid
    channels : int
    space : Space
        Space of the sets; "data" for maps, whose pictures hold their spaces.
    model : Quadratic
        ``h (p - t)^2`` with the image t and the weight h.
    placement_image : Float
        The image whose second derivatives place Gaussians, in tile layout.
    pictures : tuple of Picture
        The images as displayed, for the PSNRs of a trace.
    levels : tuple of int
        Numbers n: the first n Gaussians must form the image too.
    part : Part or None
        What may move, if not everything.
    """

    grid: Grid
    channels: int
    space: Space
    model: Quadratic
    placement_image: Float
    pictures: tuple[Picture, ...] = ()
    levels: tuple[int, ...] = ()
    part: Part | None = None

    @classmethod
    def of(cls, data: Data | Sequence[Data], space: Space, types: ArrayTypes) -> Pixels:
        """Upload an image, or a batch of images of one size.

        Parameters
        ----------
        data : Data, or sequence of Data
        space : Space
        types : ArrayTypes
            Backend and precision of the sets.
        """
        batch = [data] if isinstance(data, Data) else list(data)
        height, width, channels = batch[0].values.shape

        def upload(images: list[Image]) -> Float:
            stacked = images[0] if len(images) == 1 else np.stack(images)
            return batch_to_tiles(types, stacked if stacked.ndim > 2 else stacked[..., None])

        values = upload([d.values for d in batch])
        same = all(d.placement_image is d.values for d in batch)
        placement_image = values if same else upload([d.placement_image for d in batch])
        curvature = None
        if batch[0].curvature is not None:
            # 2-D weights are one for all channels
            layers = [np.atleast_3d(d.curvature) for d in batch if d.curvature is not None]
            assert len(layers) == len(batch)
            curvature = upload(layers)
        grid = Grid(width, height, images=len(batch))
        return cls(grid, channels, space, Quadratic(values, curvature), placement_image)

    @classmethod
    def plain(cls, values: Image, gaussians: Gaussians) -> Pixels:
        """Return the squared error of an image (H, W, C) in the space of some Gaussians."""
        values = np.asarray(values, np.float32)
        return cls.of(Data(values, values), gaussians.space, types_of(gaussians.mean))

    @property
    def types(self) -> ArrayTypes:
        """Backend and precision."""
        assert self.model.target is not None
        return types_of(self.model.target)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.grid.width, self.grid.height

    @contextmanager
    def models(self) -> Iterator[Callable[[State], Quadratic | Slope]]:
        """Give the model of each step during a descent: a function of its state."""
        yield lambda state: self.model

    def around(self, gaussians: Gaussians) -> Pixels:
        """Return the squared error that stands for the objective near a set: itself."""
        return self

    def judged(self, gaussians: Gaussians) -> dict[str, float]:
        """Return what a row of a trace holds besides PSNRs: nothing."""
        return {}

    def merit(self, row: Record) -> float:
        """Return the figure of a row that is largest for the best set: its PSNR."""
        return float(row["psnr_ycbcr"])

    def minus(self, gaussians: Gaussians) -> Pixels:
        """Return the objective for Gaussians that are added to these, which stay as they are."""
        lists = bin_gaussians(gaussians, adjoint=False)
        packed = pack_parameters([*detached_shape(gaussians), *whole(gaussians.color, gaussians)])
        radius, background = kernel_radius(gaussians.cutoff), list(gaussians.background)
        rendering = forward(packed, background, lists, radius)
        pixel = dr.arange(self.types.UInt, dr.width(rendering)) // self.channels
        inside = dr.gather(self.types.Float, pixels_inside(self.types, self.grid), pixel)
        left = self.model.target - rendering * inside
        dr.eval(left)
        return replace(self, model=self.model._replace(target=left), placement_image=left)

    def picture(self, values: Float) -> Tensor:
        """Return an image in tile layout as a tensor (H, W, C)."""
        return to_tensor(values, self.grid, self.channels)


def data_of(
    pixels: Image, space: Space, weight: Image | None = None, affine: Affine | None = None
) -> Data:
    """Convert pixels (H, W, C) to the space of the colours, in units common to all images.

    Errors of light weigh more in the dark.

    Parameters
    ----------
    pixels : ndarray of float32, shape (H, W, C)
        sRGB, above 1 for light above 1; or data.
    space : Space
    weight : ndarray of float32, shape (H, W) or (H, W, C), optional
        Factor of the squared errors. Pixels without any weight may have any value.
    affine : Affine, optional
        The unit, if these are pixels of a larger image; by default that of the pixels.
    """
    values = space.values_of(pixels)
    affine = affine or space.unit(Extent.of(values))
    if affine != Affine():
        values = (values - np.float32(affine.offset)) / np.float32(affine.scale)
    placement_image = space.placement_image(values, pixels if affine == Affine() else None)
    return Data(values, placement_image, _product(space.weight(values), weight), affine)


def picture(
    types: ArrayTypes,
    space: Space,
    pixels: Sequence[Image],
    data: Sequence[Data],
    weight: Image | None = None,
    first: int = 0,
    factor: float = 1.0,
) -> Picture:
    """Return the display values of an image, or of a batch of images, for the PSNRs.

    Data are measured with their range as the peak, or 1 if they are codes. Light that may exceed 1
    is exposed, see `Space.exposure`.

    Parameters
    ----------
    types : ArrayTypes
    space : Space
    pixels : sequence of ndarray of float32, shape (H, W, C)
        sRGB, normals or data.
    data : sequence of Data
        The same images in the units of the fit.
    weight : ndarray of float32, shape (H, W) or (H, W, C), optional
        Factor of the squared errors.
    first : int, optional
        The first channel among those of a set.
    factor : float, optional
        Factor of the channels in the set.
    """
    affines, images, codes = [d.affine for d in data], list(pixels), True
    if space.by_range:
        images = [d.values * np.float32(factor) for d in data]
        codes = all(map(space.has_codes, pixels))
        if not codes:
            affines = [Affine(1.0, a.offset / a.scale) for a in affines]
    exposures = [space.exposure(p) for p in images]
    lit = zip(images, exposures, strict=True)
    images = [p if e == 1 else to_coded(to_linear(p) * np.float32(e)) for p, e in lit]
    batch = np.stack(images) if len(images) > 1 else images[0]
    weights = None
    if weight is not None:
        weights = batch_to_tiles(types, np.atleast_3d(weight).mean(axis=2, keepdims=True))
    return Picture(
        space,
        batch_to_tiles(types, batch),
        slice(first, first + batch.shape[-1]),
        upload(types.Float, np.array([a.scale / factor for a in affines])),
        upload(types.Float, np.array([a.offset for a in affines])),
        upload(types.Float, np.array(exposures)),
        weights,
        has_codes=codes,
    )


def _product(curvature: Image | None, weight: Image | None) -> Image | None:
    if curvature is None or weight is None:
        return curvature if weight is None else weight
    return curvature * (weight if weight.ndim == 3 else weight[..., None])


def restored(gaussians: Gaussians, affine: Affine) -> Gaussians:
    """Return a set in the units of the image."""
    if affine == Affine():
        return gaussians
    color, background = gaussians.color * affine.scale, gaussians.background * affine.scale
    return replace(gaussians, color=color, background=background + affine.offset)


def fitted(gaussians: Gaussians, affine: Affine) -> Gaussians:
    """Return a set in the units of a fit: the inverse of `restored`."""
    scale = 1 / affine.scale
    background = (gaussians.background - affine.offset) * scale
    return replace(gaussians, color=gaussians.color * scale, background=background)
