"""The parameters of a texture: the Gaussians of a set, or the coefficients of an eigenbasis."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import types_of, upload
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.gaussians import (
    FIELDS,
    Fitted,
    Gaussians,
    from_tensors,
    one_image,
    set_of,
    to_tensors,
)

Arrays = dict[str, Any]


def texture_of(gaussians: Gaussians | Fitted, **properties: Any) -> dict[str, Any]:
    """Return a set as the dictionary of a ``gaussian_texture``, for `mitsuba.load_dict`.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    **properties
        Other properties of the texture: ``wrap_mode``, ``to_uv``, ``raw``, ``prefilter``,
        ``cutoff``.

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
    gaussians = one_image(set_of(gaussians))
    tensors = to_tensors(gaussians)
    # Mitsuba would try to read a flat tensor of three numbers as a colour, and fail.
    tensors["background"] = tensors["background"][None]
    return {
        "type": "gaussian_texture",
        **tensors,
        "width": gaussians.width,
        "height": gaussians.height,
        "space": gaussians.space,
        "cutoff": gaussians.cutoff,
        **properties,
    }


def gaussians_of(parameters: Any, texture: str, like: Gaussians) -> Gaussians:
    """Read a set back from the parameters of a texture, differentiably.

    Parameters
    ----------
    parameters : dict-like
        A `mitsuba.SceneParameters`, or an optimiser.
    texture : str
        Name of the texture in `parameters`, such as ``"poster.bsdf.reflectance"``.
    like : Gaussians
        The set that the texture was made from. It gives the size, the space and the tensors that
        `parameters` lacks.

    Returns
    -------
    Gaussians

    Raises
    ------
    ValueError
        If the shapes of the tensors do not match.
    """
    return from_tensors(_found(parameters, texture), like)


def keep_in_bounds(parameters: Any, texture: str, like: Gaussians) -> None:
    """Project the parameters of a texture into their bounds, after a step of an optimiser.

    The function applies `eigengs_dr.Gaussians.bounded`: means stay in the image, standard
    deviations in their range, and values that are not finite are replaced.

    Parameters
    ----------
    parameters, texture, like
        See `gaussians_of`. The function changes only entries of `parameters` that exist.
    """
    found = _found(parameters, texture)
    bounded = to_tensors(dr.detach(from_tensors(found, like)).bounded())
    for name in found:
        parameters[f"{texture}.{name}"] = bounded[name]


def _found(parameters: Any, texture: str) -> dict[str, Any]:
    keys = {name: f"{texture}.{name}" for name in FIELDS}
    return {name: parameters[key] for name, key in keys.items() if key in parameters}


# ---------------------------------------------------------------------------------------------
#  Files that several textures of a scene use: read once, with one set of lists
#
#  Textures of the maps of a material have the same means and shapes. While no texture changes
#  them, all textures of a file use one array of means, one of shapes, and the same lists.
# ---------------------------------------------------------------------------------------------


SHAPES = ("mean", "factor")
"""Parameters that the maps of a material share."""


class SharedFile:
    """The content of a file, and what textures of it share.

    Attributes
    ----------
    gaussians : Gaussians
        The set, perhaps with maps.
    tensors : dict of str to TensorXf
        Mean (N, 2) and factor (N, 3).
    lists : dict
        Lists of Gaussians that a texture has made.
    """

    def __init__(self, path: str, backend: str, first: int | None) -> None:
        self.path = path
        whole = Gaussians.load(path, backend)
        self.gaussians = whole if first is None else whole[:first]
        self.tensors = {name: to_tensors(self.gaussians)[name] for name in SHAPES}
        self.lists: dict[Any, Any] = {}

    def map(self, name: str | None) -> Gaussians:
        """Return the set of a map, or of the whole file.

        Raises
        ------
        ValueError
            If the file holds maps and no name is given, has no such map, or holds no maps.
        """
        names = [m.name for m in self.gaussians.maps]
        if not names and name is not None:
            raise ValueError(
                f"gaussian_texture: {self.path} holds one image and no map {name!r}; leave map out"
            )
        if names and name not in names:
            missing = "holds maps; say which by" if name is None else f"has no map {name!r};"
            raise ValueError(
                f"gaussian_texture: {self.path} {missing} map = one of {', '.join(names)}"
            )
        return self.gaussians if name is None else self.gaussians[name]

    def holds(self, tensors: dict[str, Any]) -> bool:
        """Return whether tensors have the memory of the file: nobody has changed them."""
        return all(tensors[k].array.index == self.tensors[k].array.index for k in SHAPES)

    def listed(self, key: Any, build: Callable[[], Any]) -> Any:
        """Return the lists of a kind; the first call makes them."""
        if key not in self.lists:
            self.lists[key] = build()
        return self.lists[key]


