"""The channels of a set: what they should show, in the unit of a fit, and how a PSNR sees them.

A fit works on values ``(v - offset) / scale`` of a space, times the factor of their map; `Target`,
`Channels` and `Picture` know how to come and go.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, upload
from ..backend.types import Float
from ..gaussian.channels import TextureMap
from ..gaussian.gaussians import Gaussians
from ..image.color import exposed
from ..image.space import Affine, Extent, Space
from ..raster.render import to_tiles

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
        return Picture(
            self.space,
            to_tiles(types, shown),
            self.part.start,
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
