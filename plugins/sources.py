"""Where the Gaussians of a texture come from: a set, a file, a family of images, or a light."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.backend.arrays import types_of, upload
from eigengs_dr.backend.types import Record
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.channels import slices
from eigengs_dr.gaussian.gaussians import Gaussians, from_tensors, to_tensors
from eigengs_dr.raster.parameters import EXP2_SCALE, KernelParameters
from eigengs_dr.raster.render import decode_parameters
from eigengs_dr.relight.model import Relightable, or_camera
from eigengs_dr.storage.npz import file_errors

from .emission import outside_of_recordings
from .lookup import Memory, Table, list_gaussians, make_table

SHAPES = ("mean", "factor")
"""Parameters whose change requires new lists of the Gaussians. Maps share them."""


class Source:
    """A set of arrays: mean (N, 2), factor (N, 3), color (N, C) and background (C,).

    They are in native pixels and in the space of the set. Sources of other parameters inherit.

    Attributes
    ----------
    start : Gaussians
        A set like that of the texture, perhaps without its Gaussians, see `without_arrays`.
    tensors : dict of str to TensorXf
        The parameters, which `mitsuba.traverse` shows; a light is a Vector3f.
    """

    def __init__(self, start: Gaussians, tensors: Record) -> None:
        self.start, self.tensors = start, tensors

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.tensors["mean"].shape[0])

    def gaussians(self, inputs: Record) -> Gaussians:
        """Return the set of some `tensors`; gradients flow back to them."""
        return from_tensors(inputs, self.start)

    def decode(self, inputs: Record) -> KernelParameters:
        """Return the Gaussians of some `tensors` as kernels take them; differentiable.

        Raises
        ------
        ValueError
            If the shapes of the parameters do not match.
        """
        try:
            return decode_parameters(self.gaussians(inputs))
        except ValueError as error:
            raise ValueError(f"parameters of Gaussians: {error}") from error

    def parameters(self) -> KernelParameters:
        """Return the Gaussians as they are."""
        return self.decode(self.tensors)

    def shared_table(
        self, cutoff: float, wrap: str, filtered: bool, memory: Memory
    ) -> tuple[Table, slice] | None:
        """Return a table that other textures read too, and the channels of this one; or None."""


class FamilySource(Source):
    """The coefficients (C, k) of an `eigengs_dr.EigenGS` model, by default 0.

    ``colors = mean colors + coefficients x weights`` for every channel. A channel with fewer
    components than others ignores the rest of its row.
    """

    def __init__(self, model: EigenGS, coefficients: NDArray[np.float32] | None) -> None:
        channels, max_components = len(model.weights), max(model.components)
        weights = np.zeros((channels, len(model.gaussians) + 1, max_components), np.float32)
        for padded, matrix in zip(weights, model.weights, strict=True):
            padded[:, : len(matrix)] = matrix.T
        self.weights = [upload(mi.TensorXf, w) for w in weights]
        if coefficients is None:
            coefficients = np.zeros((channels, max_components), np.float32)
        super().__init__(model.gaussians, {"coefficients": upload(mi.TensorXf, coefficients)})

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.start)

    def gaussians(self, inputs: Record) -> Gaussians:
        """Return the set of some coefficients."""
        start, coefficients = self.start, inputs["coefficients"]
        shape, expected = tuple(coefficients.shape), (len(self.weights), self.weights[0].shape[1])
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


class LightSource(Source):
    """The direction "light" of an `eigengs_dr.Relightable` model."""

    def __init__(self, model: Relightable, light: NDArray[np.float32]) -> None:
        self.model, towards = model, mi.Vector3f(*light.tolist())
        dr.make_opaque(towards)  # another light compiles no other programs
        super().__init__(without_arrays(model.relight(light)), {"light": towards})

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.model.planes)

    def gaussians(self, inputs: Record) -> Gaussians:
        """Return the set under a light."""
        return self.model.relight(or_camera(inputs["light"]))


class FileSource(Source):
    """A map of a file, or the whole file.

    Raises
    ------
    ValueError
        If the file holds maps and no name is given, has no such map, or holds no maps.
    """

    def __init__(self, file: SharedFile, name: str | None) -> None:
        maps, path = list(file.maps), file.path
        if name not in maps and None in maps:
            raise ValueError(f"{path} holds one image and no map {name!r}; leave map out")
        if name not in maps:
            missing = "holds maps; say which by" if name is None else f"has no map {name!r};"
            raise ValueError(f"{path} {missing} map = one of {', '.join(map(str, maps))}")
        self.file, self.name, self.start = file, name, file.maps[name]
        self.part = slice(None) if name is None else slices(file.like.maps)[maps.index(name)]

    @cached_property
    def tensors(self) -> Record:  # type: ignore[override]
        """The parameters, from the first use on."""
        # Separate objects on shared memory, so that each texture has its own gradient.
        return {name: type(t)(t) for name, t in self.file.tensors(self.name).items()}

    def _is_that_of_file(self) -> bool:
        """Return whether the parameters share the memory of the file: they have not changed."""
        if "tensors" not in vars(self):
            return True
        read = self.file.tensors(self.name)
        unchanged = (t.array.index == read[k].array.index for k, t in self.tensors.items())
        return not dr.grad_enabled(self.tensors) and all(unchanged)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return super().count if "tensors" in vars(self) else self.file.count

    def parameters(self) -> KernelParameters:
        """Return the Gaussians as they are; they need not be read again for it."""
        if not self._is_that_of_file():
            return super().parameters()
        found, part = self.file.parameters(), self.part
        return KernelParameters(found.shape, found.color[part], found.background[part])

    def shared_table(
        self, cutoff: float, wrap: str, filtered: bool, memory: Memory
    ) -> tuple[Table, slice] | None:
        """Return the table of the file, unless parameters have changed."""
        if not self._is_that_of_file():
            return None
        return self.file.table(cutoff, wrap, filtered, memory), self.part


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
        self.tables: WeakValueDictionary[tuple, Table] = WeakValueDictionary()
        self.maps = {name: without_arrays(part) for name, part in _parts(whole).items()}
        self._tensors: dict[str | None, Record] | None = _shared_tensors(_parts(whole))

    def _load(self) -> Gaussians:
        """Read the set, or its first Gaussians."""
        whole, first = self.read(self.path, self.backend), self.first
        if first is not None and first > len(whole):
            raise ValueError(f"{self.path}: first is {first}; the file has {len(whole)} Gaussians")
        return whole if first is None else whole[:first]

    def tensors(self, name: str | None) -> Record:
        """Return the tensors of a map, or of the whole set.

        Where a table holds the Gaussians, they are read again, or if the file has changed or is
        gone, they are those of the rows of the table.
        """
        if self._tensors is None:
            self._tensors = outside_of_recordings(self._made_again)
        return self._tensors[name]

    def _made_again(self) -> dict[str | None, Record]:
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

    def table(self, cutoff: float, wrap: str, filtered: bool, memory: Memory) -> Table:
        """Return the table of all channels; the first call for these settings makes it.

        While Dr.Jit computes it, its thread may make another texture, which then is the first.
        """
        key = (cutoff, wrap, filtered, memory)
        table = self.tables.get(key)
        if table is None:
            parameters, size = self.parameters(), (self.like.width, self.like.height)
            lists = list_gaussians(parameters.shape, size, *key)
            coded_for = size if memory.coded else None
            table = make_table(lists, cutoff, {}, lambda _: parameters, coded_for)
            table = self.tables.setdefault(key, table)
            if table.packed.coding is not None:  # the rows hold the Gaussians
                self._tensors = None
        return table

    def parameters(self) -> KernelParameters:
        """Return the parameters of all channels, decoded map by map, or those of a table."""
        table = next(iter(self.tables.values()), None)
        if self._tensors is None and table is not None:
            return table.parameters()
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


def _shared_tensors(parts: dict[str | None, Gaussians]) -> dict[str | None, Record]:
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


def read_planes(path: str, backend: str | None) -> Gaussians:
    """Read the planes of a model of lights."""
    return Relightable.load(path, backend).planes
