"""The file format of a set of Gaussians and its maps, and the checks of a set."""

from __future__ import annotations

import os
from collections.abc import Sequence
from operator import index
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..backend.messages import printable, shown
from ..backend.types import Arrays, Singles
from ..codec.egs import EgsContent, is_packed, read_egs, read_egs_head, write_egs
from ..codec.quantization import dequantize
from ..image.color import MAX_CHANNELS
from ..image.formats import SUFFIXES
from ..image.space import DATA, SPACES, Space, space_of
from ..storage import npz
from ..storage.npz import BadValue, Field, check_values, file_errors
from .channels import MAX_MAP_CHANNELS, TextureMap, channel_weights, check_maps, find_map

FORMAT = "eigengs_dr.gaussians"
MATERIAL = "eigengs_dr.material"
LIGHTS = "eigengs_dr.relightable"
"""Formats of a file without maps, with maps, and of planes with a table of lights."""

VERSIONS = {FORMAT: 2, MATERIAL: 1}
"""Versions of the formats."""

CUTOFF = 3.0
"""Default cutoff, in standard deviations. At the cutoff a Gaussian has ``exp(-cutoff^2 / 2)`` of
its amplitude: 1.1 % at 3, 0.034 % at 4, 3.7e-6 at 5."""

MAX_CUTOFF = 12.0
"""Largest cutoff, in standard deviations. The fast exponential needs a bound, and ``exp(-72)`` is
negligible in single precision."""

MAX_SET_SIDE = 1 << 16
"""Largest side of a set in pixels: single precision then resolves means to 1/128 pixel."""

MAX_SUM = 1e18
"""Largest sum of the absolute colours of a channel: the sum and its square, and so every rendering,
are finite in single precision."""

MAX_ENTRIES = 1 << 30
"""Largest number of elements of one array: 357 million Gaussians."""

UNCOMPRESSED_COUNT = 1 << 20
"""Number of Gaussians from which a set is stored without compression, which would save 9 % of the
size and take 20 times as long."""

ARRAYS: dict[str, Field] = {
    "mean": Field("f4", 2, MAX_ENTRIES),
    "factor": Field("f4", 2, MAX_ENTRIES),
    "color": Field("f4", 2, MAX_ENTRIES),
    "background": Field("f4", 1),
}
"""Arrays of a set, with their types and numbers of dimensions."""

LAYOUT: dict[str, Field] = ARRAYS | {
    "size": Field("i8", 1),
    "space": Field("U", 0),
    "cutoff": Field("f8", 0),
}
"""Arrays of a file without maps."""

MAPS: dict[str, Field] = {
    "names": Field("U", 1, MAX_MAP_CHANNELS),
    "spaces": Field("U", 1, MAX_MAP_CHANNELS),
    "channels": Field("i8", 1, MAX_MAP_CHANNELS),
    "weights": Field("f8", 1, MAX_MAP_CHANNELS),
}
"""Arrays of a file with maps, instead of the space."""

FIGURES: dict[str, Field] = {"figures": Field("f8", 1, 3), "source": Field("U", 0)}
OPTIONS: dict[str, Field] = {"options": Field("U", 0)}
"""Optional arrays of a file with the results of the fit, and of a run; see `FitFigures`."""

MAX_SOURCE = 64
"""Number of characters of the name of an image, counted from its end, that a file stores."""


