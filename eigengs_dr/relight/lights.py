"""Directions of lights, and the table that tells what each of them does to the planes of photos.

A direction is a unit vector towards the light: x to the right of the photo, y up, z towards the
camera, as in the files ``.lp`` of RTI (reflectance transformation imaging).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from ..backend.arrays import ArrayTypes, upload
from ..backend.types import ArrayLike, Doubles, Float
from ..storage.npz import BadValue

HORIZON = -0.02
"""Smallest z of a light: a measured light at the horizon may be a degree below it."""

MAX_LIGHTS = 1 << 12
"""Largest number of lights of a model."""

MIN_Z = 1e-4
"""Smallest z in the harmonics, whose slope is infinite at the horizon."""

KINDS = ("thin_plate", "hsh")
"""Ways to interpolate between lights, see `LightTable`."""


def read_lights(path: str | os.PathLike[str]) -> tuple[list[str], Doubles]:
    """Read the names of photos and the directions of their lights from an ``.lp`` file.

    The first line holds the number of photos; each other line holds a name, and x, y and z.

    Returns
    -------
    names : list of str
        Without folders, which are those of the machine that wrote the file.
    lights : ndarray of float64, shape (n, 3)
        See `check_lights`.

    Raises
    ------
    ValueError
        If the file is no such list; one line names the file and the line.
    OSError
        If the file cannot be opened.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is no text; give a list of lights, .lp") from None
    rows = [(k + 2, line.rsplit(maxsplit=3)) for k, line in enumerate(lines[1:]) if line.strip()]
    names, lights = [], []
    for number, row in rows:
        try:
            name, x, y, z = row
            lights.append([float(x), float(y), float(z)])
        except ValueError:
            raise ValueError(
                f"{path}: line {number} is {' '.join(row)[:40]!r}; expected a name, x, y and z"
            ) from None
        names.append(name.replace("\\", "/").rpartition("/")[2])
    if not lines or lines[0].strip() != str(len(rows)):
        given = lines[0].strip()[:20] if lines else ""
        raise ValueError(
            f"{path}: the first line is {given!r}, but {len(rows)} photos follow; it must hold "
            "their number"
        )
    return names, check_lights(lights, str(path))


def check_lights(lights: ArrayLike, name: str = "lights") -> Doubles:
    """Return directions (n, 3) with length 1.

    Raises
    ------
    ValueError
        If there are none, a value is not finite, or a light is below the horizon, z < 0.
    """
    given = np.array(lights, np.float64)
    if given.ndim != 2 or given.shape[1] != 3 or not 1 <= len(given) <= MAX_LIGHTS:
        raise ValueError(
            f"{name}: lights have shape {given.shape}; expected (n, 3) with n up to {MAX_LIGHTS}"
        )
    length = np.linalg.norm(given, axis=1)
    bad = np.flatnonzero(~(np.isfinite(length) & (length > 0)))
    if len(bad):
        raise ValueError(
            f"{name}: light {bad[0] + 1} is {given[bad[0]].tolist()}, which is no direction"
        )
    unit = given / length[:, None]
    below = np.flatnonzero(unit[:, 2] < HORIZON)
    if len(below):
        x, y, z = given[below[0]]
        raise ValueError(
            f"{name}: light {below[0] + 1} is {x:g}, {y:g}, {z:g}, below the horizon; z points "
            "from the object to the camera and must not be negative"
        )
    return np.asarray(unit)


