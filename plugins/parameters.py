"""Sets in scenes: as dictionaries of plugins, as texels of bitmaps, and back from parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import types_of, upload
from eigengs_dr.backend.entry_points import entry_point
from eigengs_dr.backend.types import Record, Tensor
from eigengs_dr.gaussian.gaussians import (
    FIELDS,
    Fitted,
    Gaussians,
    from_tensors,
    one_image,
    set_of,
    to_tensors,
)
from eigengs_dr.image.color import to_linear
from eigengs_dr.raster.render import render
from eigengs_dr.relight.directions import LatLong
from eigengs_dr.relight.model import Relightable


@entry_point
def texture_of(gaussians: Gaussians | Fitted, **properties: object) -> Record:
    """Return a set as the dictionary of a ``gaussian_texture``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    **properties
        Other properties of the texture: ``wrap_mode``, ``to_uv``, ``raw``, ``prefilter``,
        ``cutoff``, ``memory``, ``texels``. None stands for the default.

    Returns
    -------
    dict
        The tensors, size, space and cutoff of the set, and the other properties.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import texture_of
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> bsdf = mi.load_dict({"type": "diffuse", "reflectance": texture_of(g, wrap_mode="clamp")})
    """
    return plugin_of("gaussian_texture", gaussians, **properties)


@entry_point
def environment_of(gaussians: Gaussians | Fitted, **properties: object) -> Record:
    """Return a set as the dictionary of a ``gaussian_environment``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians or Fit
        A set of light in equirectangular projection: twice as wide as high.
    **properties
        Other properties of the emitter: ``scale``, ``to_world``, ``prefilter``, ``cutoff``,
        ``memory``. None stands for the default.

    Returns
    -------
    dict
        The tensors, size, space and cutoff of the set, and the other properties.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import environment_of
    >>> mi.set_variant("llvm_ad_rgb")
    >>> eg.register_plugins()
    >>> sky = eg.Gaussians.from_arrays(
    ...     [[8, 4]], [[0.2, 0, 0.2]], [[9, 9, 8]], size=(16, 8), space="radiance"
    ... )
    >>> scene = mi.load_dict({"type": "scene", "sky": environment_of(sky, scale=0.5)})
    """
    return plugin_of("gaussian_environment", gaussians, **properties)


@entry_point
def material_of(model: Relightable, **properties: object) -> Record:
    """Return a model of lights as the dictionary of a ``gaussian_relightable``.

    Parameters
    ----------
    model : Relightable
        The dictionary for `mitsuba.load_dict` holds it: no file is needed.
    **properties
        Other properties of the material: ``scale``, ``wrap_mode``, ``to_uv``, ``prefilter``,
        ``memory``, ``texels``. None stands for the default.

    Returns
    -------
    dict
        The planes as of `texture_of`, the table of lights, and the other properties.

    Raises
    ------
    TypeError
        If it is no model of lights.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import material_of
    >>> model = eg.Relightable.load("coin.npz")  # doctest: +SKIP
    >>> coin = {"type": "rectangle", "bsdf": material_of(model, scale=2)}  # doctest: +SKIP
    """
    if not isinstance(model, Relightable):
        raise TypeError(f"material_of takes a Relightable, not {type(model).__name__}")
    table = model.table
    arrays = {"lights": table.lights, "values": table.values}
    return {
        **plugin_of("gaussian_relightable", model.planes),
        **{name: upload(mi.TensorXf, np.float32(array)) for name, array in arrays.items()},
        "kind": table.kind,
        "smoothing": table.smoothing,
        "brightest": model.brightest,
        **given(properties),
    }


@entry_point
def bake_environment(
    gaussians: Gaussians, width: int | None = None, height: int | None = None, **properties: object
) -> Record:
    """Render a set to the bitmap of an ``envmap``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians
        A set of three channels, in equirectangular projection: twice as wide as high.
    width, height : int, optional
        Size of the bitmap in pixels, as for `eigengs_dr.render`; by default the native size.
    **properties
        Other properties of the emitter: ``scale``, ``to_world``.

    Returns
    -------
    dict
        The emitter with a bitmap of linear light; negative light is 0. Its first and last rows are
        the poles, as an ``envmap`` reads them.

    Raises
    ------
    ValueError
        If the set has other channels, or holds data, or the bitmap has one row.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import bake_environment
    >>> mi.set_variant("llvm_ad_rgb")
    >>> sky = eg.Gaussians.from_arrays(
    ...     [[8, 4]], [[0.2, 0, 0.2]], [[9, 9, 8]], size=(16, 8), space="radiance"
    ... )
    >>> scene = mi.load_dict({"type": "scene", "sky": bake_environment(sky)})
    """
    if gaussians.channels != 3 or not gaussians.space.is_color:
        raise ValueError(
            f"bake_environment: the set has {gaussians.channels} channels in the space "
            f"{gaussians.space!r}; it needs three of light or colour"
        )
    if height is None:
        ratio = 1.0 if width is None else width / gaussians.width
        height = round(ratio * gaussians.height)
    picture = render(_from_pole_to_pole(gaussians, height), width, height).numpy()
    light = to_linear(picture) if gaussians.space.encoding == "srgb" else picture
    bitmap = mi.Bitmap(np.maximum(light, 0).astype(np.float32))
    return {"type": "envmap", "bitmap": bitmap, **given(properties)}


def _from_pole_to_pole(gaussians: Gaussians, rows: int) -> Gaussians:
    """Move Gaussians, so that the centres of the outermost of so many rows show the poles.

    They do in the native rows: `eigengs_dr.plugins.gaussian_environment`.
    """
    if min(rows, gaussians.height) < 2:
        raise ValueError(
            f"bake_environment: {min(rows, gaussians.height)} rows; the set and the bitmap must "
            "have at least 2, one for each pole"
        )
    types, native = types_of(gaussians.mean), gaussians.height
    now, then = (LatLong(gaussians.width, n, pole_to_pole=True) for n in (native, rows))
    stretch = then.rows / now.rows * (native / rows)
    ratio, border = (dr.opaque(types.Float, v) for v in (stretch, (native / rows - stretch) / 2))
    (x, y), (a, b, c) = gaussians.mean, gaussians.factor
    return replace(
        gaussians,
        mean=types.Float2(x, dr.fma(y, ratio, border)),
        factor=types.Float3(a, b / ratio, c / ratio),
    )


def plugin_of(plugin: str, gaussians: Gaussians | Fitted, **properties: object) -> Record:
    """Return a set as the dictionary of a plugin."""
    gaussians = one_image(set_of(gaussians))
    tensors = to_tensors(gaussians)
    # Mitsuba would try to read a flat tensor of three numbers as a colour, and fail.
    tensors["background"] = tensors["background"][None]
    return {
        "type": plugin,
        **tensors,
        "width": gaussians.width,
        "height": gaussians.height,
        "space": gaussians.space,
        "cutoff": gaussians.cutoff,
        **given(properties),
    }


def given(properties: Record) -> Record:
    """Return the properties that are not None, which would end the process in Mitsuba 3.9."""
    return {name: value for name, value in properties.items() if value is not None}


@entry_point
def gaussians_of(parameters: Mapping[str, object], texture: str, like: Gaussians) -> Gaussians:
    """Read a set back from the parameters of a texture, differentiably.

    Parameters
    ----------
    parameters : dict-like
        A `mitsuba.SceneParameters`, or an optimiser.
    texture : str
        Name of the texture in `parameters`, such as ``"poster.bsdf.reflectance"``; "" for those of
        a texture alone.
    like : Gaussians
        The set that the texture was made from. It gives the size, the space and the tensors that
        `parameters` lacks.

    Returns
    -------
    Gaussians

    Raises
    ------
    ValueError
        If there is no tensor of this texture, or the shapes of the tensors do not match.
    """
    return from_tensors(_tensors_in(parameters, texture), like)


@entry_point
def keep_in_bounds(parameters: mi.SceneParameters, texture: str, like: Gaussians) -> None:
    """Project the parameters of a texture into their bounds, after a step of an optimiser.

    The function applies `eigengs_dr.Gaussians.bounded`: means stay in the image, standard
    deviations in their range, and values that are not finite are replaced.

    Parameters
    ----------
    parameters, texture, like
        See `gaussians_of`. The function changes only entries of `parameters` that exist.
    """
    tensors = _tensors_in(parameters, texture)
    bounded = to_tensors(dr.detach(from_tensors(tensors, like)).bounded())
    for name in tensors:
        parameters[_key(texture, name)] = bounded[name]


def _key(texture: str, name: str) -> str:
    return f"{texture}.{name}" if texture else name


def _tensors_in(parameters: Mapping[str, object], texture: str) -> Record:
    keys = {name: _key(texture, name) for name in FIELDS}
    found = {name: parameters[key] for name, key in keys.items() if key in parameters}
    if not found:
        raise ValueError(
            f"the parameters have no {' and no '.join(keys.values())}; give the name of the "
            "texture in mitsuba.traverse, such as 'poster.bsdf.reflectance'"
        )
    return found


def texels_of(parameters: mi.SceneParameters, key: str, picture: Tensor) -> Tensor:
    """Return a picture as the texels of a parameter; an ``envmap`` has extra columns.

    Parameters
    ----------
    parameters : mitsuba.SceneParameters
    key : str
        Name of the texels.
    picture : TensorXf, shape (H, W, C)

    Returns
    -------
    TensorXf
        Differentiable. For an ``envmap``, light is clamped at 0, and columns beyond the seam are
        added.
    """
    node = parameters.properties[key][2]
    if not isinstance(node, mi.Emitter):
        return mi.TensorXf(picture)
    height, width, channels = picture.shape
    left, right = columns_beyond()
    column = np.arange(-left, width + right) % width
    texel = (np.arange(height)[:, None] * width + column)[..., None] * channels
    index = upload(mi.UInt32, (texel + np.arange(channels)).astype(np.uint32).ravel())
    light = dr.gather(mi.Float, dr.maximum(picture.array, 0), index)
    return mi.TensorXf(light, (height, width + left + right, channels))


@cache
def columns_beyond() -> tuple[int, int]:
    """Return how many columns an ``envmap`` repeats beyond its left and its right border.

    Mitsuba 3.9 repeats one on both sides, and others one on the right side alone.
    """
    columns = 4
    black = mi.Bitmap(np.zeros((columns, columns, 3), np.float32))
    small = mi.load_dict({"type": "envmap", "bitmap": black})
    beyond = mi.traverse(small)["data"].shape[1] - columns
    return beyond // 2, beyond - beyond // 2
