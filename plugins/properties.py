"""The properties of the plugins and their checks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.selection import backend_of
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.file import LIGHTS, MAX_CUTOFF, kind_of
from eigengs_dr.gaussian.gaussians import FIELDS, Gaussians, to_tensors
from eigengs_dr.image.formats import SUFFIXES
from eigengs_dr.image.space import SPACES
from eigengs_dr.relight.lights import LightTable, check_table
from eigengs_dr.relight.model import Relightable, check_brightest
from eigengs_dr.storage.npz import BadValue

from .lookup import MEMORIES, Memory
from .sources import (
    FamilySource,
    FileSource,
    LightSource,
    Source,
    read_planes,
    shared_file,
    without_arrays,
)

FILES = ("filename", "model", "planes")
"""Properties that name the file of the Gaussians."""

PLANES = (*FIELDS, "width", "height", "space", "cutoff")
PLANES += ("wrap_mode", "to_uv", "prefilter", "memory", "texels")
"""Properties of a ``gaussian_relightable`` that are those of the texture of its planes."""

UP = (0.0, 0.0, 1.0)
"""Default light of a relightable model: from the camera."""

WRAPS = ("repeat", "mirror", "clamp")
"""Names of the ways to continue an image outside of its borders."""


def _mistake(props: mi.Properties, key: str, value: object, must: str) -> ValueError:
    return ValueError(f"{props.plugin_name()}: {key} is {value!r}; it must be {must}")


def _read(props: mi.Properties, key: str, default: object, kind: type, must: str) -> Any:
    """Read a property of a type. A boolean is no number, and an integer is one."""
    value = props.get(key, default)
    allowed = (int, float) if kind is float else kind
    if isinstance(value, bool) != (kind is bool) or not isinstance(value, allowed):
        raise _mistake(props, key, value, must)
    return kind(value)


def _count(props: mi.Properties, key: str, things: str) -> int:
    """Read a number of things, by default 0."""
    value = int(_read(props, key, 0, int, f"a number of {things}"))
    if value < 0:
        raise _mistake(props, key, value, f"a number of {things}")
    return value


def source_of(props: mi.Properties) -> Source:
    """Read the Gaussians from the properties ``filename``, ``model`` or ``mean``, ...

    Of a ``gaussian_relightable``, they are those of its model, under ``planes``.

    Raises
    ------
    ValueError
        If none or several of these properties are given, a file has other content, or a set
        has more than three channels.
    """
    given = [key for key in (*FILES, "mean") if key in props]
    if len(given) != 1:
        raise ValueError(
            f"{props.plugin_name()}: give one of filename (a saved set), model (a saved EigenGS or "
            "Relightable) or mean, factor, color, ... (see texture_of); got "
            f"{' and '.join(given) or 'none'}"
        )
    backend = backend_of(mi.variant())
    lit = given[0] == "model" and props.plugin_name() == "gaussian_texture"
    if lit and kind_of(path(props, "model")) == LIGHTS:
        model = Relightable.load(path(props, "model"), backend)
        return LightSource(model, np.array(props.get("light", UP), np.float32).ravel())
    if given[0] == "model":
        coefficients = props.get("coefficients", None)
        if coefficients is not None:
            coefficients = np.array(coefficients)
            if coefficients.dtype.kind not in "fiu" or not np.isfinite(coefficients).all():
                raise ValueError(f"{props.plugin_name()}: coefficients must be finite numbers")
        return FamilySource(EigenGS.load(path(props, "model"), backend), coefficients)
    if given[0] == "planes":
        shared = shared_file(path(props, "planes"), backend, None, memory(props).coded, read_planes)
        return FileSource(shared, None)
    if given[0] == "filename":
        first = _count(props, "first", "Gaussians")
        name = _read(props, "map", "", str, "the name of a map")
        file = path(props, "filename")
        if Path(file).suffix.lower() in SUFFIXES:
            bitmap = "envmap" if props.plugin_name() == "gaussian_environment" else "bitmap"
            raise ValueError(
                f"{file}: is an image, not a set of Gaussians; make one by 'eigengs-dr fit', or "
                f"give the image to the plugin {bitmap}"
            )
        shared = shared_file(file, backend, first or None, memory(props).coded)
        source: Source = FileSource(shared, name or None)
    else:
        gaussians = _from_arrays(props, backend)
        source = Source(without_arrays(gaussians), to_tensors(gaussians))
    if source.start.channels > 3 and not raw(props):
        raise ValueError(
            f"{props.plugin_name()}: the set has {source.start.channels} channels; "
            "use a set of 1 to 3"
        )
    return source


def lit_planes(props: mi.Properties) -> tuple[LightTable, float, mi.Properties]:
    """Read the model of a ``gaussian_relightable``: ``model``, or the arrays of `material_of`.

    Returns
    -------
    table : LightTable
    brightest : float
    planes : mitsuba.Properties
        Those of the texture of its planes, a channel for each.

    Raises
    ------
    ValueError
        If a file or an array is invalid.
    """
    plugin = props.plugin_name()
    planes = mi.Properties(plugin)
    planes.set_id(props.id())
    planes["raw"] = True
    if "lights" not in props:
        if "model" not in props:
            raise ValueError(f"{plugin}: give model, the file of a saved or packed Relightable")
        planes["planes"] = path(props, "model")
        model = Relightable.load(planes["planes"], backend_of(mi.variant()))
        table, brightest = model.table, model.brightest
    else:
        lights, values, color = (np.array(props[key]) for key in ("lights", "values", "color"))
        smoothing = _read(props, "smoothing", 0.0, float, "a number")
        table = LightTable(lights, values, str(props.get("kind", "")), smoothing)
        brightest = _read(props, "brightest", 1.0, float, "a number")
        try:
            table = check_table(table, color.shape[-1])
            check_brightest(brightest)
        except BadValue as error:
            raise ValueError(f"{plugin}: {error}") from None
    for key in PLANES:
        if key in props:
            planes[key] = props[key]
    return table, brightest, planes


def _from_arrays(props: mi.Properties, backend: str | None) -> Gaussians:
    """Read a set from the properties of `texture_of`."""
    missing = [key for key in (*FIELDS, "width", "height", "space") if key not in props]
    if missing:
        raise ValueError(f"{props.plugin_name()}: {missing[0]} is missing; see texture_of")
    width, height = (_read(props, key, 0, int, "an integer") for key in ("width", "height"))
    if props["space"] not in SPACES:
        raise ValueError(f"{props.plugin_name()}: space {props['space']!r} is not in {SPACES}")
    mean, factor, color, background = (np.array(props[key]) for key in FIELDS)
    size, space, flat = (width, height), props["space"], background.ravel()
    return Gaussians.from_arrays(mean, factor, color, flat, size=size, space=space, backend=backend)


def path(props: mi.Properties, key: str) -> str:
    """Return the path of a file by Mitsuba's resolver, which also looks beside the scene."""
    name = _read(props, key, None, str, "the path of a file")
    return str(mi.file_resolver().resolve(name))


