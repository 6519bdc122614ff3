"""The file of a set of Gaussians, and what makes a set."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..codec import egs as packed
from ..image.color import MAX_CHANNELS, SPACES
from ..storage import npz as archive

FORMAT = "eigengs_dr.gaussians"
VERSION = 1

LAYOUT: dict[str, archive.Field] = {
    "mean": archive.Field("f4", 2),
    "factor": archive.Field("f4", 2),
    "color": archive.Field("f4", 2),
    "background": archive.Field("f4", 1),
    "size": archive.Field("i8", 1),
    "space": archive.Field("U", 0),
}
"""What a file holds: the kind and the number of dimensions of each array."""

Arrays = dict[str, NDArray[Any]]


def write(path: str | os.PathLike[str], arrays: Arrays, size: tuple[int, int], space: str) -> None:
    """Write the arrays of a set, its size and space in single precision, all or nothing.

    Parameters
    ----------
    path : path-like
    arrays : dict of ndarray
        Mean (N, 2), factor (N, 3), color (N, C) and background (C,); see `eigengs_dr.Gaussians`.
    size : (int, int)
        Native width and height in pixels.
    space : str

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then as before.
    """
    members = {name: array.astype(np.float32) for name, array in arrays.items()}
    members |= {"size": np.array(size, np.int64), "space": np.array(space)}
    archive.write(path, FORMAT, VERSION, members)


def read(path: Path, sections: int | None = None) -> tuple[Arrays, tuple[int, int], str]:
    """Read and check the arrays of a set, its size and space.

    Parameters and errors are those of `eigengs_dr.Gaussians.load`, what is read is as `write` takes
    it.
    """
    if packed.is_egs(path):
        content = packed.read(path, sections)
        arrays, size, space = content.arrays(), content.size, content.space
    elif sections is not None:
        raise ValueError(f"{path}: has no sections, which only packed files have; leave it out")
    else:
        arrays = archive.read(path, FORMAT, VERSION, LAYOUT)
        size, space = tuple(arrays.pop("size").tolist()), str(arrays.pop("space"))
    try:
        check(arrays, size, space)
    except archive.BadValue as error:
        raise ValueError(f"{path}: {error}") from None
    return arrays, (int(size[0]), int(size[1])), space


def check(arrays: Arrays, size: tuple[int, ...], space: str) -> None:
    """Raise `archive.BadValue` where arrays, size and space do not make a set.

    Parameters
    ----------
    arrays : dict of ndarray
        Mean, factor, color and background, as `eigengs_dr.Gaussians.from_arrays` takes them.
    size : tuple of int
        Width and height, from 1 to 65536 pixels.
    space : str
        One of `eigengs_dr.image.color.SPACES`; the number of channels must fit it.
    """
    mean, factor, color = arrays["mean"], arrays["factor"], arrays["color"]
    if mean.ndim != 2 or mean.shape[1] != 2 or len(mean) == 0:
        raise archive.BadValue(f"mean has shape {mean.shape}, expected (N, 2) with N >= 1")
    channels = color.shape[1] if color.ndim == 2 else 3
    if not 1 <= channels <= MAX_CHANNELS:
        raise archive.BadValue(f"color has {channels} channels, expected 1 to {MAX_CHANNELS}")
    for name, array, expected in (
        ("factor", factor, (len(mean), 3)),
        ("color", color, (len(mean), channels)),
        ("background", arrays["background"], (channels,)),
    ):
        if array.shape != expected:
            raise archive.BadValue(f"{name} has shape {array.shape}, expected {expected}")
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise archive.BadValue(f"{name} holds values that are not finite")
    if not (factor[:, [0, 2]] > 0).all():
        raise archive.BadValue("factor has a or c <= 0; both must be positive")
    if len(size) != 2 or not all(side == int(side) and 1 <= side <= 1 << 16 for side in size):
        raise archive.BadValue(f"size is {size}, expected two sides from 1 to 65536")
    if space not in SPACES:
        raise archive.BadValue(f"space is {space!r}, expected one of {', '.join(SPACES)}")
    if space in ("ycbcr", "rgb", "linear") and color.shape[1] not in (1, 3, 4):
        raise archive.BadValue(
            f"color has {color.shape[1]} channels; space {space!r} has 1, 3 or 4"
        )
    if space == "ycbcr" and color.shape[1] != 3:
        raise archive.BadValue(f"color has {color.shape[1]} channels; space 'ycbcr' has 3")
