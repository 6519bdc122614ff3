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
from numpy.typing import ArrayLike, NDArray

from ..backend.arrays import ArrayTypes, types_of, upload
from ..backend.types import Float, Record, Tensor
from ..gaussian.channels import TextureMap
from ..gaussian.gaussians import Gaussians, whole
from ..image.color import exposed
from ..image.space import DATA, Affine, Extent, Space
from ..raster.kernels import channel_sums, forward, pixels_inside, residual
from ..raster.lists import TileLists
from ..raster.parameters import detached_shape, kernel_radius, pack_parameters
from ..raster.render import batch_to_tiles, bin_gaussians, to_tensor
from ..raster.tiles import Grid

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
        self, packed: Float, background: list, lists: TileLists, radius: float, pairs: bool = False
    ) -> tuple[Float, list]:
        """Return the derivative ``h (p - t)`` for a set, and the sums of ``h (p - t)^2``.

        They come from one pass, `eigengs_dr.raster.kernels.residual`.
        """
        return residual(packed, background, lists, radius, self.target, self.curvature, pairs)

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
        self, packed: Float, background: list, lists: TileLists, radius: float, pairs: bool = False
    ) -> tuple[Float, list]:
        """Return the derivative, which is given in Floats; there are no squares."""
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
            weights = batch_to_tiles(types, np.atleast_3d(weight).mean(axis=2, keepdims=True))
        return Picture(
            self.space,
            batch_to_tiles(types, shown),
            self.part,
            upload(types.Float, np.array([unit.scale for unit in units])),
            upload(types.Float, np.array([unit.offset for unit in units])),
            upload(types.Float, np.array(exposures)),
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


@dataclass(frozen=True)
class Pixels:
    """The squared error of an image in the space of the colours, with weights.

    One image, a batch of images, or several maps as the channels of one image; see
    `eigengs_dr.fitting.problem.Problem.pixels`.

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
    def of(
        cls,
        values: Image,
        space: Space,
        types: ArrayTypes,
        weight: Image | None = None,
        placement_image: Image | None = None,
    ) -> Pixels:
        """Upload an image, or a batch of images of one size.

        Parameters
        ----------
        values : ndarray of float32, shape (H, W, C) or (images, H, W, C)
            The values that are fitted.
        space : Space
        types : ArrayTypes
            Backend and precision of the sets.
        weight : ndarray of float32, shape (..., H, W), (..., H, W, 1) or (..., H, W, C), optional
            Factors of the squared errors.
        placement_image : ndarray of float32, of the shape of `values`, optional
            The image that places Gaussians; by default `values`.
        """
        target = batch_to_tiles(types, values)
        placed = target if placement_image is None else batch_to_tiles(types, placement_image)
        curvature = None
        if weight is not None:
            layers = weight if weight.ndim == values.ndim else weight[..., None]
            curvature = batch_to_tiles(types, layers)
        *batch, height, width, channels = values.shape
        grid = Grid(width, height, images=batch[0] if batch else 1)
        return cls(grid, channels, space, Quadratic(target, curvature), placed)

    @classmethod
    def plain(
        cls, values: ArrayLike, gaussians: Gaussians, weight: ArrayLike | None = None
    ) -> Pixels:
        """Return the squared error of values (H, W, C) in the space of some Gaussians.

        A weight, shape (H, W) or (H, W, C), multiplies the squared errors.
        """
        factors = None if weight is None else np.asarray(weight, np.float32)
        types = types_of(gaussians.mean)
        return cls.of(np.asarray(values, np.float32), gaussians.space, types, factors)

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


def squares_of(shown: Sequence[Channels], types: ArrayTypes, weight: Image | None = None) -> Pixels:
    """Return the squared error of the targets of all channels, without what PSNRs need.

    Errors of light weigh more in the dark.

    Parameters
    ----------
    shown : sequence of Channels
        The channels of a set, with targets.
    types : ArrayTypes
    weight : ndarray of float32, shape (H, W) or (H, W, C), optional
        Factors of the squared errors.
    """
    values = _joined([channels.values() for channels in shown])
    weights = [channels.weights() for channels in shown]
    factors = weight
    if any(w is not None for w in weights):
        factors = _joined(
            [
                np.ones_like(channels.values()) if w is None else w
                for channels, w in zip(shown, weights, strict=True)
            ]
        )
        if weight is not None:
            factors = factors * np.atleast_3d(weight)
    elif weight is not None and values.ndim > 3:
        factors = np.stack([weight] * len(values))
    placed = _joined([channels.placement_images() for channels in shown])
    space = DATA if shown[0].name else shown[0].space
    same = np.shares_memory(placed, values)
    return Pixels.of(values, space, types, factors, None if same else placed)


def _joined(images: list[Image]) -> Image:
    return images[0] if len(images) == 1 else np.concatenate(images, axis=-1)
