"""Portable float maps: a header of three lines, then rows of float32 from bottom to top.

OpenImageIO 3.2 returns the rows of these files upside down.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEADER = re.compile(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+(-?[0-9.eE+-]+)\s")
"""Kind (PF is RGB, Pf is grey), width, height, and a scale that is negative for little endian."""


def read(path: Path) -> NDArray[np.float32]:
    """Read a portable float map.

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    content = path.read_bytes()
    header = _HEADER.match(content)
    if not header:
        raise ValueError("damaged or unsupported (no header of a float map); export it again")
    width, height, channels = int(header[2]), int(header[3]), 3 if header[1] == b"PF" else 1
    if len(content) - header.end() != 4 * width * height * channels:
        raise ValueError("damaged (its size is not that of its header); copy or export it again")
    order = "<f4" if float(header[4]) < 0 else ">f4"
    pixels = np.frombuffer(content, order, offset=header.end())
    return pixels.reshape(height, width, channels)[::-1].astype(np.float32)


def write(path: Path, pixels: NDArray[Any]) -> None:
    """Write floats (H, W, 3) or (H, W, 1) as a portable float map of little endian."""
    height, width, channels = pixels.shape
    kind = "PF" if channels == 3 else "Pf"
    with path.open("wb") as file:
        file.write(f"{kind}\n{width} {height}\n-1.0\n".encode())
        file.write(pixels[::-1].astype("<f4").tobytes())
