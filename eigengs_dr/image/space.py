"""What the sums of a set of Gaussians mean: its space, an object that knows all that follows.

A space encodes the pixels of an image for a fit, and decodes sums for a rendering. It knows the
unit of a fit, how much errors weigh, which PSNR judges it, and what a display does with it. The
rest of the package asks it and never compares its name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.messages import shown
from ..storage.npz import BadValue
from . import color
from .color import Samples
from .pixels import MAX_PIXEL, MIN_PIXEL, ImageError, by_strips

Image = NDArray[np.float32]


class Affine(NamedTuple):
    """The map from fitted values to those of the image: ``image = scale fitted + offset``."""

    scale: float = 1.0
    offset: float = 0.0


class Extent(NamedTuple):
    """The smallest and the largest of some values, their sum and their number."""

    low: float
    high: float
    total: float
    number: int

    @classmethod
    def of(cls, values: Image) -> Extent:
        """Return the extent of an array."""
        total = float(values.sum(dtype=np.float64))
        return cls(float(values.min()), float(values.max()), total, values.size)

    def joined(self, other: Extent) -> Extent:
        """Return the extent of both."""
        low, high = min(self.low, other.low), max(self.high, other.high)
        return Extent(low, high, self.total + other.total, self.number + other.number)

    @property
    def mean(self) -> float:
        """The mean of the values."""
        return self.total / self.number

    @property
    def unit(self) -> Affine:
        """The unit in which the values have the mean 0 and the range 1.

        A constant image has no range, and rounding of its mean does not make one.
        """
        width = self.high - self.low
        flat = width <= 1e-6 * max(abs(self.low), abs(self.high))
        return Affine(1.0 if flat else width, self.mean)

    @property
    def is_of_codes(self) -> bool:
        """Whether data are codes between 0 and 1, as those of textures."""
        return self.low >= 0 and MIN_CODE < self.high <= MAX_PIXEL


MIN_CODE = 0.1
"""Smallest maximum of data that count as codes between 0 and 1, as in textures."""

GREY = 0.18
"""Mean of fitted light that may exceed 1: photographic mid-grey."""

VISIBLE = 100.0
"""Light that may exceed 1 is displayed unchanged if its mean is at most so much brighter or darker
than `GREY`: other light is out of the range of a display, and would all look alike."""

BRIGHT = 2.0
"""Logarithm of light that a pyramid of texels is to reach, that of light 100. Of three made-up
lights with a sun or windows, by six photos of a metal ball, 240 steps with twice the rate of light
to 1 found 0.6 dB more in PU21."""

DARKNESS, BLACK = 0.3, 0.003
"""Exponent and smallest light I, with 1 for white, of the weight ``max(I, BLACK)^-(2 DARKNESS)`` of
squared errors in linear light: a compromise between errors of light, which neglect the dark, and
errors of sRGB codes, whose weight is about the square of it. With 5,000 Gaussians and
300 steps it gains 0.7 dB of psnr_rgb over no weight, on 12 training images of ImageNet classes. It
suits light above 1 too. Three made-up environments of 512x256 pixels, with a sun of 5,000, end at
31.2 dB in PU21, at 29.6 without weights, at 31.5 with ``(I + 0.01)^-1``, at 29.9 and 25.5 dB
with relative errors (0.1 and 0.01 added to I), and at 27.0 dB with the slope of PU21. Steep weights
let bright spots vanish, which costs at most 1 per pixel, rather than spill on dark pixels."""


def exposure_of(mean: float) -> float:
    """Return the factor that brings light of a mean into the range of a display."""
    return 1.0 if mean <= 0 or 1 / VISIBLE <= mean / GREY <= VISIBLE else GREY / mean


class Space(str):
    """The space of the channels of a set; the text is its name. This one is gamma-encoded RGB.

    Attributes
    ----------
    encoding : {"srgb", "linear"} or None
        The encoding of renderings; None if they are no colours.
    affine : bool
        Whether `decode` is affine: then colours may be decoded instead of sums.
    is_light : bool
        Whether the sums are linear light.
    bounded : bool
        Whether the values end at 1: a display or a texture clamps them.
    by_range : bool
        Whether errors count relative to the range of the values, unless these are codes.
    figure : {"ycbcr", "data", "pu21"}
        The space of `eigengs_dr.psnr` for the key psnr_ycbcr. Data and normals have no YCbCr; light
        above 1 has no bounded code but PU21.
    numbers : tuple of int
        How many channels a set may have; any number if it is empty.
    reach : float
        The largest sum that a loss without bounds looks for.
    names : tuple of str
        What its three channels are called.
    to_rgb : ndarray, shape (3, 3)
        Matrix of `decode` for changes of values, if it is affine.
    page_kind : int
        What sums are for the page of the viewer: 0 codes or data, 1 light, 2 its logarithms, 3
        normals.
    """

    encoding: str | None = "srgb"
    affine = True
    is_light = False
    bounded = True
    by_range = False
    figure = "ycbcr"
    numbers: tuple[int, ...] = (1, 3, 4)
    reach = 1.0
    names = "Red", "Green", "Blue"
    to_rgb: NDArray[np.floating] = np.eye(3)
    page_kind = 0

    def __new__(cls, name: str) -> Space:
        """Return the space of a name, see `space_of`; a name that is none raises ValueError."""
        return space_of(name) if cls is Space and name != "rgb" else super().__new__(cls, name)

    def __reduce__(self) -> tuple:
        return space_of, (str(self),)

    # --- Pixels and values -----------------------------------------------------------------------

    @property
    def is_color(self) -> bool:
        """Whether renderings are colours: sRGB or light."""
        return self.encoding is not None

    @property
    def identical(self) -> bool:
        """Whether the sums are the rendering."""
        return type(self).decode is Space.decode

    @property
    def above_white(self) -> Space:
        """The space for an image of light above 1: a texture would clamp the sums of this one."""
        return LOG if self.is_color and self.bounded else self

    @property
    def map_numbers(self) -> tuple[int, ...]:
        """How many channels a map of a set may have."""
        return tuple(number for number in (1, 3) if not self.numbers or number in self.numbers)

    def check(self, pixels: Image) -> None:
        """Raise `eigengs_dr.image.pixels.ImageError` if an image cannot be in this space."""

    def check_channels(self, channels: int) -> None:
        """Raise `BadValue` if a set of this space cannot have so many channels."""
        if self.numbers and channels not in self.numbers:
            *others, last = map(str, self.numbers)
            numbers = f"{', '.join(others)} or {last}" if others else last
            raise BadValue(f"color has {channels} channels; space {str(self)!r} has {numbers}")

    def values_of(self, pixels: Image) -> Image:
        """Convert pixels (H, W, C), sRGB or data, to values, without a copy if they are equal.

        Cost: a pass in strips over the image.
        """
        return pixels

    def decode(self, channels: Sequence[Samples]) -> list[Samples]:
        """Convert values to what a rendering shows: sRGB, light, unit vectors or data.

        Parameters
        ----------
        channels : sequence of NumPy or Dr.Jit arrays, or floats
            One for each channel, all of one shape.

        Returns
        -------
        list of arrays
            As many, not clamped, in the same precision. Differentiable for Dr.Jit arrays.
        """
        return list(channels)

    def decode_image(self, sums: Samples) -> Samples:
        """Convert values (..., C) of NumPy, or a Dr.Jit tensor (H, W, C), as `decode` does."""
        if self.identical:
            return sums
        if isinstance(sums, np.ndarray):
            decoded = self.decode(list(np.moveaxis(sums, -1, 0)))
            return np.stack(decoded, axis=-1).astype(sums.dtype, copy=False)
        return color.by_channel(self.decode, sums)

    def display(self, rendered: Samples) -> Samples:
        """Convert a rendering to display values, elementwise: light is encoded as sRGB.

        Negative light becomes 0; other values are not clamped.
        """
        return rendered

    def display_sums(self, sums: NDArray[np.floating]) -> NDArray[np.floating]:
        """Convert values (..., C) to display values."""
        return np.asarray(self.display(self.decode_image(sums)))

    # --- A fit -----------------------------------------------------------------------------------

    def unit(self, extent: Extent) -> Affine:
        """Return the unit in which values of this extent are fitted."""
        return Affine()

    def weight(self, values: Image) -> Image | None:
        """Return the factors of the squared errors of values; None for 1."""
        return None

    def placement_image(self, values: Image, pixels: Image | None = None) -> Image:
        """Return the image (H, W, C) whose second derivatives place Gaussians.

        Parameters
        ----------
        values : ndarray of float32, shape (H, W, C)
            In the unit of the fit.
        pixels : ndarray of float32, shape (H, W, C), optional
            The display values, if they have the same unit.
        """
        return values

    def grey(self, low: float, high: float, channels: int) -> list[float]:
        """Return the values of an unknown pixel between two bounds."""
        return [(low + high) / 2] * channels

    # --- Figures ---------------------------------------------------------------------------------

    @property
    def has_rgb(self) -> bool:
        """Whether a target in RGB refers to psnr_rgb, which clamps to [0, 1]."""
        return self.figure == "ycbcr"

    def has_codes(self, pixels: Image) -> bool:
        """Return whether pixels are displayed in 8 bits."""
        return True

    def exposure(self, pixels: Image) -> float:
        """Return the factor that brings light (H, W, C), in sRGB, into the range of a display.

        It is 1 unless light may exceed 1 and its mean is far from `GREY`, see `VISIBLE`.
        """
        return 1.0 if self.bounded else exposure_of(Extent.of(color.to_linear(pixels)).mean)

    def comparable(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Convert values to those whose squared errors a packed file keeps small."""
        return values

    @property
    def comparable_name(self) -> str:
        """What the PSNR of `comparable` values is called."""
        return f"psnr in {self}"

    # --- A texture, whose sums are decoded already if that is affine ------------------------------

    @property
    def largest(self) -> float:
        """The value to which a texture clamps channels."""
        return 1.0 if self.bounded else math.inf

    def to_light(self, channel: Samples) -> Samples:
        """Convert a channel to what a texture shows: light, or the data."""
        return color.to_linear(channel)

    def from_light(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the values of light: the inverse of `to_light`."""
        return color.to_coded(light)

    def slope(self, channel: Samples) -> Samples:
        """Return the derivative of `to_light`."""
        return color.slope_to_linear(channel)

    def to_lights(self, channels: Sequence[Samples]) -> list[Samples]:
        """Convert all channels to what a texture shows, clamped; normals get the length 1 instead.

        The clamp conserves energy. Gradients ignore it: else a colour that a step moved out of the
        range would never come back.
        """
        return [self.to_light(color.clamp(channel, self.largest)) for channel in channels]


class _YCbCr(Space):
    """Studio-range YCbCr / 255."""

    numbers = (3,)
    names = "Brightness (Y)", "Yellow to blue (Cb)", "Green to red (Cr)"
    to_rgb = color.YCBCR_TO_RGB

    def values_of(self, pixels: Image) -> Image:
        return by_strips(color.rgb_to_ycbcr, pixels)

    def decode(self, channels: Sequence[Samples]) -> list[Samples]:
        if len(channels) != 3:
            raise ValueError(
                f"space 'ycbcr' needs 3 channels, not {len(channels)}; use space 'data'"
            )
        y, cb, cr = channels
        # Python floats: a NumPy float64 scalar would promote a Dr.Jit float32 array to float64.
        matrix = color.YCBCR_TO_RGB.tolist()
        black = (-color.YCBCR_TO_RGB @ color.YCBCR_OFFSET).tolist()
        return [a * y + b * cb + c * cr + d for (a, b, c), d in zip(matrix, black, strict=True)]


class _Plain(Space):
    """Spaces whose decoded values a texture shows as they are."""

    def to_light(self, channel: Samples) -> Samples:
        return channel

    def from_light(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        return light

    def slope(self, channel: Samples) -> Samples:
        return 1.0


class _Light(_Plain):
    """Spaces of linear light."""

    encoding = "linear"

    def display(self, rendered: Samples) -> Samples:
        return color.to_coded(color.clamp(rendered, math.inf))

    def grey(self, low: float, high: float, channels: int) -> list[float]:
        return [GREY] * channels


class _Linear(_Light):
    """Light up to 1, as textures need it; its errors weigh more in the dark."""

    is_light = True
    page_kind = 1

    @property
    def above_white(self) -> Space:
        return RADIANCE

    def values_of(self, pixels: Image) -> Image:
        return by_strips(color.to_linear, pixels)

    def weight(self, values: Image) -> Image | None:
        return by_strips(lambda part: np.maximum(part, BLACK) ** (-2 * DARKNESS), values)

    def placement_image(self, values: Image, pixels: Image | None = None) -> Image:
        # Linear light would put too few Gaussians into dark parts.
        return by_strips(color.to_coded, values) if pixels is None else pixels

    def comparable(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.asarray(self.display(values))

    @property
    def comparable_name(self) -> str:
        return "sRGB"


class _Radiance(_Linear):
    """Light that may exceed 1. A fit divides it by its mean."""

    bounded = False
    figure = "pu21"

    def unit(self, extent: Extent) -> Affine:
        return Affine(extent.mean / GREY) if extent.mean > 0 else Affine()

    def comparable(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.asarray(color.to_pu21(values))

    @property
    def comparable_name(self) -> str:
        return "PU21"


class _Log(_Light):
    """Logarithms of light, see `eigengs_dr.image.color.to_log`, in the unit of their range."""

    affine = False
    bounded = False
    figure = "pu21"
    reach = BRIGHT
    page_kind = 2

    def values_of(self, pixels: Image) -> Image:
        return by_strips(lambda part: color.to_log(color.to_linear(part)), pixels)

    def decode(self, channels: Sequence[Samples]) -> list[Samples]:
        return [color.from_log(channel) for channel in channels]

    def decode_image(self, sums: Samples) -> Samples:
        return color.from_log(sums)

    def unit(self, extent: Extent) -> Affine:
        return extent.unit

    def grey(self, low: float, high: float, channels: int) -> list[float]:
        return [float(color.to_log(np.float32(GREY)))] * channels

    def to_light(self, channel: Samples) -> Samples:
        return color.from_log(channel)

    def from_light(self, light: NDArray[np.floating]) -> NDArray[np.floating]:
        return color.to_log(light)

    def slope(self, channel: Samples) -> Samples:
        return (color.from_log(channel) + 1 / color.LOG_SLOPE) * math.log1p(color.LOG_SLOPE)


class _Data(_Plain):
    """Anything else: roughness, heights, masks. A fit has the unit of their range."""

    encoding = None
    by_range = True
    figure = "data"
    numbers: tuple[int, ...] = ()

    def unit(self, extent: Extent) -> Affine:
        return extent.unit

    def has_codes(self, pixels: Image) -> bool:
        return Extent.of(pixels).is_of_codes


class _Normal(_Plain):
    """Codes ``(n + 1) / 2`` of normals, whose length a rendering makes 1."""

    encoding = None
    affine = False
    figure = "data"
    numbers = (3,)
    page_kind = 3

    def check(self, pixels: Image) -> None:
        if pixels.shape[2] != 3:
            raise ImageError(
                f"image: shape {pixels.shape}; a normal map has three channels; use space 'data'"
            )
        if pixels.min() < MIN_PIXEL or pixels.max() > MAX_PIXEL:
            raise ImageError(
                f"image: normals run from {pixels.min():g} to {pixels.max():g}, not 0 to 1; pass "
                "(n + 1) / 2"
            )

    def decode(self, channels: Sequence[Samples]) -> list[Samples]:
        return color.unit_codes(channels)

    def grey(self, low: float, high: float, channels: int) -> list[float]:
        return [0.5, 0.5, 1.0]

    def to_lights(self, channels: Sequence[Samples]) -> list[Samples]:
        if len(channels) != 3:
            return super().to_lights(channels)
        return self.decode(channels)


YCBCR = _YCbCr("ycbcr")
RGB = Space("rgb")
LINEAR = _Linear("linear")
DATA = _Data("data")
RADIANCE = _Radiance("radiance")
LOG = _Log("log")
NORMAL = _Normal("normal")

SPACES = (YCBCR, RGB, LINEAR, DATA, RADIANCE, LOG, NORMAL)
"""The spaces of sets, in the order by which packed files number them."""

FAMILY_SPACES = (YCBCR, RGB)
"""The spaces of a family of images."""


def space_of(name: object, spaces: Sequence[Space] = SPACES) -> Space:
    """Return the space of a name.

    Raises
    ------
    ValueError
        If it is none of `spaces`.

    Examples
    --------
    >>> space_of("linear").is_light
    True
    """
    if isinstance(name, str):
        for space in spaces:
            if space == name:
                return space
    raise ValueError(f"space {shown(name)} is unknown; use one of {', '.join(spaces)}")


def to_planes(image: Image, space: str) -> Image:
    """Convert an sRGB image (H, W, 3) to a space of a family, (3, H * W): each channel by rows."""
    planes = np.array(image.reshape(-1, 3).T, order="C")  # never the image itself
    if space_of(space, FAMILY_SPACES).identical:
        return planes
    # Not a matrix product, because BLAS threads would compete with the decoding threads.
    result = np.einsum("ij,jn->in", color.RGB_TO_YCBCR.astype(np.float32), planes)
    result += color.YCBCR_OFFSET.astype(np.float32)[:, None]
    return result