class SetData(NamedTuple):
    """Content of a file of a set.

    Attributes
    ----------
    arrays : dict of ndarray
        Mean (N, 2), factor (N, 3), color (N, C) and background (C,); see `eigengs_dr.Gaussians`.
    size : (int, int)
        Native width and height in pixels.
    space : Space
        A name too, before `check`.
    cutoff : float
        Standard deviations.
    maps : tuple of TextureMap
        The groups of channels, in order, if the set has several maps; its space is then "data".
    """

    arrays: Arrays
    size: tuple[int, int]
    space: Space
    cutoff: float = CUTOFF
    maps: tuple[TextureMap, ...] = ()

    def map_data(self, name: str) -> SetData:
        """Return the set of one map; it shares mean and factor.

        Raises
        ------
        BadValue
            If there is no such map.
        """
        texture_map, part = find_map(self.maps, name)
        arrays = {k: self.arrays[k][..., part] for k in ("color", "background")}
        return self._replace(arrays=self.arrays | arrays, space=texture_map.space, maps=())

    def crop(
        self,
        corner: tuple[float, float],
        size: tuple[int, int],
        scale: tuple[float, float] = (1.0, 1.0),
    ) -> SetData:
        """Return the Gaussians that touch a region, as a set with the size of the region.

        Parameters
        ----------
        corner : (float, float)
            x and y of the upper left corner of the region, in native pixels of the set.
        size : (int, int)
            Width and height of the region in pixels of the result.
        scale : (float, float), optional
            Pixels of the result per native pixel, along x and y.

        Returns
        -------
        SetData
            Its rendering equals the region in the rendering of the full set, up to rounding. The
            Gaussians keep their order. The set is empty if the region shows only the background.
        """
        mean = self.arrays["mean"]
        touches = np.ones(len(mean), bool)
        for axis, reach in enumerate(self.reaches()):
            half = 0.5 * size[axis] / scale[axis]
            distance = np.abs(mean[:, axis] - np.float32(corner[axis] + half))
            touches &= distance <= reach * np.float32(1.001) + np.float32(half + 1)
        arrays = {name: self.arrays[name][touches] for name in ("mean", "factor", "color")}
        x, y = scale
        arrays["mean"] = ((arrays["mean"].astype(np.float64) - corner) * scale).astype(np.float32)
        arrays["factor"] = (arrays["factor"] / np.array([x, y, y])).astype(np.float32)
        return self._replace(arrays=self.arrays | arrays, size=size)

    def reaches(self) -> tuple[Singles, Singles]:
        """Return how far each Gaussian reaches from its mean along x and along y, in pixels."""
        a, b, c = self.arrays["factor"].T
        # The covariance (F^T F)^-1 has the entries xx = (1 + (b / c)^2) / a^2 and yy = 1 / c^2.
        across = self.cutoff * np.hypot(np.float32(1), b / c) / a
        return across.astype(np.float32), (self.cutoff / c).astype(np.float32)


