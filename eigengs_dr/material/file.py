"""The file format of a material: one set of shapes with the channels of all maps."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..gaussian.file import LAYOUT as SET_LAYOUT
from ..gaussian.file import MATERIAL, PLAIN_COUNT, Arrays, SetData, check, to_members
from ..gaussian.file import read as read_image
from ..storage import npz
from ..storage.npz import BadValue, Field
from ..storage.readers import readers_of
from .maps import MAX_CHANNELS, TextureMap, check_maps, find_map, slices

FORMAT = MATERIAL
VERSION = 1

_MAPS: dict[str, Field] = {
    "names": Field("U", 1, MAX_CHANNELS),
    "spaces": Field("U", 1, MAX_CHANNELS),
    "channels": Field("i8", 1, MAX_CHANNELS),
    "weights": Field("f8", 1, MAX_CHANNELS),
}

_SMALL = {"size": SET_LAYOUT["size"], "cutoff": Field("f8", 0), **_MAPS}

LAYOUT = {name: SET_LAYOUT[name] for name in ("mean", "factor", "color", "background")} | _SMALL
"""Arrays of a file, with their types and numbers of dimensions."""


class MaterialData(NamedTuple):
    """Content of a file of a material.

    Attributes
    ----------
    arrays : dict of ndarray
        Mean (N, 2), factor (N, 3), and color (N, C) and background (C,) with the channels of all
        maps.
    size : (int, int)
        Native width and height in pixels.
    cutoff : float
        Standard deviations.
    maps : tuple of TextureMap
        In the order of the channels.
    """

    arrays: Arrays
    size: tuple[int, int]
    cutoff: float
    maps: tuple[TextureMap, ...]

    def set_data(self) -> SetData:
        """Return the channels of all maps as one set, in the space "data"."""
        return SetData(self.arrays, self.size, "data", self.cutoff)

    def map_data(self, name: str) -> SetData:
        """Return the set of one map; it shares mean and factor.

        Raises
        ------
        BadValue
            If there is no such map.
        """
        number = find_map(self.maps, name)
        own, space = slices(self.maps)[number], self.maps[number].space
        color, background = self.arrays["color"][:, own], self.arrays["background"][own]
        arrays = self.arrays | {"color": color, "background": background}
        return SetData(arrays, self.size, space, self.cutoff)


class MaterialHead(NamedTuple):
    """What a file of a material says without its large arrays; see `MaterialData`."""

    gaussians: int
    size: tuple[int, int]
    cutoff: float
    maps: tuple[TextureMap, ...]


def write(path: str | os.PathLike[str], data: MaterialData) -> None:
    """Write a material as an ``.npz`` file in single precision, completely or not at all.

    Raises
    ------
    ValueError
        If the suffix is ``.egs``.
    OSError
        If the file cannot be written; an existing file does not change.
    """
    if Path(path).suffix.lower() == ".egs":
        raise ValueError(f"{path}: only eigengs_dr.pack_material writes .egs files; save as .npz")
    names, spaces, channels, weights = zip(*data.maps, strict=True)
    members = to_members(data.arrays, data.size, data.cutoff) | {
        "names": np.array(names),
        "spaces": np.array(spaces),
        "channels": np.array(channels, np.int64),
        "weights": np.array(weights, np.float64),
    }
    npz.write(path, FORMAT, VERSION, members, compressed=len(members["mean"]) < PLAIN_COUNT)


def read(path: Path) -> MaterialData:
    """Read and check a material; the file may be hostile.

    Raises
    ------
    ValueError
        If the file has another format or a newer version, is damaged, or holds invalid values. One
        line names the file and the key.
    OSError
        If the file cannot be opened.
    """
    data = _read(path)
    try:
        check(data.set_data())
        check_maps(data.maps, data.arrays["color"].shape[1])
    except BadValue as error:
        raise ValueError(f"{path}: {error}") from None
    return data


def read_head(path: Path) -> MaterialHead:
    """Read what an ``.npz`` file of a material holds, without its Gaussians; errors as `read`."""
    found = npz.read(path, FORMAT, VERSION, _SMALL)
    color = npz.read_shapes(path, FORMAT, VERSION, {"color": LAYOUT["color"]})["color"]
    maps = _maps_of(path, found)
    try:
        check_maps(maps, color[1])
    except BadValue as error:
        raise ValueError(f"{path}: {error}") from None
    width, height = found["size"].tolist()
    return MaterialHead(color[0], (width, height), float(found["cutoff"]), maps)


def holds_material(path: str | os.PathLike[str]) -> bool:
    """Return whether a file, ``.npz`` or ``.egs``, holds a material; `read` checks the content.

    Raises
    ------
    ValueError
        If the file is neither.
    OSError
        If the file cannot be opened.
    """
    if readers := readers_of(path):
        return readers.holds_material(path)
    return npz.format_of(path) == FORMAT


def read_set(path: Path, name: str | None, option: str = "map") -> SetData:
    """Read the set of an image, or of one map of a material.

    Parameters
    ----------
    path : Path
    name : str or None
        The map; None for the set of an image.
    option : str, optional
        What messages call `name`.

    Raises
    ------
    ValueError
        As `read`; if a material is read without a name, or an image with one; or if there is no
        such map. The message lists the maps.
    """
    if not holds_material(path):
        if name is not None:
            raise ValueError(f"{path}: holds one image and no maps; leave {option} out")
        return read_image(path)
    data = read(path)
    if name is None:
        names = ", ".join(m.name for m in data.maps)
        raise ValueError(f"{path}: holds the maps {names}; choose one with {option}")
    try:
        return data.map_data(name)
    except BadValue as error:
        raise ValueError(f"{path}: {error}") from None


def _read(path: Path) -> MaterialData:
    if readers := readers_of(path):
        data: MaterialData = readers.read_material(path)
        return data
    found = npz.read(path, FORMAT, VERSION, LAYOUT)
    maps = _maps_of(path, found)
    arrays = {name: found[name] for name in ("mean", "factor", "color", "background")}
    return MaterialData(arrays, tuple(found["size"].tolist()), float(found["cutoff"]), maps)


def _maps_of(path: Path, found: Arrays) -> tuple[TextureMap, ...]:
    rows = [found[name].tolist() for name in _MAPS]
    if len({len(row) for row in rows}) > 1:
        raise ValueError(f"{path}: names, spaces, channels and weights differ in length")
    return tuple(TextureMap(*row) for row in zip(*rows, strict=True))
