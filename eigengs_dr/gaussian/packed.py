"""Access to packed sets, ``.egs``, for code that reads sets of any format.

The codec, a layer above, reads them: `eigengs_dr` assigns functions of `eigengs_dr.codec.egs` here.
"""

from __future__ import annotations

import os
from collections.abc import Callable

TYPE_CHECKING = False  # imported first; `typing` takes long
if TYPE_CHECKING:
    from pathlib import Path

    from .channels import TextureMap

MAGIC = b"\x89EGS"
"""First bytes of a file. The first byte is not ASCII, so no text file starts with it."""

read_set: Callable[[Path, int | None], tuple]
"""``read_set(path, sections)`` reads a `eigengs_dr.gaussian.file.SetData`; `sections` is a number,
or None for all."""

read_head: Callable[[Path], tuple[tuple[TextureMap, ...], bytes]]
"""``read_head(path)`` reads the maps of a set, and the table of lights of planes; both may be
empty."""


def is_packed(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a packed set; for errors see `open_regular`."""
    from ..storage.memory import open_regular

    with open_regular(path) as file:
        return file.read(len(MAGIC)) == MAGIC
