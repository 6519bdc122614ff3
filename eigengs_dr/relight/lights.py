"""Directions of lights, and the table that tells what each of them does to the planes of photos.

A direction is a unit vector towards the light: x to the right of the photo, y up, z towards the
camera, as in the files ``.lp`` of RTI (reflectance transformation imaging).
"""

from __future__ import annotations

import codecs
import os
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, upload
from ..backend.messages import printable, warn
from ..backend.types import ArrayLike, Doubles, Float, PathLike
from ..image.folder import find_lists as find_lists
from ..image.pixels import ImageError
from ..storage.memory import open_regular
from ..storage.npz import BadValue
from .directions import LatLong

HORIZON = -0.02
"""Smallest z of a light: a measured light at the horizon may be a degree below it."""

MAX_LIGHTS = 1 << 12
"""Largest number of lights of a model."""

MIN_Z = 1e-4
"""Smallest z in the harmonics, whose slope is infinite at the horizon."""

KINDS = ("thin_plate", "hsh")
"""Ways to interpolate between lights, see `LightTable`."""

FOLDS = 8
"""Number of parts of the lights, each left out once."""

SEARCHED = LatLong(200, 100)
"""Directions among which a light is found: 10,000 above the horizon, 1.8 degrees apart."""

SHRINKAGE = 0.2
"""How far covariances of factors between planes are drawn to 0: they are of few photos."""


def read_lights(path: PathLike, photos: Any = None) -> tuple[list[Any], Doubles]:
    """Read photos and the directions of their lights from an ``.lp`` file.

    The first line holds the number of photos; each other line holds a name, and x, y and z. The
    file is UTF-8, or UTF-16 with a byte order mark.

    Parameters
    ----------
    path : path-like
    photos : path-like or sequence of path-like, optional
        The folder of the photos, or the photos in any order.

    Returns
    -------
    photos : list
        The paths that the file names, in its order; without `photos`, names without folders. Of
        the folders in a name, which are those of the machine that wrote the file, only those count
        that the folder of photos holds too, or that tell photos apart.
    lights : ndarray of float64, shape (n, 3)
        See `check_lights`.

    Warns
    -----
    UserWarning
        If the first line is another number, and every line names one of `photos`.

    Raises
    ------
    ValueError
        If the file is no such list, does not name `photos`, or names one twice; one line names the
        file and the line. An `ImageError` if a photo is not in the folder.
    OSError
        If the file cannot be opened.
    """
    lines = _lines(path)
    rows = [(k, line.rsplit(maxsplit=3)) for k, line in enumerate(lines[1:], 2) if line.strip()]
    names, lights = [], []
    for number, row in rows:
        try:
            name, x, y, z = row
            lights.append([float(x), float(y), float(z)])
        except ValueError:
            raise ValueError(
                f"{path}: line {number} is {printable(' '.join(row)[:40])!r}; expected a name, x, "
                "y and z, with decimal points"
            ) from None
        names.append(_parts(name) or [name])
    count = lines[0].strip()
    is_right = count.isdecimal() and count.lstrip("0") == str(len(rows))
    note = f"{path}: the first line is {printable(count[:20])!r}, but {len(rows)} photos follow"
    if not is_right and (photos is None or not rows or not count.isdecimal()):
        raise ValueError(f"{note}; it must hold their number")
    directions = check_lights(lights, str(path))
    if photos is None:
        named: list[Any] = ["/".join(parts) for parts in names]
    elif isinstance(photos, (str, os.PathLike)):
        named = _in_folder(Path(photos), names, path)
    else:
        named = _paired(photos, names, path)
    if len(set(named)) < len(named):
        twice = next(name for k, name in enumerate(named) if name in named[:k])
        raise ValueError(
            f"{path}: names {printable(str(twice))} for several lights; give each light a photo of "
            "its own"
        )
    if not is_right:
        warn(f"{note}; all of them are taken")
    return [parts[-1] for parts in names] if photos is None else named, directions


MAX_LIST_BYTES = 1 << 24
"""Largest size of a list of lights."""

MAX_DEPTH = 8
"""Number of names at the end of a path that are compared."""


def _lines(path: PathLike) -> list[str]:
    """Return the lines of a list; bytes of a code page become Python's surrogate escapes."""
    with open_regular(path, once=True) as file:
        content = file.read(MAX_LIST_BYTES + 1)
    if len(content) > MAX_LIST_BYTES:
        limit = MAX_LIST_BYTES >> 20
        raise ValueError(f"{path}: has more than {limit} MB; give a list of lights, .lp")
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    kind, errors = ("utf-16", "strict") if is_wide else ("utf-8-sig", "surrogateescape")
    try:
        text = content.decode(kind, errors)
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise ValueError(
            f"{path}: is no text (line {line}); give a list of lights, .lp, saved as UTF-8"
        )
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _parts(name: PathLike) -> list[str]:
    """Return the folders and the name of a path of any system; those above it are left out."""
    return [
        part
        for part in os.fspath(name).replace("\\", "/").split("/")
        if part not in ("", ".", "..")
    ]


def _in_folder(folder: Path, names: list[list[str]], path: PathLike) -> list[Path]:
    """Return the photos of a list by as many of its folders as there are in the folder."""
    for depth in range(MAX_DEPTH, 0, -1):
        files = [_existing(folder, "/".join(parts[-depth:])) for parts in names]
        if all(files):
            return [file for file in files if file]
    missing = printable("/".join(names[files.index(None)]))
    raise ImageError(f"{folder}: has no file {missing}, which {path} names; check the names")