def file_name(props: mi.Properties) -> str:
    """Return the name of the file of the Gaussians, without folders; "" if there is no file."""
    return next((Path(props[key]).name for key in FILES if key in props), "")


def raw(props: mi.Properties) -> bool:
    """Read ``raw``: whether lookups skip decoding and clamping."""
    return bool(_read(props, "raw", False, bool, "a boolean"))


def cutoff(props: mi.Properties, default: float) -> float:
    """Read ``cutoff`` in standard deviations; by default the cutoff of the set."""
    value = float(_read(props, "cutoff", default, float, "a number"))
    if not 0 < value <= MAX_CUTOFF:
        raise _mistake(props, "cutoff", value, f"above 0 and at most {MAX_CUTOFF:g}")
    return value


def memory(props: mi.Properties) -> Memory:
    """Read ``memory``, one of `MEMORIES`; by default "exact" for arrays, for files "normal"."""
    name = props.get("memory", "exact" if "mean" in props else "normal")
    if not isinstance(name, str) or name not in MEMORIES:
        raise _mistake(props, "memory", name, f"one of {', '.join(MEMORIES)}")
    return MEMORIES[name]


def prefilter(props: mi.Properties) -> tuple[float, bool]:
    """Read ``prefilter``: the angle of a pixel in radians, or 0 for lookups at points.

    Returns
    -------
    angle : float
    follows : bool
        Whether footprints come from rays or from the sensor that renders: ``true``.
    """
    if props.get("prefilter", 0.0) is True:
        return 0.0, True
    value = _read(props, "prefilter", 0.0, float, "true, or the angle of a pixel in radians")
    return check_angle(value, props.plugin_name()), False


def texels(props: mi.Properties, start: Gaussians) -> tuple[int, int] | None:
    """Read ``texels``: columns and rows of texels for the picture of a set, or None.

    Raises
    ------
    ValueError
        If it is not a number, or `memory` is given too, which texels lack.
    """
    longer = _count(props, "texels", "texels")
    if not longer:
        return None
    if "memory" in props:
        raise ValueError(f"{props.plugin_name()}: texels have no memory; give one of them")
    scale = longer / max(start.width, start.height)
    return max(1, round(scale * start.width)), max(1, round(scale * start.height))


