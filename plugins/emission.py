"""Sampling of emission: positions over uv with a density like the brightness.

The density is that of the cells of a `Survey`, interpolated linearly between their centres, as a
``bitmap`` interpolates its texels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .survey import Survey

DARKEST = 0.005
"""Smallest density of a cell, relative to the mean: light may lie beside its centre. With 0.02, the
share of samples in the dark alone makes the noise of small lamps 14 %."""


@dataclass(frozen=True)
class Emission:
    """A distribution of positions in the unit square.

    Attributes
    ----------
    columns, rows : int
        Number of cells.
    cells : mitsuba.DiscreteDistribution2D
        Probabilities of the cells.
    """

    columns: int
    rows: int
    cells: Any

    def sample(self, sample: Any, active: Any) -> tuple[Any, Any]:
        """Return positions (Point2f) and their densities for samples of the unit square."""
        cell, _, rest = self.cells.sample(sample, active)
        p = mi.Point2f(cell) + 0.5 + mi.warp.square_to_tent(rest)
        # At the borders the tent of a cell folds back into the square.
        p = dr.abs(p) * mi.Point2f(1 / self.columns, 1 / self.rows)
        p = dr.minimum(p, 2 - p)
        return p, self.density(p, active)

    def density(self, p: Any, active: Any) -> Any:
        """Return the density at positions; 0 outside of the unit square."""
        inside = (p.x >= 0) & (p.x <= 1) & (p.y >= 0) & (p.y <= 1)
        x, y = (
            dr.select(inside, v, 0) * n - 0.5 for v, n in ((p.x, self.columns), (p.y, self.rows))
        )
        left, top = dr.floor(x), dr.floor(y)
        across, down = x - left, y - top
        corners = []
        for j in (0, 1):
            for i in (0, 1):
                column = mi.UInt32(dr.clip(left + i, 0, self.columns - 1))
                row = mi.UInt32(dr.clip(top + j, 0, self.rows - 1))
                corners.append(self.cells.pdf(mi.Point2u(column, row), active & inside))
        upper, lower = dr.lerp(*corners[:2], across), dr.lerp(*corners[2:], across)
        return dr.select(inside, dr.lerp(upper, lower, down) * (self.columns * self.rows), 0)


def emission_of(survey: Survey) -> Emission:
    """Return the distribution of emission for a survey of the brightness."""
    density = np.maximum(survey.brightness.numpy(), 0).reshape(survey.rows, survey.columns)
    floor = DARKEST * density.mean() or 1.0
    cells = mi.DiscreteDistribution2D(np.maximum(density, floor))
    return Emission(survey.columns, survey.rows, cells)
