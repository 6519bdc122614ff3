"""Forms of the covariance of a 2D Gaussian: factor, Cholesky factor.

A Gaussian has the covariance ``Sigma = (F^T F)^-1`` with the upper triangular *factor*
``F = [[a, b], [0, c]]``, a > 0 and c > 0. Functions on NumPy arrays compute in double precision.
Functions of the Cholesky factor take Dr.Jit arrays and are differentiable.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import rsqrt
from ..backend.types import Float, Floats


def factor_from_covariance(xx: Floats, xy: Floats, yy: Floats) -> NDArray[np.float64]:
    """Return the factors of covariances: ``F^T F = Sigma^-1``.

    Parameters
    ----------
    xx, xy, yy : ndarray, shape (N,)
        Entries of ``Sigma = [[xx, xy], [xy, yy]]``, positive definite.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        a, b, c.
    """
    a = np.sqrt(yy / (xx * yy - xy * xy))
    return np.stack([a, -xy / yy * a, 1 / np.sqrt(yy)], axis=-1).astype(np.float64)


def max_deviation(a: Floats, b: Floats, c: Floats) -> NDArray[np.float64]:
    """Return the largest standard deviation of each Gaussian: the root of the larger eigenvalue.

    Parameters
    ----------
    a, b, c : ndarray, shape (N,)
        Entries of the factors.

    Returns
    -------
    ndarray of float64, shape (N,)
        In pixels if the factors are in 1 / pixels.
    """
    ia, t, ic = 1 / a, -b / (a * c), 1 / c  # F^-1 = [[ia, t], [0, ic]]
    middle = 0.5 * (ia * ia + t * t + ic * ic)
    root = np.sqrt(np.maximum(middle * middle - (ia * ic) ** 2, 0))
    return np.asarray(np.sqrt(middle + root), np.float64)


def outline(factor: Floats) -> NDArray[np.float64]:
    """Return points of the ellipses at one standard deviation, relative to the mean.

    Parameters
    ----------
    factor : ndarray, shape (N, 3)
        a, b, c.

    Returns
    -------
    ndarray of float64, shape (N, 25, 2)
        x, y with ``|F (x, y)| = 1``, the first point twice; not finite if a or c is zero.
    """
    turn = np.linspace(0, 2 * np.pi, 25)
    a, b, c = np.asarray(factor, np.float64).T[:, :, None]
    with np.errstate(all="ignore"):
        y = np.sin(turn) / c
        x = (np.cos(turn) - b * y) / a
    return np.stack([x, y], axis=2)


# ---------------------------------------------------------------------------------------------
#  The average over a box, on Dr.Jit arrays
# ---------------------------------------------------------------------------------------------


def add_variances(
    a: Float, b: Float, c: Float, xx: Float, yy: Float
) -> tuple[tuple[Float, Float, Float], Float]:
    """Add variances along x and y to a covariance: ``Sigma' = Sigma + diag(xx, yy)``.

    With ``C = 1 + yy c^2`` and ``D = det Sigma' / det Sigma = 1 + xx a^2 + yy b^2 + yy c^2 +
    xx yy a^2 c^2``, sums of squares that do not cancel, the new factor is
    ``a sqrt(C / D), b / sqrt(C D), c / sqrt(C)``.

    Parameters
    ----------
    a, b, c : Float, shape (N,)
    xx, yy : Float, shape (1,)
        At least 0, in pixels squared if the factors are in 1 / pixels.

    Returns
    -------
    factor : tuple of 3 Float, shape (N,)
    amplitude : Float, shape (N,)
        ``sqrt(det Sigma / det Sigma')``: a colour times it keeps its integral.
    """
    rows = 1 + yy * dr.square(c)
    columns = 1 + xx * dr.square(a)
    amplitude, narrower = rsqrt(dr.fma(rows, columns, yy * dr.square(b))), rsqrt(rows)
    return (a * dr.sqrt(rows) * amplitude, b * narrower * amplitude, c * narrower), amplitude


# ---------------------------------------------------------------------------------------------
#  The Cholesky factor of the covariance, on Dr.Jit arrays
# ---------------------------------------------------------------------------------------------


def cholesky_from_factor(a: Float, b: Float, c: Float) -> tuple[Float, Float, Float]:
    """Return l1, l2, l3 of ``L = [[l1, 0], [l2, l3]]`` with ``Sigma = L L^T``.

    Parameters
    ----------
    a, b, c : Float, shape (N,)

    Returns
    -------
    l1, l2, l3 : Float, shape (N,)
        l1 and l3 are positive.
    """
    # Sigma = F^-1 F^-T = [[1 / a^2 + b^2 / (a c)^2, -b / (a c^2)], [., 1 / c^2]]
    l1 = dr.sqrt(dr.square(1 / a) + dr.square(b / (a * c)))
    return l1, -b / (a * c * c * l1), 1 / (a * c * l1)


def factor_from_cholesky(l1: Float, l2: Float, l3: Float) -> tuple[Float, Float, Float]:
    """Return a, b, c with ``F^T F = (L L^T)^-1``; inverse of `cholesky_from_factor`.

    Parameters
    ----------
    l1, l2, l3 : Float, shape (N,)

    Returns
    -------
    a, b, c : Float, shape (N,)
    """
    yy = dr.square(l2) + dr.square(l3)
    a = dr.sqrt(yy) / dr.abs(l1 * l3)
    return a, -l1 * l2 / yy * a, rsqrt(yy)
