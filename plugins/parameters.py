"""The parameters of a texture: the Gaussians of a set, or the coefficients of an eigenbasis."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import upload
from eigengs_dr.backend.doors import door
from eigengs_dr.backend.types import Record
from eigengs_dr.gaussian.gaussians import (
    FIELDS,
    Fitted,
    Gaussians,
    from_tensors,
    one_image,
    set_of,
    to_tensors,
)
from eigengs_dr.relight.model import Relightable


@door
def texture_of(gaussians: Gaussians | Fitted, **properties: object) -> Record:
    """Return a set as the dictionary of a ``gaussian_texture``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    **properties
        Other properties of the texture: ``wrap_mode``, ``to_uv``, ``raw``, ``prefilter``,
        ``cutoff``, ``memory``. None stands for the default.

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


@door
def material_of(model: Relightable, **properties: object) -> Record:
    """Return a model of lights as the dictionary of a ``gaussian_relightable``.

    Parameters
    ----------
    model : Relightable
        The dictionary for `mitsuba.load_dict` holds it: no file is needed.
    **properties
        Other properties of the material: ``scale``, ``wrap_mode``, ``to_uv``, ``prefilter``,
        ``memory``. None stands for the default.

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


@door
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


@door
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
