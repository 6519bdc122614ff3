"""Grids of directions: latitudes and longitudes of all, an octahedron of those above a plane."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from ..backend.types import Doubles, Float


class LatLong(NamedTuple):
    """A picture of all directions, as an ``envmap`` of Mitsuba: the first row is up (y).

    Columns go around, with the one that is seen along -z in the middle of the left and the right
    border. A point of the picture is (u, v), from 0 to 1 each.

    Attributes
    ----------
    width, height : int
        In pixels.
    pole_to_pole : bool
        Whether the first and the last row have their centres at the poles, as those of an
        ``envmap``; else the poles are the borders of these rows, half a row beyond.
    """

    width: int
    height: int
    pole_to_pole: bool = False

    @property
    def rows(self) -> int:
        """Number of rows from pole to pole."""
        return self.height - self.pole_to_pole

    def row(self, v: Any) -> Any:
        """Return the row of v in pixels, where the first one ends at 1."""
        return v * self.rows + 0.5 * self.pole_to_pole

    @staticmethod
    def direction(u: Any, v: Any, xp: Any = dr) -> tuple[list, Any]:
        """Return the direction of a point, by Dr.Jit or NumPy: x, y, z, and the sine of its angle.

        The angle is that from the pole.
        """
        angle, turn = v * math.pi, u * (2 * math.pi)
        sine = xp.sin(angle)
        return [xp.sin(turn) * sine, xp.cos(angle), -xp.cos(turn) * sine], sine

    @staticmethod
    def uv(x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        """Return the point of a direction of length 1."""
        u = dr.atan2(x, -z) * dr.inv_two_pi
        return u - dr.floor(u), dr.safe_acos(y) * dr.inv_pi

    @staticmethod
    def area(sine: Any) -> Any:
        """Return the solid angle of a unit of (u, v)."""
        return 2 * math.pi**2 * sine

    def directions(self) -> Doubles:
        """Return the directions of the centres of pixels, shape (H, W, 3)."""
        u, v = (np.arange(self.width) + 0.5) / self.width, self._heights()[:, None]
        return np.stack(np.broadcast_arrays(*self.direction(u, v, np)[0]), -1)

    def areas(self) -> Doubles:
        """Return the solid angle of the pixels of each row, shape (H,)."""
        return self.area(np.sin(self._heights() * math.pi)) / (self.width * self.rows)

    def _heights(self) -> Doubles:
        """Return v of the centres of rows."""
        return (np.arange(self.height) + 0.5 - self.row(0.0)) / self.rows


class Octahedron(NamedTuple):
    """A grid of R x R directions above a plane, turned by 45 degrees: a corner is on an axis."""

    resolution: int

    def directions(self) -> Doubles:
        """Return the directions row by row, (R^2, 3): unit vectors, z up."""
        across = np.linspace(-1, 1, self.resolution)
        column, row = np.meshgrid(across, across)
        x, y = (column - row).ravel() / 2, (column + row).ravel() / 2
        found = np.stack([x, y, np.maximum(1 - abs(x) - abs(y), 0)], axis=1)
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))

    def uv(self, x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        """Return the point of a direction of any length, from 0 to 1 over the grid.

        The first and the last direction lie at the centres of the outer cells.
        """
        length = dr.abs(x) + dr.abs(y) + dr.maximum(z, 0)
        scale = 0.5 * (self.resolution - 1) / self.resolution / dr.maximum(length, 1e-20)
        return (x + y) * scale + 0.5, (y - x) * scale + 0.5
