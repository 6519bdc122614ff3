"""Gaussians that stay in the window of a fit, which cannot see what they draw beyond it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from ..backend.arrays import types_of
from ..backend.recording import exclusive
from ..gaussian.gaussians import Gaussians


@dataclass
class WindowGaussians(Gaussians):
    """Gaussians that may not grow beyond the sides of a window where the image goes on.

    Without this bound, 1 % of the Gaussians of a long fit grow far into other blocks, at a loss of
    0.3 dB (1,024x1,024 pixels in blocks of 256, 1,000 steps).

    Attributes
    ----------
    reach : Array2f, shape (2, N)
        How far each may reach from its mean along x and y, in pixels, wherever it lies.
    open_sides : tuple of bool
        Whether the image goes on beyond the left, upper, right and lower side of the window.
    """

    reach: Any = None
    open_sides: tuple[bool, bool, bool, bool] = (False, False, False, False)

    @classmethod
    def in_window(
        cls, gaussians: Gaussians, halo: float, open_sides: tuple[bool, bool, bool, bool]
    ) -> WindowGaussians:
        """Bind Gaussians to a window: each may reach as far as now, a halo, or to the sides."""
        types = types_of(gaussians.mean)
        a, b, c = gaussians.factor
        x = gaussians.cutoff * dr.sqrt(1 + dr.square(b / c)) / a
        reach = types.Float2(dr.maximum(x, halo), dr.maximum(gaussians.cutoff / c, halo))
        dr.eval(reach)
        values = {name: getattr(gaussians, name) for name in Gaussians.__dataclass_fields__}
        return cls(**values, reach=reach, open_sides=open_sides)

    @exclusive()
    def bounded(self, size: tuple[Any, Any] | None = None) -> WindowGaussians:
        """Clip every parameter to its bounds, and the factor to what the window allows.

        For `size` see `eigengs_dr.Gaussians.bounded`.
        """
        inside = super().bounded(size)
        width, height = (self.width, self.height) if size is None else size
        left, top, right, bottom = self.open_sides
        (x, y), (a, b, c) = inside.mean, inside.factor
        reach_x = self._allowed(self.reach[0], x, left, width - x, right)
        reach_y = self._allowed(self.reach[1], y, top, height - y, bottom)
        if reach_y is not None:
            c = dr.maximum(c, self.cutoff / reach_y)
        if reach_x is not None:
            a = dr.maximum(a, self.cutoff * dr.sqrt(1 + dr.square(b / c)) / reach_x)
        bound: WindowGaussians = replace(self, mean=inside.mean, color=inside.color)
        return replace(bound, factor=type(inside.factor)(a, b, c), background=inside.background)

    @staticmethod
    def _allowed(reach: Any, before: Any, opens: bool, after: Any, closes: bool) -> Any:
        """Return how far Gaussians may reach along one axis; None for any distance."""
        sides = [distance for distance, open_ in ((before, opens), (after, closes)) if open_]
        if not sides:
            return None
        return dr.maximum(reach, dr.minimum(sides[0], sides[-1]))
