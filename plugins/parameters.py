"""The parameters of a texture: the Gaussians of a set, or the coefficients of an eigenbasis."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.backend.arrays import types_of, upload
from eigengs_dr.backend.doors import door
from eigengs_dr.backend.types import Record, Tensor
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.channels import slices
from eigengs_dr.gaussian.gaussians import (
    FIELDS,
    Fitted,
    Gaussians,
    from_tensors,
    one_image,
    set_of,
    to_tensors,
)
from eigengs_dr.raster.parameters import EXP2_SCALE, KernelParameters
from eigengs_dr.raster.render import decode_parameters
from eigengs_dr.relight.model import Relightable, or_camera
from eigengs_dr.storage.npz import file_errors

from .emission import outside_of_recordings

Arrays = Record


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


def _tensors_in(parameters: Mapping[str, object], texture: str) -> Arrays:
    keys = {name: _key(texture, name) for name in FIELDS}
    found = {name: parameters[key] for name, key in keys.items() if key in parameters}
    if not found:
        raise ValueError(
            f"the parameters have no {' and no '.join(keys.values())}; give the name of the "
            "texture in mitsuba.traverse, such as 'poster.bsdf.reflectance'"
        )
    return found


# ---------------------------------------------------------------------------------------------
#  Where the Gaussians of a texture come from
# ---------------------------------------------------------------------------------------------


Reader = Callable[[str, str | None], Gaussians]
"""Reads a set from a path, for a backend."""


class SharedFile:
    """The content of a file, which is read once for all textures of a scene that use it.

    Textures of the maps of a material have the same means and shapes. While no texture changes
    its parameters, all textures of a file read the same tables. If the rows of a table are coded,
    tensors are made again when somebody asks for them.

    Attributes
    ----------
    count : int
        Number of Gaussians.
    like : Gaussians
        The set without its Gaussians, see `without_arrays`; perhaps with maps.
    maps : dict of str to Gaussians
        For each map by its name, or for the whole set by None: a set like that of the map.
    tables : WeakValueDictionary
        What lookups of all channels read, by the properties that it depends on; textures hold it.
    """

    def __init__(
        self, path: str, backend: str | None, first: int | None, read: Reader = Gaussians.load
    ) -> None:
        self.path, self.backend, self.first, self.read = path, backend, first, read
        self.state = state_of(path)
        whole = self._load()
        self.count, self.like = len(whole), without_arrays(whole)
        self.tables: WeakValueDictionary[tuple, Any] = WeakValueDictionary()
        self.maps = {name: without_arrays(part) for name, part in _parts(whole).items()}
        self._tensors: dict[str | None, Arrays] | None = _shared_tensors(_parts(whole))

    def _load(self) -> Gaussians:
        """Read the set, or its first Gaussians."""
        whole, first = self.read(self.path, self.backend), self.first
        if first is not None and first > len(whole):
            raise ValueError(f"{self.path}: first is {first}; the file has {len(whole)} Gaussians")
        return whole if first is None else whole[:first]

    def forget_tensors(self) -> None:
        """Free the tensors, until somebody asks for them; a table must hold the Gaussians."""
        self._tensors = None

    def tensors(self, name: str | None) -> Arrays:
        """Return the tensors of a map, or of the whole set.

        After `forget_tensors` they are those of the file, or if this has changed or is gone, those
        of the rows of a table.
        """
        if self._tensors is None:
            self._tensors = outside_of_recordings(self._made_again)
        return self._tensors[name]

    def _made_again(self) -> dict[str | None, Arrays]:
        tensors = _shared_tensors(self._parts_again())
        dr.eval(list(tensors.values()))  # else a recording that asks would compute them
        return tensors

    def _parts_again(self) -> dict[str | None, Gaussians]:
        """Read the sets again, or decode those of a table."""
        try:
            if not self.tables or state_of(self.path) == self.state:
                return _parts(self._load())
        except (OSError, ValueError):
            if not self.tables:
                raise
        found, parts = self.parameters(), slices(self.like.maps) or [slice(None)]
        return {
            name: _encoded(found.shape, found.color[part], found.background[part], like)
            for (name, like), part in zip(self.maps.items(), parts, strict=True)
        }

    def source(self, name: str | None) -> TextureParameters:
        """Return a map, or the whole file, as the source of a texture.

        Raises
        ------
        ValueError
            If the file holds maps and no name is given, has no such map, or holds no maps.
        """
        if name not in self.maps and None in self.maps:
            raise ValueError(f"{self.path} holds one image and no map {name!r}; leave map out")
        if name not in self.maps:
            missing = "holds maps; say which by" if name is None else f"has no map {name!r};"
            options = ", ".join(map(str, self.maps))
            raise ValueError(f"{self.path} {missing} map = one of {options}")
        names = list(self.maps)
        part = slice(None) if name is None else slices(self.like.maps)[names.index(name)]
        return TextureParameters(self.maps[name], file=self, name=name, part=part)

    def parameters(self) -> KernelParameters:
        """Return the parameters of all channels, decoded map by map, or those of a table."""
        table = next(iter(self.tables.values()), None)
        if self._tensors is None and table is not None:
            parameters: KernelParameters = table.parameters()
            return parameters
        parts = [
            decode_parameters(from_tensors(self.tensors(name), like))
            for name, like in self.maps.items()
        ]
        return KernelParameters(
            parts[0].shape,
            [c for part in parts for c in part.color],
            [b for part in parts for b in part.background],
        )


def _parts(whole: Gaussians) -> dict[str | None, Gaussians]:
    """Return the set of each map by its name, or the whole set by None."""
    return {m.name: whole[m.name] for m in whole.maps} or {None: whole}


def _shared_tensors(parts: dict[str | None, Gaussians]) -> dict[str | None, Arrays]:
    """Return the tensors of some sets, which share those of means and shapes."""
    tensors = {name: to_tensors(part) for name, part in parts.items()}
    shared = {key: next(iter(tensors.values()))[key] for key in SHAPES}
    return {name: own | shared for name, own in tensors.items()}


def _encoded(shape: list, color: list, background: list, like: Gaussians) -> Gaussians:
    """Return the set of some parameters of kernels in another space: undo `decode_parameters`."""
    types, space = types_of(like.mean), like.space
    mean_x, mean_y, *factor = shape
    if space.affine and not space.identical:
        black = space.decode([0.0] * like.channels)
        background = [b - k for b, k in zip(background, black, strict=True)]
        inverse = np.linalg.inv(space.to_rgb).tolist()
        color, background = (
            [sum(k * v for k, v in zip(row, values, strict=True)) for row in inverse]
            for values in (color, background)
        )
    return replace(
        like,
        mean=types.Float2(mean_x, mean_y),
        factor=types.Float3([f * (1 / EXP2_SCALE) for f in factor]),
        color=types.FloatX(color),
        background=types.FloatX(background),
    )


def without_arrays(gaussians: Gaussians) -> Gaussians:
    """Return a set of one Gaussian that gives the size, the space and the channels of a set.

    Tensors hold the Gaussians of a texture: a second copy would take as much memory.
    """
    one = gaussians[:1]
    dr.eval(one.mean, one.factor, one.color, one.background)
    return one


_files: WeakValueDictionary[tuple, SharedFile] = WeakValueDictionary()
"""The files of living textures; the textures hold them."""


def state_of(path: str) -> tuple[int, ...]:
    """Return what differs if a file is another one, or has changed."""
    with file_errors(path):
        state = os.stat(path)
    return state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns


def shared_file(
    path: str, backend: str | None, first: int | None, coded: bool, read: Reader = Gaussians.load
) -> SharedFile:
    """Return the content of a file; while a texture uses it, it is read again for tensors alone.

    A file that has changed on disk counts as another one, and so does one whose tables are to be
    `coded` or not: these keep the tensors. For errors see `read`.
    """
    key = (*state_of(path), mi.variant(), backend, first, coded, read)
    file = _files.get(key)
    # While Dr.Jit copies the content, its thread may make another texture, which reads it first.
    return file or _files.setdefault(key, SharedFile(path, backend, first, read))


SHAPES = ("mean", "factor")
"""Parameters whose change requires new lists of the Gaussians. Maps share them."""


@dataclass(eq=False)
class TextureParameters:
    """The parameters of a texture, and the Gaussians that they stand for.

    They are mean (N, 2), factor (N, 3), color (N, C) and background (C,) of a set, in native pixels
    and the space of the set; or coefficients (C, k) of an `eigengs_dr.EigenGS` model, with
    ``colors = mean colors + coefficients x weights`` for every channel; or the direction "light" of
    an `eigengs_dr.Relightable` model.

    Attributes
    ----------
    start : Gaussians
        The set of a model at its mean, or a set like that of the texture, from `without_arrays`.
    read : dict of str to TensorXf
        The parameters at the start, but for those of a file; a light is a Vector3f.
    weights : list of TensorXf, shape (N + 1, k)
        Those of a model, one for each channel.
    lit : Relightable or None
        The model of a light.
    file : SharedFile or None
    name : str or None
        The map among those of the file.
    part : slice
        The channels of the texture among those of the file.
    """

    start: Gaussians
    read: Arrays = field(default_factory=dict)
    weights: Sequence[Tensor] = ()
    lit: Relightable | None = None
    file: SharedFile | None = None
    name: str | None = None
    part: slice = field(default_factory=lambda: slice(None))

    @cached_property
    def tensors(self) -> Arrays:
        """The parameters, which `mitsuba.traverse` shows; those of a file from the first use on."""
        # Separate objects on shared memory, so that each texture has its own gradient.
        return {name: type(t)(t) for name, t in self._at_start().items()}

    def _at_start(self) -> Arrays:
        return self.file.tensors(self.name) if self.file else self.read

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        if self.file and "tensors" not in vars(self):
            return self.file.count
        if "mean" in self.tensors:
            return int(self.tensors["mean"].shape[0])
        return len(self.lit.planes if self.lit else self.start)

    def is_that_of_file(self) -> bool:
        """Return whether the parameters share the memory of the file: they have not changed."""
        if "tensors" not in vars(self):
            return True
        read = self._at_start()
        unchanged = (t.array.index == read[k].array.index for k, t in self.tensors.items())
        return not dr.grad_enabled(self.tensors) and all(unchanged)

    def decode(self, inputs: Arrays) -> KernelParameters:
        """Return the Gaussians of some `tensors` as kernels take them; differentiable."""
        return decode_parameters(self.gaussians(inputs))

    def gaussians(self, inputs: Arrays) -> Gaussians:
        """Return the set of some `tensors`; gradients flow back to them.

        Raises
        ------
        ValueError
            If the shapes of the parameters do not match.
        """
        try:
            if self.weights:
                return self._reconstruct(inputs["coefficients"])
            if self.lit:
                return self.lit.relight(or_camera(inputs["light"]))
            return from_tensors(inputs, self.start)
        except ValueError as error:
            raise ValueError(f"parameters of Gaussians: {error}") from error

    def _reconstruct(self, coefficients: Tensor) -> Gaussians:
        """Return the set of some coefficients of a model."""
        start, shape = self.start, tuple(coefficients.shape)
        expected = (len(self.weights), self.weights[0].shape[1])
        if shape != expected:
            raise ValueError(f"coefficients has shape {shape}, expected {expected}")
        # An optimiser may leave values that are not finite; times zero weights, they give NaN.
        finite = dr.select(dr.isfinite(coefficients), coefficients, 0)
        types, count = types_of(start.mean), len(start)
        colors, background = [], []
        for channel, weights in enumerate(self.weights):
            change = (weights @ finite[channel]).array
            added = dr.gather(types.Float, change, dr.arange(types.UInt, count))
            colors.append(start.color[channel] + added)
            last = dr.gather(types.Float, change, types.UInt(count))
            background.append(start.background[channel] + last)
        return replace(start, color=types.FloatX(colors), background=types.FloatX(background))


def read_planes(path: str, backend: str | None) -> Gaussians:
    """Read the planes of a model of lights."""
    return Relightable.load(path, backend).planes


def light_source(model: Relightable, light: NDArray[np.float32]) -> TextureParameters:
    """Return the direction of the light of a model as the source of a texture."""
    start, towards = model.relight(light), mi.Vector3f(*light.tolist())
    dr.make_opaque(towards)  # another light compiles no other programs
    return TextureParameters(without_arrays(start), {"light": towards}, lit=model)


def model_source(model: EigenGS, coefficients: NDArray[np.float32] | None) -> TextureParameters:
    """Return the coefficients of a model, by default 0, as the source of a texture.

    A channel with fewer components than others ignores the rest of its row.
    """
    channels, max_components = len(model.weights), max(model.components)
    weights = np.zeros((channels, len(model.gaussians) + 1, max_components), np.float32)
    for padded, matrix in zip(weights, model.weights, strict=True):
        padded[:, : len(matrix)] = matrix.T
    if coefficients is None:
        coefficients = np.zeros((channels, max_components), np.float32)
    tensors = {"coefficients": upload(mi.TensorXf, coefficients)}
    return TextureParameters(model.gaussians, tensors, [upload(mi.TensorXf, w) for w in weights])


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
    """The operation of `derived`: it keeps its own graph and walks it in both modes."""

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
                "no forward mode of Gaussians with a prefilter; use drjit.backward, or "
                "prefilter = 0"
            )
        dr.set_grad(self.inputs, self.grad_in("inputs"))
        self.set_grad_out(self._walk(dr.ADMode.Forward, self.inputs, self.outputs))

    def backward(self) -> None:
        """Pull the derivatives of the results back."""
        dr.set_grad(self.outputs, self.grad_out())
        self.set_grad_in("inputs", self._walk(dr.ADMode.Backward, self.outputs, self.inputs))

    def _walk(self, mode: dr.ADMode, source: Arrays, target: Arrays) -> Arrays:
        dr.enqueue(mode, source)
        dr.traverse(mode, dr.ADFlag.ClearInterior | dr.ADFlag.ClearInput)
        derivatives = dr.grad(target)
        dr.clear_grad(target)
        return derivatives
