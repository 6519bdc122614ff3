"""Where a texture's Gaussians come from: a set, or the coefficients of an eigenbasis."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.arrays import types_of
from eigengs_dr.eigengs import EigenGS
from eigengs_dr.gaussians import Gaussians

ARRAYS = ("means", "factors", "colors", "background")
"""Parameters of a texture from a set; without the first three, one from a model has others."""


def properties_of(gaussians: Gaussians) -> dict[str, Any]:
    """Write a set as the properties of a ``gaussian_texture``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians

    Returns
    -------
    dict
        ``type``, and the set's arrays, size and space; add ``wrap_mode`` and others as you like.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import properties_of
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> mi.load_dict({"type": "diffuse", "reflectance": properties_of(g)}).id()
    ''
    """
    arrays = gaussians.to_arrays()
    named = zip(ARRAYS, ("mean", "factor", "color", "background"), strict=True)
    return {
        "type": "gaussian_texture",
        # A flat tensor of three would make Mitsuba try, and complain, to read it as a colour.
        **{name: mi.TensorXf(np.atleast_2d(arrays[key])) for name, key in named},
        "width": gaussians.width,
        "height": gaussians.height,
        "space": gaussians.space,
    }


def bound_parameters(parameters: Any, texture: str, width: int, height: int) -> None:
    """Bring the parameters of a texture back inside their bounds after a step of an optimiser.

    What `eigengs_dr.Gaussians.bounded` does: means stay in the image, factors where a splat is
    neither a spike nor a sheet, and what is not finite is replaced.

    Parameters
    ----------
    parameters : dict-like
        A `mitsuba.ad.Optimizer` or `mitsuba.SceneParameters`; entries it lacks are left alone.
    texture : str
        Name of the texture in it, such as ``"poster.bsdf.reflectance"``.
    width, height : int
        Native size of the set.
    """
    keys = {name: f"{texture}.{name}" for name in ARRAYS if f"{texture}.{name}" in parameters}
    found = {name: dr.detach(parameters[key]) for name, key in keys.items()}
    types = types_of(mi.Float)
    whole = Gaussians(
        mean=types.Float2(*_columns(found["means"])) if "means" in found else types.Float2(0),
        factor=types.Float3(*_columns(found["factors"])) if "factors" in found else types.Float3(1),
        color=found["colors"].array if "colors" in found else types.Float(0),
        background=found["background"].array if "background" in found else types.Float(0),
        width=width,
        height=height,
    ).bounded()
    flat = {
        "means": lambda: dr.ravel(whole.mean, order="F"),
        "factors": lambda: dr.ravel(whole.factor, order="F"),
        "colors": lambda: whole.color,
        "background": lambda: whole.background,
    }
    for name, key in keys.items():
        parameters[key] = mi.TensorXf(flat[name](), found[name].shape)


class FromSet:
    """Means (N, 2), factors (N, 3), colors (N, C) and background (C,) are the parameters.

    In native pixels, and in the space of the set, as in `eigengs_dr.Gaussians`.
    """

    shaping = ("means", "factors")
    """Parameters after whose change splats must be listed anew."""

    def __init__(self, gaussians: Gaussians) -> None:
        arrays = gaussians.to_arrays()
        self.means = mi.TensorXf(arrays["mean"])
        self.factors = mi.TensorXf(arrays["factor"])
        self.colors = mi.TensorXf(arrays["color"])
        self.background = mi.TensorXf(arrays["background"])
        self.start = gaussians

    def put(self, callback: Any) -> None:
        """Show the parameters to `mitsuba.traverse`."""
        for name in ARRAYS:
            callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def gaussians(self) -> Gaussians:
        """Put the parameters together; gradients flow back to them.

        Raises
        ------
        ValueError
            If they do not fit each other.
        """
        start = self.start
        types = types_of(start.mean)
        count, channels = self.means.shape[0], start.channels
        for name, shape in (
            ("means", (count, 2)),
            ("factors", (count, 3)),
            ("colors", (count, channels)),
            ("background", (channels,)),
        ):
            found = tuple(getattr(self, name).shape)
            if found != shape or not count:
                raise ValueError(f"gaussian_texture: {name} has shape {found}, expected {shape}")
        return replace(
            start,
            mean=types.Float2(*_columns(self.means)),
            factor=types.Float3(*_columns(self.factors)),
            color=types.FloatX(_columns(self.colors)),
            background=types.FloatX(_entries(self.background)),
        )


class FromModel:
    """Coefficients (C, k) of an `eigengs_dr.EigenGS` model are the one parameter.

    ``colors = mean colors + coefficients x weights`` for every channel; shapes stay. Channels with
    fewer components than others ignore the rest of their row.
    """

    shaping = ()

    def __init__(self, model: EigenGS, coefficients: Any = None) -> None:
        self.start = model.gaussians
        channels, most = len(model.weights), max(model.components)
        weights = np.zeros((channels, most, len(self.start) + 1), np.float32)
        for padded, own in zip(weights, model.weights, strict=True):
            padded[: len(own)] = own
        self.weights = [mi.TensorXf(np.ascontiguousarray(w.T)) for w in weights]
        if coefficients is None:
            coefficients = np.zeros((channels, most), np.float32)
        self.coefficients = mi.TensorXf(coefficients)

    def put(self, callback: Any) -> None:
        """Show the coefficients to `mitsuba.traverse`."""
        callback.put("coefficients", self.coefficients, mi.ParamFlags.Differentiable)

    def gaussians(self) -> Gaussians:
        """Multiply weights and coefficients; gradients flow back to these.

        Raises
        ------
        ValueError
            If their shape is wrong.
        """
        start, expected = self.start, (len(self.weights), self.weights[0].shape[1])
        found = tuple(self.coefficients.shape)
        if found != expected:
            raise ValueError(
                f"gaussian_texture: coefficients has shape {found}, expected {expected}"
            )
        types = types_of(start.mean)
        count = len(start)
        colors, background = [], []
        splat, last = dr.arange(types.UInt, count), types.UInt(count)
        for c, weights in enumerate(self.weights):
            row = mi.TensorXf(
                dr.gather(types.Float, self.coefficients.array, _run(c, expected[1])),
                (expected[1], 1),
            )
            change = (weights @ row).array
            colors.append(start.color[c] + dr.gather(types.Float, change, splat))
            background.append(start.background[c] + dr.gather(types.Float, change, last))
        return replace(start, color=types.FloatX(colors), background=types.FloatX(background))


def _run(row: int, length: int) -> Any:
    return dr.arange(mi.UInt32, length) + row * length


def _columns(tensor: Any) -> list:
    """Columns of a tensor (N, k)."""
    count, number = tensor.shape
    rows = dr.arange(mi.UInt32, count) * number
    return [dr.gather(mi.Float, tensor.array, rows + k) for k in range(number)]


def _entries(tensor: Any) -> list:
    """Entries of a tensor (C,), one array each."""
    return [dr.gather(mi.Float, tensor.array, mi.UInt32(k)) for k in range(tensor.shape[0])]