@dataclass(frozen=True, eq=False)
class LightTable:
    """The factors of planes for every light: known for some, interpolated between them.

    A photo under the light l is ``sum_k t_ck(l) P_k(x) + t_cK(l)`` in its channel c, with the
    planes P_k.

    Attributes
    ----------
    lights : ndarray of float64, shape (n, 3)
        Unit vectors.
    values : ndarray of float64, shape (n, 3, K + 1)
        The factors of K planes for these lights, and last what is added to all pixels.
    kind : {"thin_plate", "hsh"}
        "thin_plate" interpolates by ``sum_i a_i r_i^2 log r_i`` with the distances r_i between unit
        vectors, plus a linear function: c.p.d. in any number of dimensions (G. Wahba: Spline models
        for observational data, SIAM 1990). "hsh" regresses on the first nine hemispherical
        harmonics (P. Gautron et al.: A novel hemispherical basis for accurate and efficient
        rendering, EGSR 2004).
    smoothing : float
        Added to the diagonal of the equations.
    """

    lights: Doubles
    values: Doubles
    kind: str
    smoothing: float

    @cached_property
    def coefficients(self) -> Doubles:
        """The factors of the functions of a direction, shape (B, 3, K + 1)."""
        found = solve_table(self.kind, self.smoothing, self.lights, self.values_as_rows)
        return found.reshape(-1, *self.values.shape[1:])

    @property
    def values_as_rows(self) -> Doubles:
        """The values of each light in a row."""
        return self.values.reshape(len(self.values), -1)

    def at(self, lights: Doubles) -> Doubles:
        """Return the factors for directions (m, 3) of length 1, shape (m, 3, K + 1)."""
        rows = functions_at(self.kind, self.lights, lights)
        return np.tensordot(rows, self.coefficients, 1)

    def factors(self, types: ArrayTypes, light: Sequence[Float]) -> list[list[Float]]:
        """Return the factors for one direction of any length, three lists of K + 1 Floats.

        Differentiable by the direction.
        """
        scale = 1 / dr.sqrt(sum(dr.square(v) for v in light))  # exact on cuda too
        x, y, z = (v * scale for v in light)
        centres = [upload(types.Float, column) for column in self.lights.T]
        basis = dr.concat(_functions(self.kind, (x, y, z), centres, dr))
        flat = self.coefficients.reshape(len(self.coefficients), -1).T
        count, number = flat.shape
        index = dr.arange(types.UInt, count * number) % number
        products = dr.gather(types.Float, basis, index) * upload(types.Float, flat.ravel())
        sums = dr.block_sum(products, number)
        every = [dr.gather(types.Float, sums, types.UInt(k)) for k in range(count)]
        length = self.values.shape[2]
        return [every[c * length : (c + 1) * length] for c in range(3)]


def solve_table(kind: str, smoothing: float, lights: Doubles, rows: Doubles) -> Doubles:
    """Return the factors of the functions, (B, m), that fit rows (n, m), one for each light."""
    basis = functions_at(kind, lights, lights)
    if kind == "hsh":
        normal = basis.T @ basis + smoothing * np.eye(basis.shape[1])
        return np.asarray(np.linalg.solve(normal, basis.T @ rows))
    n, number = basis.shape
    linear = basis[:, n:]
    # Lights on a circle do not determine a linear function: the last block makes it small.
    matrix = np.block([[basis], [linear.T, -TINY * np.eye(number - n)]])
    matrix[:n, :n] += smoothing * np.eye(n)
    right = np.concatenate([rows, np.zeros((number - n, rows.shape[1]))])
    return np.asarray(np.linalg.solve(matrix, right))


TINY = 1e-9
"""Diagonal of the equations for the linear function."""


def functions_at(kind: str, centres: Doubles, lights: Doubles) -> Doubles:
    """Return the functions of directions (m, 3) as a matrix (m, B)."""
    columns = tuple(lights.T[:, :, None])
    return np.concatenate(_functions(kind, columns, list(centres.T), np), axis=1)


def _functions(kind: str, light: Sequence[Any], centres: Sequence[Any], xp: Any) -> list[Any]:
    """Return the functions of a direction, by NumPy or Dr.Jit: arrays to be concatenated.

    The distances to all centres are one array. The harmonics are written in x, y and z, so that
    they are smooth at the pole: ``cos(phi) sqrt(z - z^2) = x sqrt(z / (1 + z))``.
    """
    x, y, z = light
    one = x * 0 + 1
    if kind == "thin_plate":
        u, v, w = centres
        square = (x - u) * (x - u) + (y - v) * (y - v) + (z - w) * (z - w)
        return [0.5 * square * xp.log(xp.maximum(square, 1e-20)), one, x, y, z]
    z = xp.maximum(z, MIN_Z)
    root, ratio, tilt = xp.sqrt(z / (1 + z)), z / (1 + z), 2 * z - 1
    first = [one, x * root, tilt, y * root]
    second = [(x * x - y * y) * ratio, tilt * x * root, 6 * z * z - 6 * z + 1, tilt * y * root]
    return [*first, *second, 2 * x * y * ratio]


def check_table(table: LightTable, planes: int) -> LightTable:
    """Return a table from a file, with lights of length 1; `BadValue` if a part is invalid."""
    if table.kind not in KINDS:
        raise BadValue(f"kind is {table.kind[:20]!r}, expected one of {', '.join(KINDS)}")
    expected = (len(table.lights), 3, planes + 1)
    if table.values.shape != expected:
        raise BadValue(f"values have shape {table.values.shape}, expected {expected}")
    if not (np.isfinite(table.values).all() and np.abs(table.values).max() <= MAX_FACTOR):
        raise BadValue(f"values must be finite and at most {MAX_FACTOR:g}")
    if not 0 < table.smoothing <= 1:
        raise BadValue(f"smoothing is {table.smoothing}, expected up to 1")
    try:
        return replace(table, lights=check_lights(table.lights))
    except ValueError as error:
        raise BadValue(str(error)) from None


MAX_FACTOR = 1e6
"""Largest factor of a plane in a file."""
