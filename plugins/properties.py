"""The properties of ``gaussian_texture`` and their checks; also the parameter ``to_uv``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.file import MAX_CUTOFF
from eigengs_dr.gaussian.gaussians import FIELDS, Gaussians
from eigengs_dr.image.color import SPACES

from .parameters import FromModel, FromSet, shared_file
from .versions import Properties, has_footprints


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


def read_transform(props: Properties) -> Any:
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


WRAPS = ("repeat", "mirror", "clamp")
"""Names of the ways to continue an image outside of its borders."""


def source_of(props: Properties) -> FromSet | FromModel:
    """Read the Gaussians from the properties ``filename``, ``model`` or ``mean``, ...

    Raises
    ------
    ValueError
        If none or several of these properties are given, a file has other content, or a set does
        not have one or three channels.
    """
    given = [key for key in ("filename", "model", "mean") if key in props]
    if len(given) != 1:
        raise ValueError(
            "gaussian_texture: give one of filename (a saved set), model (a saved EigenGS) or "
            f"mean, factor, color, ... (see texture_of); got {' and '.join(given) or 'none'}"
        )
    backend = "cuda" if "cuda" in mi.variant() else "llvm"
    if given[0] == "model":
        model = EigenGS.load(_path(props, "model"), backend)
        return FromModel(model, _coefficients(props))
    shared = None
    if given[0] == "filename":
        shared = shared_file(_path(props, "filename"), backend, _first(props))
        gaussians = shared.map(_map(props))
    else:
        gaussians = _from_arrays(props, backend)
    if gaussians.channels not in (1, 3):
        raise ValueError(
            f"gaussian_texture: the set has {gaussians.channels} channels; use a set of 1 or 3"
        )
    return FromSet(gaussians, shared)


def _first(props: Properties) -> int | None:
    """Read ``first``, the number of Gaussians to use from a file; None for all."""
    value = props.get("first", 0)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"gaussian_texture: first is {value!r}; it must be a number of Gaussians")
    return value or None


def _map(props: Properties) -> str | None:
    """Read ``map``, the name of a map of a material; None without this property."""
    value = props.get("map", None)
    if value is not None and not isinstance(value, str):
        raise ValueError(f"gaussian_texture: map is {value!r}; it must be the name of a map")
    return value


def _coefficients(props: Properties) -> Any:
    """Read ``coefficients``; None, without this property, stands for the mean image."""
    if "coefficients" not in props:
        return None
    found = np.array(props["coefficients"])
    if found.dtype.kind not in "fiu" or not np.isfinite(found).all():
        raise ValueError("gaussian_texture: coefficients must be finite numbers")
    return found.astype(np.float32)


def _from_arrays(props: Properties, backend: str) -> Gaussians:
    """Read a set from the properties of `texture_of`."""
    missing = [key for key in (*FIELDS, "width", "height", "space") if key not in props]
    if missing:
        raise ValueError(f"gaussian_texture: {missing[0]} is missing; see texture_of")
    for key in ("width", "height"):
        if not isinstance(props[key], int):
            raise ValueError(f"gaussian_texture: {key} is {props[key]!r}; it must be an integer")
    if props["space"] not in SPACES:
        raise ValueError(f"gaussian_texture: space {props['space']!r} is not in {SPACES}")
    mean, factor, color, background = (np.array(props[key]) for key in FIELDS)
    return Gaussians.from_arrays(
        mean,
        factor,
        color,
        background.ravel(),
        size=(props["width"], props["height"]),
        space=props["space"],
        backend=backend,
    )


def _path(props: Properties, key: str) -> str:
    """Return the path of a file by Mitsuba's resolver, which also looks beside the scene."""
    return str(mi.file_resolver().resolve(props[key]))


def file_name(props: Properties) -> str:
    """Return the name of the file of the Gaussians, without folders; "" if there is no file."""
    return next((Path(props[key]).name for key in ("filename", "model") if key in props), "")


def raw(props: Properties) -> bool:
    """Read ``raw``: whether lookups skip decoding and clamping."""
    value = props.get("raw", False)
    if not isinstance(value, bool):
        raise ValueError(f"gaussian_texture: raw is {value!r}; it must be a boolean")
    return value


def _number(props: Properties, key: str, default: float) -> float:
    value = props.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"gaussian_texture: {key} is {value!r}; it must be a number")
    return float(value)


def cutoff(props: Properties, default: float) -> float:
    """Read ``cutoff`` in standard deviations; by default the cutoff of the set."""
    value = _number(props, "cutoff", default)
    if not 0 < value <= MAX_CUTOFF:
        raise ValueError(
            f"gaussian_texture: cutoff is {value}; it must be above 0 and at most {MAX_CUTOFF:g}"
        )
    return value


def prefilter(props: Properties) -> tuple[float, bool]:
    """Read ``prefilter``: the angle of a pixel in radians, or 0 for lookups at points.

    Returns
    -------
    angle : float
    follows : bool
        Whether the footprints of rays alone decide: ``true``.
    """
    if props.get("prefilter", 0.0) is True:
        if not has_footprints():
            raise ValueError(
                "gaussian_texture: prefilter = true needs Mitsuba 3.10, and this is "
                f"{mi.__version__}; give the angle of a pixel in radians, see pixel_angle"
            )
        return 0.0, True
    value = _number(props, "prefilter", 0.0)
    if not 0 <= value < 1:
        raise ValueError(
            f"gaussian_texture: prefilter is {value}; it is the angle of a pixel in radians, "
            "at least 0 and below 1"
        )
    return value, False


def wrap_mode(props: Properties) -> str:
    """Read ``wrap_mode``, one of `WRAPS`."""
    wrap = str(props.get("wrap_mode", "repeat"))
    if wrap not in WRAPS:
        raise ValueError(
            f"gaussian_texture: wrap_mode {wrap!r} is unknown; use one of {', '.join(WRAPS)}"
        )
    return wrap
