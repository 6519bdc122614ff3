"""The table of maps in an ``.egs`` file of a material.

A byte holds the number of maps. Each map has the length of its name, the index of its space, its
number of channels (a byte each), its weight (float64), and its name in ASCII.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from ..image.color import SPACES
from ..material.maps import MAX_CHANNELS, TextureMap
from ..storage.npz import BadValue

_MAP = struct.Struct("<BBBd")


def maps_to_bytes(maps: Sequence[TextureMap]) -> bytes:
    """Return the table of maps; nothing for an image."""
    if not maps:
        return b""
    parts = [bytes([len(maps)])]
    for m in maps:
        name = m.name.encode("ascii")
        parts += [_MAP.pack(len(name), SPACES.index(m.space), m.channels, m.weight), name]
    return b"".join(parts)


def read_maps(take: Callable[[int], bytes]) -> tuple[bytes, tuple[TextureMap, ...]]:
    """Read a table; `take` returns the next bytes, or raises `BadValue`.

    Returns
    -------
    bytes
        The table as it is in the file.
    tuple of TextureMap
        `eigengs_dr.material.maps.check_maps` checks them.
    """
    table, maps = take(1), []
    if not 1 <= table[0] <= MAX_CHANNELS:
        raise BadValue(f"the header claims {table[0]} maps, expected 1 to {MAX_CHANNELS}")
    for _ in range(table[0]):
        entry = take(_MAP.size)
        length, space, channels, weight = _MAP.unpack(entry)
        name = take(length)
        if space >= len(SPACES):
            raise BadValue("the header holds unknown values; upgrade eigengs-dr")
        maps.append(TextureMap(name.decode("ascii", "replace"), SPACES[space], channels, weight))
        table += entry + name
    return table, tuple(maps)