def _existing(folder: Path, name: str) -> Path | None:
    """Return the file of a name as macOS composes its letters or Windows encodes them, or None."""
    spellings = [name, *(unicodedata.normalize(form, name) for form in ("NFC", "NFD"))]
    spellings.append(name.encode("utf-8", "surrogateescape").decode("cp1252", "replace"))
    return next((folder / s for s in spellings if os.path.isfile(folder / s)), None)


def _paired(photos: Sequence[PathLike], names: list[list[str]], path: PathLike) -> list[PathLike]:
    """Return photos in the order of a list: by their names, or else without case and suffix."""

    def key(parts: list[str], depth: int, is_exact: bool) -> str:
        name = unicodedata.normalize("NFC", "/".join(parts[-depth:]))
        return name if is_exact else os.path.splitext(name)[0].casefold()

    for is_exact in (True, False):
        for depth in range(1, MAX_DEPTH + 1):
            keys = [key(parts, depth, is_exact) for parts in names]
            given = {key(_parts(photo), depth, is_exact): photo for photo in photos}
            if len(set(keys)) == len(keys) == len(photos) and given.keys() == set(keys):
                return [given[k] for k in keys]
    known = {parts[-1] for parts in names}
    other = next((p for p in photos if _parts(p)[-1:] and _parts(p)[-1] not in known), None)
    reason = "some have one name" if other is None else f"it does not name {other}"
    if len(photos) != len(names):
        reason = f"there are {len(photos)} photos, but {len(names)} lights"
    raise ValueError(
        f"{path}: cannot be paired with the photos by name ({printable(reason)}); give the photos "
        "that it names, each once"
    )


def check_lights(lights: ArrayLike, name: str = "lights") -> Doubles:
    """Return directions (n, 3) with length 1.

    Raises
    ------
    ValueError
        If there are none, a value is not finite, or a light is below the horizon, z < 0.
    """
    try:
        given = np.array(lights, np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name}: are no array of numbers; give directions of shape (n, 3)"
        ) from None
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


FLAT = np.sin(np.radians(1))
"""Root mean square of the distances of unit vectors from a line or a plane that is not taken for
noise of the measurement."""


def check_spread(lights: Doubles) -> None:
    """Check that directions (n, 3) of length 1, n > 2, tell what an object shows under others.

    Raises
    ------
    ValueError
        If they are all one direction.

    Warns
    -----
    UserWarning
        If they lie on one arc over the object, such as those of a lamp on a rail.
    """
    _, across, aside = np.linalg.svd(lights, compute_uv=False) / np.sqrt(len(lights))
    if across < FLAT:
        raise ValueError(
            "lights: all come from one direction; a model needs photos under several lights"
        )
    if aside < FLAT:
        warn("lights: all lie on one arc over the object; what other lights show is a guess")


def folds(lights: Doubles) -> list[NDArray[np.bool_]]:
    """Return which lights each part leaves out."""
    count = min(FOLDS, len(lights))
    return [np.arange(len(lights)) % count == fold for fold in range(count)]


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
        rows = self.values.reshape(len(self.values), -1)
        found = solve_table(self.kind, self.smoothing, self.lights, rows)
        return found.reshape(-1, *self.values.shape[1:])

    def at(self, lights: Doubles) -> Doubles:
        """Return the factors for directions (m, 3) of length 1, shape (m, 3, K + 1)."""
        rows = functions_at(self.kind, self.lights, lights)
        return np.tensordot(rows, self.coefficients, 1)

    def changes(self) -> Doubles:
        """Return the factors minus those that a table of other lights gives, (n, 3, K + 1)."""
        changes = self.values.copy()
        for out in folds(self.lights):
            others = replace(self, lights=self.lights[~out], values=self.values[~out])
            changes[out] -= others.at(self.lights[out])
        return changes

    def find(self, shown: Doubles, noise: Doubles) -> tuple[Doubles, float]:
        """Return the light of a photo that shows some factors, see `Relightable.find_light`.

        Between the factors of the photo and those of a table that has not seen it there is a
        difference e, whose covariance C is that of `changes`. Its density is that of a Student
        distribution, as C is estimated from n photos: ``(1 + e^T C^-1 e / n)^(-(n + 1) / 2)``
        (A. Gelman et al.: Bayesian data analysis, CRC Press 2013, section 3.6).

        Parameters
        ----------
        shown : ndarray of float64, shape (3, K + 1)
        noise : ndarray of float64, shape (K + 1, K + 1)
            Covariance of these factors by the noise of a colour of the photo.
        """
        directions = SEARCHED.directions().reshape(-1, 3)
        above = directions[:, 2] > 0
        lights, areas = directions[above], np.repeat(SEARCHED.areas(), SEARCHED.width)[above]
        count = len(self.lights)
        changes = self.changes().reshape(count, -1)
        covariance = changes.T @ changes / count
        covariance *= 1 - SHRINKAGE * (1 - np.eye(len(covariance)))
        covariance += np.kron(np.eye(3), noise)
        difference = (self.at(lights) - shown).reshape(len(lights), -1)
        squares = (difference @ np.linalg.inv(covariance) * difference).sum(axis=1)
        ratio = (count + squares.min()) / (count + squares)  # times a constant, against underflow
        weights = areas * ratio ** ((count + 1) / 2)
        light = weights @ lights
        light /= np.linalg.norm(light)
        angles = np.degrees(np.arccos(np.minimum(lights @ light, 1)))
        return light, float(np.sqrt(np.average(np.square(angles), weights=weights)))

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
