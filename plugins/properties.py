"""The properties of ``gaussian_texture``, and their checks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.file import MAX_CUTOFF
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.gaussian.tensors import FIELDS
from eigengs_dr.image.color import SPACES

from .parameters import FromModel, FromSet
from .shared import shared_file
from .versions import has_footprints

WRAPS = ("repeat", "mirror", "clamp")
"""Names of the ways to continue an image outside of its borders."""


def source_of(props: Any) -> FromSet | FromModel:
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


def _first(props: Any) -> int | None:
    """Read ``first``, the number of Gaussians to use from a file; None for all."""
    value = props.get("first", 0)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"gaussian_texture: first is {value!r}; it must be a number of Gaussians")
    return value or None


def _map(props: Any) -> str | None:
    """Read ``map``, the name of a map of a material; None without this property."""
    value = props.get("map", None)
    if value is not None and not isinstance(value, str):
        raise ValueError(f"gaussian_texture: map is {value!r}; it must be the name of a map")
    return value


def _coefficients(props: Any) -> Any:
    """Read ``coefficients``; None, without this property, stands for the mean image."""
    if "coefficients" not in props:
        return None
    found = np.array(props["coefficients"])
    if found.dtype.kind not in "fiu" or not np.isfinite(found).all():
        raise ValueError("gaussian_texture: coefficients must be finite numbers")
    return found.astype(np.float32)


def _from_arrays(props: Any, backend: str) -> Gaussians:
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


def _path(props: Any, key: str) -> str:
    """Return the path of a file by Mitsuba's resolver, which also looks beside the scene."""
    return str(mi.file_resolver().resolve(props[key]))


def file_name(props: Any) -> str:
    """Return the name of the file of the Gaussians, without folders; "" if there is no file."""
    return next((Path(props[key]).name for key in ("filename", "model") if key in props), "")


def raw(props: Any) -> bool:
    """Read ``raw``: whether lookups skip decoding and clamping."""
    value = props.get("raw", False)
    if not isinstance(value, bool):
        raise ValueError(f"gaussian_texture: raw is {value!r}; it must be a boolean")
    return value


def _number(props: Any, key: str, default: float) -> float:
    value = props.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"gaussian_texture: {key} is {value!r}; it must be a number")
    return float(value)


def cutoff(props: Any, default: float) -> float:
    """Read ``cutoff`` in standard deviations; by default the cutoff of the set."""
    value = _number(props, "cutoff", default)
    if not 0 < value <= MAX_CUTOFF:
        raise ValueError(
            f"gaussian_texture: cutoff is {value}; it must be above 0 and at most {MAX_CUTOFF:g}"
        )
    return value


def prefilter(props: Any) -> tuple[float, bool]:
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


def wrap_mode(props: Any) -> str:
    """Read ``wrap_mode``, one of `WRAPS`."""
    wrap = str(props.get("wrap_mode", "repeat"))
    if wrap not in WRAPS:
        raise ValueError(
            f"gaussian_texture: wrap_mode {wrap!r} is unknown; use one of {', '.join(WRAPS)}"
        )
    return wrap