class FitFigures(NamedTuple):
    """Results of a fit, or of an encoding, in a file.

    Attributes
    ----------
    psnr_ycbcr, psnr_rgb : float or None
        PSNR in dB; None for what is no picture.
    iterations : int or None
        Number of steps; None for an encoding.
    source : str
        Name of the image.
    options : str
        Digest of the options of a run over many images.
    """

    psnr_ycbcr: float | None
    psnr_rgb: float | None
    iterations: int | None
    source: str = ""
    options: str = ""


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Raise ValueError if the suffix of a file for Gaussians belongs to another kind of file."""
    suffix = Path(path).suffix.lower()
    if suffix == ".egs":
        raise ValueError(f"{path}: only eigengs_dr.pack writes .egs files; save as .npz")
    if suffix in SUFFIXES:
        raise ValueError(
            f"{path}: Gaussians are not an image; save them as .npz, and a picture with save_image"
        )


def write_set(
    path: str | os.PathLike[str], data: SetData, figures: FitFigures | None = None
) -> None:
    """Write a set atomically as an ``.npz`` file in single precision.

    Raises
    ------
    ValueError
        If the suffix is ``.egs``, or `read_set` would reject the set.
    OSError
        If the file cannot be written; an existing file does not change.
    """
    check_suffix(path)
    kind, members = MATERIAL if data.maps else FORMAT, members_of(data)
    with file_errors(path):
        check(data._replace(arrays=members))
    if data.maps:
        columns = zip(*data.maps, strict=True)
        members |= {name: np.array(column) for name, column in zip(MAPS, columns, strict=True)}
    else:
        members["space"] = np.array(data.space)
    if figures is not None and not data.maps:
        members["figures"] = np.array(figures[:3], np.float64)  # None becomes NaN
        members["source"] = np.array(figures.source[-MAX_SOURCE:])
        if figures.options:
            members["options"] = np.array(figures.options)
    compressed = len(members["mean"]) < UNCOMPRESSED_COUNT
    npz.write(path, kind, VERSIONS[kind], members, compressed)


def members_of(data: SetData) -> Arrays:
    """Return the arrays of a file for a set, in single precision, without its maps and space."""
    with np.errstate(over="ignore"):  # the check of a set rejects infinity
        members = {name: np.asarray(a, np.float32) for name, a in data.arrays.items()}
    return members | {"size": np.array(data.size, np.int64), "cutoff": np.array(float(data.cutoff))}


def read_head(path: Path) -> tuple[int, tuple[int, int]]:
    """Return the number of Gaussians in an ``.npz`` file, and its size; arrays are not read.

    Raises
    ------
    ValueError
        If the file has another format or version, or its header is damaged.
    OSError
        If the file cannot be opened.
    """
    kind, version, layout = _layout_of(path)
    small = {name: field for name, field in layout.items() if name not in ARRAYS}
    shape = npz.read_shapes(path, kind, version, {"color": LAYOUT["color"]})["color"]
    with file_errors(path):
        found = _properties(npz.read(path, kind, version, small))
        _check_properties(shape[1], *found)
    return shape[0], found[0]


def _layout_of(path: Path) -> tuple[str, int, dict[str, Field]]:
    """Return the format of an ``.npz`` file, its version, and its arrays."""
    if npz.format_of(path) == MATERIAL:
        shared = {name: field for name, field in LAYOUT.items() if name != "space"}
        return MATERIAL, VERSIONS[MATERIAL], shared | MAPS
    return FORMAT, VERSIONS[FORMAT], LAYOUT


def _properties(members: Arrays) -> tuple[tuple[int, int], Space, float, tuple[TextureMap, ...]]:
    """Return the size, the space, the cutoff and the maps from the arrays of a file."""
    size, cutoff = tuple(members["size"].tolist()), float(members["cutoff"])
    if "names" not in members:
        return size, _known(str(members["space"])), cutoff, ()
    columns = [members[name].tolist() for name in MAPS]
    if len({len(column) for column in columns}) > 1:
        raise BadValue("names, spaces, channels and weights differ in length")
    maps = tuple(TextureMap(*row) for row in zip(*columns, strict=True))
    if not maps:
        raise BadValue("maps are none; give each name once")
    return size, DATA, cutoff, maps


def kind_of(path: str | os.PathLike[str]) -> str:
    """Return the format of a file that this package wrote; of a packed one, that of its content."""
    if not is_packed(path):
        return npz.format_of(path)
    head = read_egs_head(path)
    return LIGHTS if head.lights else MATERIAL if head.maps else FORMAT


def read_map(path: Path, name: str | None, option: str = "map") -> SetData:
    """Read the set of one image, or of one map of a file.

    Parameters
    ----------
    path : Path
    name : str or None
        Name of the map; None for the set of one image.
    option : str, optional
        How messages refer to `name`.

    Raises
    ------
    ValueError
        As for `read_set`; if a file with maps is read without a name, or one without maps with a
        name; or if there is no such map. The message lists the maps.
    """
    data = read_set(path)
    if not data.maps and name is not None:
        raise ValueError(f"{path}: holds one image and no maps; leave out {option}")
    if data.maps and name is None:
        names = ", ".join(m.name for m in data.maps)
        raise ValueError(f"{path}: holds the maps {names}; choose one with {option}")
    with file_errors(path):
        return data if name is None else data.map_data(name)


def read_figures(path: Path) -> FitFigures | None:
    """Return the results of the fit from an ``.npz`` file, if any; errors as for `read_head`."""
    names = set(npz.sizes_of(path))
    if not set(FIGURES) <= names:
        return None
    layout = FIGURES | OPTIONS if set(OPTIONS) <= names else FIGURES
    members = npz.read(path, FORMAT, VERSIONS[FORMAT], layout)
    values = [None if np.isnan(value) else value for value in members["figures"].tolist()]
    if len(values) != 3 or not (values[2] is None or 0 <= values[2] < 1 << 53):
        raise ValueError(
            f"{path}: figures are {values}, expected two PSNRs and the number of steps"
        )
    steps = None if values[2] is None else int(values[2])
    texts = (printable(str(members[name])) for name in ("source", "options") if name in members)
    return FitFigures(values[0], values[1], steps, *texts)


def read_set(path: Path, sections: int | None = None) -> SetData:
    """Read and check a set; parameters and errors as for `eigengs_dr.Gaussians.load`."""
    with file_errors(path):
        if is_packed(path):
            data = packed_data(read_egs(path, sections))
        elif sections is not None:
            raise BadValue("has no sections; pass sections for .egs files only")
        else:
            members = npz.read(path, *_layout_of(path))
            data = SetData({name: members[name] for name in ARRAYS}, *_properties(members))
        return check(data)


def packed_data(content: EgsContent) -> SetData:
    """Return the set of a packed file, in single precision; only its maps are checked."""
    values = {**dequantize(content.all_symbols(), content.steps), "background": content.background}
    with np.errstate(over="ignore"):
        arrays = {name: value.astype(np.float32) for name, value in values.items()}
    maps = check_maps(content.maps, len(content.background)) if content.maps else ()
    scale = np.array(channel_weights(maps) or 1, np.float32)
    arrays |= {name: arrays[name] / scale for name in ("color", "background")}
    return SetData(arrays, content.size, _known(content.space), content.cutoff, maps)


def write_packed(path: str | os.PathLike[str], content: EgsContent) -> int:
    """Write a packed file; return its number of bytes; errors as for `write_set`."""
    with file_errors(path):
        check(packed_data(content))
    return write_egs(path, content)


def check(data: SetData) -> SetData:
    """Return a set whose spaces may still be names, or raise `BadValue` if a part is invalid.

    This function is used for reading and writing files, and for arrays. Shapes must match each
    other, the space and the maps. Values must be finite, a and c positive, colours within
    `MAX_SUM`, sides from 1 to `MAX_SET_SIDE` pixels, and the cutoff in (0, `MAX_CUTOFF`].
    """
    arrays, size, space, cutoff, maps = data
    mean, factor, color = arrays["mean"], arrays["factor"], arrays["color"]
    if mean.ndim != 2 or mean.shape[1] != 2 or len(mean) == 0:
        raise BadValue(f"mean has shape {mean.shape}, expected (N, 2) with N >= 1")
    channels = color.shape[1] if color.ndim == 2 else 3
    if not 1 <= channels <= MAX_CHANNELS:
        raise BadValue(f"color has {channels} channels, expected 1 to {MAX_CHANNELS}")
    shapes = {"factor": (len(mean), 3), "color": (len(mean), channels), "background": (channels,)}
    check_values(arrays, shapes)
    if not (factor[:, [0, 2]] > 0).all():
        raise BadValue("factor has a or c <= 0; both must be positive")
    sums = np.abs(color).sum(axis=0, dtype=np.float64) + np.abs(arrays["background"])
    if (sums > MAX_SUM).any():
        raise BadValue(
            f"color and background of a channel add up to {sums.max():.3g}, the limit is "
            f"{MAX_SUM:g}; scale them"
        )
    space, maps = _check_properties(channels, size, space, cutoff, maps)
    return data._replace(space=space, maps=maps)


def check_sides(size: tuple[int, ...]) -> None:
    """Raise `BadValue` unless a size consists of two valid sides."""
    if len(size) != 2 or not all(1 <= side <= MAX_SET_SIDE for side in size):
        raise BadValue(f"size is {size}, expected two sides from 1 to {MAX_SET_SIDE}")


def _check_properties(
    channels: int,
    size: tuple[int, ...],
    space: str,
    cutoff: float,
    maps: tuple[TextureMap, ...],
) -> tuple[Space, tuple[TextureMap, ...]]:
    """Return the spaces of a set, or raise `BadValue` if a property is invalid."""
    check_sides(size)
    if not 0 < cutoff <= MAX_CUTOFF:
        raise BadValue(f"cutoff is {cutoff}; it must be above 0 and at most {MAX_CUTOFF:g}")
    known = _known(space)
    if maps:
        maps = check_maps(maps, channels)
        if known is not DATA:
            raise BadValue(f"space is {space!r}, expected 'data' for a set with maps")
    known.check_channels(channels)
    return known, maps


def _known(name: str) -> Space:
    """Return the space of a name in a file, or raise `BadValue`."""
    try:
        return space_of(name)
    except ValueError:
        raise BadValue(f"space is {shown(name)}, expected one of {', '.join(SPACES)}") from None


Region = tuple[int, int, int, int]
"""Left, top, width and height, in native pixels of a set."""


def check_region(name: str, region: Sequence[int], size: tuple[int, int]) -> Region:
    """Return a region, or raise ValueError unless it is inside an image of (width, height)."""
    values = [index(v) for v in region]
    if len(values) != 4:
        raise ValueError(f"{name} is {values}; expected left, top, width and height in pixels")
    left, top, width, height = values
    inside = 0 <= left <= size[0] - width and 0 <= top <= size[1] - height
    if not inside or min(width, height) < 1:
        raise ValueError(
            f"{name} {left},{top},{width},{height} is not inside the image of "
            f"{size[0]}x{size[1]} pixels"
        )
    return left, top, width, height


MAX_VALUES = (1 << 32) - 1
"""Largest number of values of an image, channels included. Kernels use 32-bit indices, as Dr.Jit
does for its arrays: larger indices would silently wrap to the first pixels."""


def check_index_range(
    width: int, height: int, channels: int, tile: tuple[int, int] = (1, 1)
) -> None:
    """Reject an image with too many values for 32-bit indices.

    The limit is 37,837 pixels per side with three channels, and 8,191 with 64.

    Parameters
    ----------
    width, height : int
        Size in pixels.
    channels : int
    tile : (int, int), optional
        Width and height of a tile; sides are rounded up to complete tiles.

    Raises
    ------
    ValueError
        If the image, in complete tiles, has more than `MAX_VALUES` values.
    """
    columns, rows = (
        -(-side // unit) * unit for side, unit in zip((width, height), tile, strict=True)
    )
    values = columns * rows * channels
    if values > MAX_VALUES:
        raise ValueError(
            f"an image of {width}x{height} pixels and {channels} channels has {values:,} values, "
            f"the limit is {MAX_VALUES:,}: scale it down or work on parts of it"
        )
