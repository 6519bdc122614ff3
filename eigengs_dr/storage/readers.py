"""Readers of formats that are not ``.npz``: who adds a format registers them by its first bytes."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, NamedTuple


class Reader(NamedTuple):
    """The reader of one format.

    Attributes
    ----------
    read_set : callable
        ``read_set(path, sections)`` returns the set as `Gaussians.load` takes it; `sections` is a
        number, or None for all.
    read_maps : callable
        ``read_maps(path)`` returns the maps of the set, without its Gaussians.
    """

    read_set: Callable[..., Any]
    read_maps: Callable[..., Any]


READERS: dict[bytes, Reader] = {}
"""Readers by the first bytes of a file. `eigengs_dr` registers that of packed sets."""


def reader_of(path: str | os.PathLike[str]) -> Reader | None:
    """Return the reader of a file, None for ``.npz``; `OSError` if it cannot be opened."""
    with open(path, "rb") as file:
        start = file.read(max(map(len, READERS), default=0))
    return next((reader for magic, reader in READERS.items() if start.startswith(magic)), None)
