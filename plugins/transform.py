"""The transform of uv before a lookup: the property and parameter ``to_uv``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class UvTransform:
    """An invertible affine map of the plane.

    Attributes
    ----------
    rows : tuple of 2 tuples of 3 Float, or None
        (m00, m01, translation) of each row; None for the identity. They are no literals, so that
        another transform compiles no other programs.
    inverse : tuple of 4 Float
        Rows of the inverse of the linear part.
    """

    rows: tuple | None
    inverse: tuple

    def apply(self, uv: Any) -> tuple[Any, Any]:
        """Return the coordinates of points of type `mitsuba.Point2f`."""
        if self.rows is None:
            return uv.x, uv.y
        (a, b, tu), (c, d, tv) = self.rows
        return a * uv.x + b * uv.y + tu, c * uv.x + d * uv.y + tv

    def pull_back(self, du: Any, dv: Any) -> tuple[Any, Any]:
        """Return the derivatives over uv, given those over the transformed coordinates."""
        if self.rows is None:
            return du, dv
        (a, b, _), (c, d, _) = self.rows
        return a * du + c * dv, b * du + d * dv


def read_transform(props: Any) -> Any:
    """Read ``to_uv``, by default the identity.

    Parameters
    ----------
    props : mitsuba.Properties
        A 3x3 or 4x4 transform; row and column 3 of a 4x4 transform are left out. Unlike a
        ``bitmap``, the texture also takes ``mitsuba.Transform4f``, if it holds one transform.

    Returns
    -------
    mitsuba.ScalarTransform3f

    Raises
    ------
    ValueError
        If it is no transform, or several at once.
    """
    if "to_uv" not in props:
        return mi.ScalarTransform3f()
    transform = props["to_uv"]
    if not hasattr(transform, "matrix"):
        raise ValueError(f"gaussian_texture: to_uv is {transform!r}; it must be a transform")
    matrix = np.array(transform.matrix, np.float64)
    if matrix.ndim == 3:  # of arrays of Dr.Jit
        if matrix.shape[2] != 1:
            raise ValueError(
                f"gaussian_texture: to_uv holds {matrix.shape[2]} transforms; it must hold one"
            )
        matrix = matrix[..., 0]
    rows = [[*row[:2], row[-1]] for row in matrix[:2]]
    return mi.ScalarTransform3f([*rows, [0, 0, 1]])


def prepare(transform: Any) -> UvTransform:
    """Upload a transform for lookups.

    Parameters
    ----------
    transform : mitsuba.ScalarTransform3f

    Raises
    ------
    ValueError
        If it is not finite, or maps the plane to a line.
    """
    matrix = np.array(transform.matrix, np.float64)
    linear = matrix[:2, :2]
    area, size = abs(np.linalg.det(linear)), np.square(linear).sum()
    if not (np.isfinite(matrix).all() and area > 1e-9 * size):
        raise ValueError("gaussian_texture: to_uv maps the plane to a line; it must be invertible")
    rows, inverse = matrix[:2], np.linalg.inv(linear).ravel()
    if (rows == np.eye(3)[:2]).all():
        return UvTransform(None, tuple(inverse.tolist()))
    upload = [[dr.opaque(mi.Float, float(v)) for v in values] for values in (*rows, inverse)]
    return UvTransform((tuple(upload[0]), tuple(upload[1])), tuple(upload[2]))
