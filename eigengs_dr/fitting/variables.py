"""The variables that a descent moves: the numbers of a Gaussian in units of its own size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias, runtime_checkable

import drjit as dr

from ..backend.arrays import rsqrt, types_of
from ..backend.types import Float, FloatLike, Rows
from ..gaussian.gaussians import Gaussians

Variables: TypeAlias = dict[str, Rows]
"""Variables by name: arrays of Dr.Jit with one or several numbers for each Gaussian."""

ImageSize: TypeAlias = tuple[Float, Float] | None
"""Width and height in arrays, or None for those of the set."""


@runtime_checkable
class Coordinates(Protocol):
    """A change of variables, differentiable by Dr.Jit.

    `fixed` is the set that was encoded; fields without a variable keep its values. `size` is the
    width and the height of `fixed`, in arrays if the program is to serve every size.
    """

    def encode(self, gaussians: Gaussians) -> Variables:
        """Return the variables of a set."""

    def decode(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Gaussians:
        """Return the set of variables."""

    def project(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Variables:
        """Return the variables, moved back into their bounds."""

    def reach(self, fixed: Gaussians, moves: dict[str, float]) -> tuple[FloatLike, float]:
        """Return how far ellipses reach, in pixels and as a factor, if variables move this far."""


MOVE_SHARE, GROWTH_SHARE = 0.17, 0.07
"""How far Gaussians move and grow, relative to the sum of the rates. Steps change direction: with
these shares, lists miss less than 0.1 % of the tiles just before the next build. The strict bounds,
1 and 1, would make the lists 3.4 times as long."""


@dataclass(frozen=True)
class Relative:
    """Mean divided by the size of the Gaussian at the start, factor times this size, and colour.

    The size is the geometric mean of the standard deviations, in pixels: ``det F = a c``. One
    learning rate then serves small and large Gaussians, and images of any size.
    """

    def encode(self, gaussians: Gaussians) -> Variables:
        """Return the variables mean, factor and color; see `Coordinates`."""
        return _in_units(gaussians, _size(gaussians))

    def decode(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Gaussians:
        """Return the set of variables; see `Coordinates`."""
        unit = _size(fixed)
        units: dict[str, FloatLike] = {"mean": unit, "factor": 1 / unit, "color": 1}
        fields: dict = {name: value * units[name] for name, value in variables.items()}
        return replace(fixed, **fields)

    def project(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Variables:
        """Return the variables of bounded Gaussians; see `Coordinates`."""
        inside = _in_units(self.decode(fixed, variables).bounded(size), _size(fixed))
        return {name: inside[name] for name in variables}

    def reach(self, fixed: Gaussians, moves: dict[str, float]) -> tuple[FloatLike, float]:
        """Return how far Gaussians reach after some steps; see `Coordinates`."""
        # An array, because another literal in every build would compile the kernels again.
        share = dr.opaque(types_of(fixed.mean).Float, MOVE_SHARE * moves.get("mean", 0.0))
        return share * _size(fixed), 1 + GROWTH_SHARE * moves.get("factor", 0.0)


def _size(gaussians: Gaussians) -> Float:
    return rsqrt(gaussians.factor[0] * gaussians.factor[2])


def _in_units(gaussians: Gaussians, unit: Float) -> Variables:
    mean, factor = gaussians.mean / unit, gaussians.factor * unit
    return {"mean": mean, "factor": factor, "color": gaussians.color}