def light_scale(props: mi.Properties) -> float:
    """Read ``scale``, the factor of light."""
    value = float(_read(props, "scale", 1.0, float, "a number"))
    if not 0 <= value < math.inf:
        raise _mistake(props, "scale", value, "finite, and at least 0")
    return value


def number_of(array: mi.Float, name: str, plugin: str) -> float:
    """Return the number that a parameter holds; raise `ValueError` if it holds none or several."""
    numbers = dr.detach(array).numpy().tolist()
    if len(numbers) != 1:
        raise ValueError(f"{plugin}: {name} holds {len(numbers)} numbers; it must hold one")
    return float(numbers[0])


def check_scale(scale: mi.Float, plugin: str) -> None:
    """Raise `ValueError` if a factor of light that has changed is not one, see `light_scale`.

    A frozen function, in which numbers cannot be read, is not checked.
    """
    if not dr.flag(dr.JitFlag.FreezingScope):
        value = number_of(scale, "scale", plugin)
        if not 0 <= value < math.inf:
            raise ValueError(f"{plugin}: scale is {value}; it must be finite, and at least 0")


def check_light(gaussians: Gaussians, plugin: str) -> None:
    """Raise `ValueError` if a set is not light from all directions."""
    if gaussians.channels not in (1, 3) or not gaussians.space.is_color:
        raise ValueError(
            f"{plugin}: the set has {gaussians.channels} channels in the space "
            f"{gaussians.space!r}; it needs one or three of light or colour"
        )
    if min(gaussians.width, gaussians.height) < 2:
        raise ValueError(
            f"{plugin}: the picture has {gaussians.width}x{gaussians.height} pixels; it needs two "
            "along each side, from pole to pole"
        )


def check_rotation(transform: mi.AffineTransform4f) -> None:
    """Raise `ValueError` if a transform of directions is not a rotation, perhaps mirrored."""
    matrix = np.array(transform.matrix, np.float64)
    if matrix.size != 16:
        raise ValueError("gaussian_environment: to_world holds several transforms; give one")
    matrix = matrix.reshape(4, 4)[:3, :3]
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3):
        raise ValueError(
            "gaussian_environment: to_world scales or shears directions; it must be a rotation"
        )


def check_angle(value: float, plugin: str) -> float:
    """Return the angle of a pixel; raise `ValueError` if it is not one."""
    if not 0 <= value < 1:
        raise ValueError(
            f"{plugin}: prefilter is {value}; it is the angle of a pixel in radians, "
            "at least 0 and below 1"
        )
    return value


def check_known(props: mi.Properties) -> None:
    """Raise `ValueError` if there are properties that were not read."""
    if unknown := props.unqueried():
        raise ValueError(f"{props.plugin_name()}: it has no property {' and '.join(unknown)}")


def wrap_mode(props: mi.Properties) -> str:
    """Read ``wrap_mode``, one of `WRAPS`."""
    wrap = str(props.get("wrap_mode", "repeat"))
    if wrap not in WRAPS:
        raise ValueError(
            f"{props.plugin_name()}: wrap_mode {wrap!r} is unknown; use one of {', '.join(WRAPS)}"
        )
    return wrap


def to_uv(props: mi.Properties) -> mi.ScalarTransform3f:
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
        If it is not a transform, or holds several.
    """
    transform = props.get("to_uv", mi.ScalarTransform3f())
    if not hasattr(transform, "matrix"):
        raise _mistake(props, "to_uv", transform, "a transform")
    matrix = np.array(transform.matrix, np.float64)
    if matrix.ndim == 3:  # of arrays of Dr.Jit
        if matrix.shape[2] != 1:
            raise ValueError(
                f"{props.plugin_name()}: to_uv holds {matrix.shape[2]} transforms; it must hold one"
            )
        matrix = matrix[..., 0]
    rows = [[*row[:2], row[-1]] for row in matrix[:2]]
    return mi.ScalarTransform3f([*rows, [0, 0, 1]])


def check_invertible(transform: mi.ScalarTransform3f, plugin: str) -> None:
    """Raise `ValueError` if a transform of uv is not finite, or maps the plane to a line."""
    matrix = np.array(transform.matrix, np.float64)
    linear = matrix[:2, :2]
    area, size = abs(np.linalg.det(linear)), np.square(linear).sum()
    if not (np.isfinite(matrix).all() and area > 1e-9 * size):
        raise ValueError(f"{plugin}: to_uv maps the plane to a line; it must be invertible")