_files: WeakValueDictionary[tuple, SharedFile] = WeakValueDictionary()
"""The files of living textures; the textures hold them."""


def shared_file(path: str, backend: str, first: int | None) -> SharedFile:
    """Return the content of a file; while a texture uses it, the file is not read again.

    A file that has changed on disk counts as another one. For errors see `Gaussians.load`.
    """
    state = os.stat(path)
    identity = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns)
    key = (*identity, mi.variant(), backend, first)
    found = _files.get(key)
    if found is None:
        found = _files[key] = SharedFile(path, backend, first)
    return found


@dataclass(init=False)
class FromSet:
    """The parameters mean (N, 2), factor (N, 3), color (N, C) and background (C,) of a set.

    Units are native pixels and the space of the set, as in `eigengs_dr.Gaussians`.
    """

    start: Gaussians
    tensors: dict[str, Any]

    shaping = ("mean", "factor")
    """Parameters whose change requires new lists of the Gaussians."""

    def __init__(self, gaussians: Gaussians, shared: SharedFile | None = None) -> None:
        self.start, self.shared = gaussians, shared
        self.tensors = to_tensors(gaussians)
        if shared is not None:  # own objects, so that each has its own gradient, of one memory
            self.tensors |= {name: type(t)(t) for name, t in shared.tensors.items()}

    def put(self, callback: Any) -> None:
        """Show the parameters to `mitsuba.traverse`."""
        for name, tensor in self.tensors.items():
            callback.put(name, tensor, mi.ParamFlags.Differentiable)

    def inputs(self) -> dict[str, Any]:
        """Return the parameters by name."""
        return self.tensors

    def gaussians(self, inputs: dict[str, Any]) -> Gaussians:
        """Return the set of some `inputs`; gradients flow back to them.

        Raises
        ------
        ValueError
            If the shapes of the parameters do not match.
        """
        try:
            return from_tensors(inputs, self.start)
        except ValueError as error:
            raise ValueError(f"gaussian_texture: {error}") from error

    def listed(self, key: Any, build: Callable[[], Any]) -> Any:
        """Return lists of the Gaussians: those of the file while means and shapes are the file's.

        `key` tells lists of one file apart, and `build` makes them.
        """
        if self.shared is not None and self.shared.holds(self.tensors):
            return self.shared.listed(key, build)
        return build()


