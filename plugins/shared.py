"""Files that several textures of a scene use: read once, with one set of lists.

Textures of the maps of a material have the same means and shapes. While no texture changes them,
all textures of a file use one array of means, one of shapes, and the same lists of Gaussians.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any
from weakref import WeakValueDictionary

import mitsuba as mi

from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.gaussian.tensors import to_tensors
from eigengs_dr.material.file import holds_material
from eigengs_dr.material.material import Material

SHAPES = ("mean", "factor")
"""Parameters that the maps of a material share."""


class SharedFile:
    """The content of a file, and what textures of it share.

    Attributes
    ----------
    content : Gaussians or Material
    tensors : dict of str to TensorXf
        Mean (N, 2) and factor (N, 3).
    lists : dict
        Lists of Gaussians that a texture has made.
    """

    def __init__(self, path: str, backend: str, first: int | None) -> None:
        self.path = path
        self.content: Gaussians | Material
        if holds_material(path):
            self.content = Material.load(path, backend)
            if first is not None:
                self.content = self.content.first(first)
        else:
            self.content = Gaussians.load(path, backend)[:first]
        shaped = self.content.gaussians if isinstance(self.content, Material) else self.content
        self.tensors = {name: to_tensors(shaped)[name] for name in SHAPES}
        self.lists: dict[Any, Any] = {}

    def map(self, name: str | None) -> Gaussians:
        """Return the set of a map, or of the whole file.

        Raises
        ------
        ValueError
            If the file holds maps and no name is given, has no such map, or holds no maps.
        """
        if isinstance(self.content, Material):
            names = ", ".join(self.content)
            if name is None or name not in list(self.content):
                missing = "holds maps; say which by" if name is None else f"has no map {name!r};"
                raise ValueError(f"gaussian_texture: {self.path} {missing} map = one of {names}")
            return self.content[name]
        if name is not None:
            raise ValueError(
                f"gaussian_texture: {self.path} holds one image and no map {name!r}; leave map out"
            )
        return self.content

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
