"""The sum of Gaussians at scattered points, for the lookups of textures.

The cost of a point depends on the Gaussians near it, not on the size of the set. Virtual function
calls of Dr.Jit do not support custom derivatives, so Dr.Jit's own autodiff gives the gradients with
respect to the packed parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from ...backend.arrays import rcp, types_of
from ...backend.types import Bool, Float, Mask, UInt
from ..evaluate import LN2, inverted, weights
from ..parameters import NUM_SHAPE_PARAMS, kernel_radius, unpack_parameters
from .cells import CellLists
from .coding import Coding

Terms = Callable[..., list]
"""``terms(shape, color, x, y, *shared)`` returns what a Gaussian adds to each sum at a point."""


@dataclass(frozen=True)
class Packed:
    """Parameters of Gaussians, as sums read them.

    Attributes
    ----------
    values : Float
        From `eigengs_dr.raster.lookup.cells.CellLists.pack`: 5 of the shape, then the channels; may
        carry gradients.
    channels : int
    cutoff : float
        Standard deviations.
    inverted : bool
        Whether the rows are those of `invert`, for sums over footprints.
    coding : Coding or None
        What decodes the rows, if they hold words of it, without gradients.
    """

    values: Float
    channels: int
    cutoff: float
    inverted: bool = False
    coding: Coding | None = None

    @property
    def radius(self) -> float:
        """The cutoff in the units of the kernels."""
        return kernel_radius(self.cutoff)

    def gather(self, row: UInt, active: Mask = True) -> tuple[list, list]:
        """Return the shape and the channels in rows, as they are stored."""
        if self.coding is not None:
            words = unpack_parameters(self.values, row, self.coding.words, active)
            shape, color = self.coding.decode(words)
            return shape, times_determinant(shape, color) if self.inverted else color
        number = NUM_SHAPE_PARAMS + self.channels
        values = unpack_parameters(self.values, row, number, active)
        return values[:NUM_SHAPE_PARAMS], values[NUM_SHAPE_PARAMS:]

    def decode(self, shape: list, color: list) -> tuple[list, list]:
        """Return the shape and the channels of Gaussians from rows."""
        if not self.inverted:
            return shape, color
        mean_x, mean_y, p, t, r = shape
        a, c = rcp(p), rcp(r)
        return [mean_x, mean_y, a, -t * a * c, c], [k * a * c for k in color]


def invert(shape: list, color: list) -> tuple[list, list]:
    """Return the parameters of Gaussians from which sums over footprints take fewer operations.

    Parameters
    ----------
    shape, color : list of Float, shape (N,)

    Returns
    -------
    shape : list of 5 Float
        See `eigengs_dr.raster.evaluate.inverted`.
    color : list of Float
        The colours times the determinant of the inverse.
    """
    shape = inverted(shape)
    return shape, times_determinant(shape, color)


def times_determinant(shape: list, color: list) -> list:
    """Return colours times the determinant of an inverse."""
    determinant = shape[2] * shape[4]
    return [k * determinant for k in color]


def fold(x: Float, side: int, wrap: str) -> tuple[Float, Float]:
    """Move a coordinate into the image.

    Parameters
    ----------
    x : Float
        In pixels.
    side : int
        Width or height of the image, in pixels.
    wrap : {"repeat", "mirror", "clamp"}
        Continuation of the image outside its borders. "clamp" repeats the centres of the outermost
        pixels, as Mitsuba's ``bitmap``: further out, Gaussians fall off.

    Returns
    -------
    x : Float
        In [0, side], with "clamp" in [0.5, side - 0.5]; NaN and infinities become 0, or 0.5.
    slope : Float
        The derivative: 1, or -1 in a mirrored copy, or 0 in a clamped part.
    """
    x = dr.select(dr.isfinite(x), x, 0)
    one = type(x)(1)
    if wrap == "clamp":
        first, last = 0.5, side - 0.5
        return dr.clip(x, first, last), dr.select((x >= first) & (x <= last), one, 0)
    period = dr.floor(x * (1 / side))
    # Far from the image, rounding errors exceed its size.
    local = dr.clip(dr.fma(period, -side, x), 0, side)
    if wrap == "repeat":
        return local, one
    odd = dr.fma(-2, dr.floor(0.5 * period), period) == 1
    return dr.select(odd, side - local, local), dr.select(odd, -one, one)


def axes_of(wrap: str) -> tuple[str, str]:
    """Return how an image continues along x and along y.

    On a "sphere" in equirectangular projection, columns repeat, and rows come back beyond a pole:
    on the other side, which a mirror ignores. A footprint beyond a pole sees all sides of it.
    """
    return ("repeat", "mirror") if wrap == "sphere" else (wrap, wrap)


def near_image(x: Float, side: int) -> Float:
    """Move a coordinate close to a clamped image, where footprints see the same as further out.

    The longest reach 1.2 sides. What is not finite becomes 0.

    Parameters
    ----------
    x : Float
        In pixels.
    side : int
        Width or height of the image, in pixels.
    """
    return dr.clip(dr.select(dr.isfinite(x), x, 0), -1.5 * side, 2.5 * side)


def sum_at_points(
    lists: CellLists,
    packed: Packed,
    x: Float,
    y: Float,
    active: Bool,
    terms: Terms,
    count: int | None = None,
) -> list:
    """Sum the contributions of the Gaussians near a point.

    Cost: one gather of parameters and one call of `terms` for each Gaussian in the list of the
    cell, on the first level.

    Parameters
    ----------
    lists : CellLists
    packed : Packed
    x, y : Float
        In pixels, x to the right and y down; inside the image.
    active : Bool
    terms : callable
        See `Terms`.
    count : int, optional
        Number of sums, by default the number of channels.

    Returns
    -------
    list of `count` Float
    """
    ends = lists.range_at(lists.levels[0], dr.detach(x), dr.detach(y), active)
    return sum_range(lists, ends, packed, x, y, terms, count)


def sum_range(
    lists: CellLists,
    ends: tuple[UInt, UInt],
    packed: Packed,
    x: Float,
    y: Float,
    terms: Terms,
    count: int | None = None,
    shared: tuple[Float, ...] = (),
) -> list:
    """Sum the Gaussians in the runs from begin to end, with another range at each point.

    Derivatives flow back to what `terms` take as `shared`, not to what they read as closures.
    """
    types = types_of(packed.values)
    first = lists.first_at(dr.detach(y))

    def add(i: UInt, end: UInt, x: Float, y: Float, shared: tuple, sums: list) -> tuple:
        here = i < end
        for number in lists.numbers_at(types, i, here):
            parts = terms(*packed.gather(number + first, here), x, y, *shared)
            sums = [s + t for s, t in zip(sums, parts, strict=True)]
        return i + 1, end, x, y, shared, sums

    # max_iterations=-1 tells Dr.Jit that the loop is a pure sum: its gradient needs no storage.
    return dr.while_loop(
        (*ends, x, y, shared, [types.Float(0) for _ in range(count or packed.channels)]),
        lambda i, end, *rest: i < end,
        add,
        label="sum at points",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def value_terms(packed: Packed) -> Terms:
    """Return the `Terms` of the values ``c_n w_n(x)``."""

    def terms(shape: list, color: list, x: Float, y: Float) -> list:
        shape, color = packed.decode(shape, color)
        (w,) = weights(shape, x, y, (1, 1), packed.radius)
        return [w * c for c in color]

    return terms


def gradient_terms(packed: Packed) -> Terms:
    """Return the `Terms` of values and derivatives along x and y: three for each channel.

    ``grad w = -2 ln(2) w F^T F (x - mu)`` with F in the units of the kernels, see
    `eigengs_dr.raster.parameters.EXP2_SCALE`.
    """

    def terms(shape: list, color: list, x: Float, y: Float) -> list:
        shape, color = packed.decode(shape, color)
        mean_x, mean_y, a, b, c = shape
        (w,) = weights(shape, x, y, (1, 1), packed.radius)
        dx, dy = x - mean_x, y - mean_y
        u, v = dr.fma(a, dx, b * dy), c * dy
        steep = -2 * LN2 * w
        along = (w, steep * a * u, steep * dr.fma(b, u, c * v))
        return [k * value for value in color for k in along]

    return terms
