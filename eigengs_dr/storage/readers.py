"""Readers of formats that are not ``.npz``: who adds a format registers them by its first bytes."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, NamedTuple


class Readers(NamedTuple):
    """The readers of one format.

    Attributes
    ----------
    read_set : callable
        ``read_set(path, sections)`` returns the set as `Gaussians.load` takes it; `sections` is a
        number, or None for all.
    read_material : callable
        ``read_material(path)`` returns the material as `Material.load` takes it.
    holds_material : callable
        ``holds_material(path)`` returns whether a file holds a material.
    """

    read_set: Callable[..., Any]
    read_material: Callable[..., Any]
    holds_material: Callable[..., bool]


READERS: dict[bytes, Readers] = {}
"""Readers of formats by their first bytes. `eigengs_dr` registers those of packed sets."""


def readers_of(path: str | os.PathLike[str]) -> Readers | None:
    """Return the readers of a file, None for ``.npz``; `OSError` if it cannot be opened."""
    with open(path, "rb") as file:
        start = file.read(max(map(len, READERS), default=0))
    return next((readers for magic, readers in READERS.items() if start.startswith(magic)), None)