@dataclass(init=False)
class FromModel:
    """The parameter coefficients (C, k) of an `eigengs_dr.EigenGS` model.

    ``colors = mean colors + coefficients x weights`` for every channel; shapes do not change. A
    channel with fewer components than others ignores the rest of its row.
    """

    start: Gaussians
    weights: list[Any]
    coefficients: Any

    shaping = ()

    def listed(self, key: Any, build: Callable[[], Any]) -> Any:
        """Make lists of the Gaussians; see `FromSet.listed`."""
        return build()

    def __init__(self, model: EigenGS, coefficients: Any = None) -> None:
        self.start = model.gaussians
        channels, most = len(model.weights), max(model.components)
        weights = np.zeros((channels, most, len(self.start) + 1), np.float32)
        for padded, own in zip(weights, model.weights, strict=True):
            padded[: len(own)] = own
        self.weights = [upload(mi.TensorXf, w.T) for w in weights]
        if coefficients is None:
            coefficients = np.zeros((channels, most), np.float32)
        self.coefficients = upload(mi.TensorXf, coefficients)

    def put(self, callback: Any) -> None:
        """Show the coefficients to `mitsuba.traverse`."""
        callback.put("coefficients", self.coefficients, mi.ParamFlags.Differentiable)

    def inputs(self) -> dict[str, Any]:
        """Return the coefficients by their name."""
        return {"coefficients": self.coefficients}

    def gaussians(self, inputs: dict[str, Any]) -> Gaussians:
        """Return the set of some `inputs`; gradients flow back to them.

        Raises
        ------
        ValueError
            If the coefficients have the wrong shape.
        """
        start, expected = self.start, (len(self.weights), self.weights[0].shape[1])
        coefficients = inputs["coefficients"]
        found = tuple(coefficients.shape)
        if found != expected:
            raise ValueError(
                f"gaussian_texture: coefficients has shape {found}, expected {expected}"
            )
        types = types_of(start.mean)
        count = len(start)
        colors, background = [], []
        splat, last = dr.arange(types.UInt, count), types.UInt(count)
        for c, weights in enumerate(self.weights):
            row = dr.gather(types.Float, coefficients.array, _run(c, expected[1]))
            # An optimiser may leave values that are not finite; times zero weights, they give NaN.
            row = mi.TensorXf(dr.select(dr.isfinite(row), row, 0), (expected[1], 1))
            change = (weights @ row).array
            colors.append(start.color[c] + dr.gather(types.Float, change, splat))
            background.append(start.background[c] + dr.gather(types.Float, change, last))
        return replace(start, color=types.FloatX(colors), background=types.FloatX(background))


def _run(row: int, length: int) -> Any:
    return dr.arange(mi.UInt32, length) + row * length


# ---------------------------------------------------------------------------------------------
#  What lookups read, one operation of the graph of derivatives
#
#  `mitsuba.render` differentiates the renderer as one operation whose inputs are the parameters.
#  In forward mode, the derivatives of all that textures have computed from them must be known by
#  then. Dr.Jit walks from the parameters to the operations in the order in which these were made.
#  So one operation, made before the rendering, must lead from the parameters to all that lookups
#  read: of a chain of several, only the first would come before the renderer, and the derivative
#  be 0.
# ---------------------------------------------------------------------------------------------


def derived(inputs: Arrays, compute: Callable[[Arrays], Arrays]) -> Arrays:
    """Return ``compute(inputs)``; derivatives flow through one operation, in both modes.

    Parameters
    ----------
    inputs : dict of str to TensorXf
    compute : callable
        Returns a dict of arrays.
    """
    if not dr.grad_enabled(inputs):
        return compute(inputs)
    return dr.custom(_Derived, inputs, compute)


class _Derived(dr.CustomOp):
    """The operation of `derived`: it keeps the graph of its own and walks it in both modes."""

    def eval(self, inputs: Arrays, compute: Callable[[Arrays], Arrays]) -> Arrays:
        """Compute the arrays; `inputs` come without their derivatives."""
        self.inputs = {name: type(value)(value) for name, value in inputs.items()}
        with dr.resume_grad():
            dr.enable_grad(self.inputs)
            self.outputs = compute(self.inputs)
        return dr.detach(self.outputs)

    def forward(self) -> None:
        """Push the derivatives of the parameters through the graph."""
        if "values" in self.outputs:  # loops of a pyramid, which Dr.Jit 1.5 walks backward only
            raise RuntimeError(
                "gaussian_texture: no forward mode with a prefilter; use drjit.backward, or "
                "prefilter = 0"
            )
        dr.set_grad(self.inputs, self.grad_in("inputs"))
        self.set_grad_out(self._walk(dr.ADMode.Forward, self.inputs, self.outputs))

    def backward(self) -> None:
        """Pull the derivatives of the results back."""
        dr.set_grad(self.outputs, self.grad_out())
        self.set_grad_in("inputs", self._walk(dr.ADMode.Backward, self.outputs, self.inputs))

    def _walk(self, mode: Any, source: Arrays, target: Arrays) -> Arrays:
        dr.enqueue(mode, source)
        dr.traverse(mode, dr.ADFlag.ClearInterior | dr.ADFlag.ClearInput)
        found = dr.grad(target)
        dr.clear_grad(target)
        return found

    def name(self) -> str:
        """Return the name for graphs of Dr.Jit."""
        return "gaussian_texture"
