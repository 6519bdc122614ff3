"""The maps of a set: groups of channels with a name and a space, as in a material."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..backend.messages import shown
from ..image.space import DATA, LINEAR, NORMAL, SPACES, Space, space_of
from ..storage.npz import BadValue

MAX_MAP_CHANNELS = 16
"""Largest total number of channels of all maps, because a program keeps the sums of all channels of
a block of pixels in registers."""

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
"""Valid names of maps."""

COLORS = ("albedo", "base_color", "basecolor", "color", "diffuse", "reflectance", "emission")
"""Names of maps that hold colours by default."""

NORMALS = ("normal", "normals", "normalmap")
"""Names of maps that hold normals by default."""


class TextureMap(NamedTuple):
    """One map of a set.

    Attributes
    ----------
    name : str
        Letters, digits, "_" and "-"; at most 32.
    space : Space
    channels : int
        Number of channels.
    weight : float
        Factor of the errors of the map in a fit and in packing.
    """

    name: str
    space: Space
    channels: int
    weight: float = 1.0


def usual_space(name: str) -> Space:
    """Return the default space of a map by its name: linear light, normals or data.

    Examples
    --------
    >>> [usual_space(name) for name in ("albedo", "normal", "roughness")]
    ['linear', 'normal', 'data']
    """
    lower = name.lower()
    if lower in COLORS:
        return LINEAR
    return NORMAL if lower in NORMALS else DATA


def check_name(name: str) -> None:
    """Raise `BadValue` if a name is not valid for a map."""
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise BadValue(
            f"map {repr(name)[:40]}: a name starts with a letter and has at most 32 letters, "
            "digits, _ or -"
        )


def check_maps(given: Sequence[tuple[Any, ...]], channels: int) -> tuple[TextureMap, ...]:
    """Return maps that may still be plain tuples, and whose spaces may be names.

    Raises
    ------
    TypeError
        If a map is no tuple of a name, a space, a number of channels and optionally a weight.
    BadValue
        If maps are invalid, or their total number of channels differs.
    """
    try:
        maps = [TextureMap(*m) for m in given]
    except TypeError:
        raise TypeError(
            f"maps are {shown(given)}; give the name, space and channels of each"
        ) from None
    names = [m.name for m in maps]
    for m in maps:
        check_name(m.name)
        if m.space not in SPACES:
            raise BadValue(f"map {m.name!r}: space {m.space[:20]!r} is not in {', '.join(SPACES)}")
        allowed = space_of(m.space).map_numbers
        if m.channels not in allowed:
            numbers = " or ".join(map(str, allowed))
            raise BadValue(
                f"map {m.name!r} has {m.channels} channels; space {m.space!r} has {numbers}"
            )
        if not (math.isfinite(m.weight) and m.weight > 0):
            raise BadValue(f"map {m.name!r}: weight is {m.weight}; it must be above 0")
    if not maps or len(set(names)) < len(names):
        raise BadValue(f"maps are {', '.join(names) or 'none'}; give each name once")
    total = sum(m.channels for m in maps)
    if total > MAX_MAP_CHANNELS:
        raise BadValue(
            f"the maps have {total} channels, the limit is {MAX_MAP_CHANNELS}; split them into "
            "two materials"
        )
    if total != channels:
        raise BadValue(f"the maps have {total} channels, but the Gaussians have {channels}")
    return tuple(m._replace(space=space_of(m.space)) for m in maps)


def slices(maps: Sequence[TextureMap]) -> list[slice]:
    """Return the slice of each map in the channels of the set."""
    ends = np.cumsum([m.channels for m in maps]).tolist()
    return [slice(end - m.channels, end) for end, m in zip(ends, maps, strict=True)]


def find_map(maps: Sequence[TextureMap], name: str) -> tuple[TextureMap, slice]:
    """Return a map and its slice in the channels of the set.

    Raises
    ------
    BadValue
        If there is no map of this name; the message lists the names.
    """
    for texture_map, part in zip(maps, slices(maps), strict=True):
        if texture_map.name == name:
            return texture_map, part
    names = ", ".join(m.name for m in maps)
    raise BadValue(f"no map is named {name!r}; it has {names or 'no maps'}")


def channel_weights(maps: Sequence[TextureMap]) -> list[float]:
    """Return the weight of each channel."""
    return [m.weight for m in maps for _ in range(m.channels)]
