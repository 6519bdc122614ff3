"""What a page knows of a set: its arrays in base64, with colours decoded to RGB."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..gaussian.file import check
from ..gaussian.gaussians import Gaussians
from ..image.color import LIGHT, decode

MAX_GAUSSIANS = 1 << 20
"""Most Gaussians of a page; those of a photo take 43 bytes each."""


def check_count(count: int) -> None:
    """Raise ValueError if a page cannot show so many Gaussians."""
    if count > MAX_GAUSSIANS:
        raise ValueError(
            f"{count:,} Gaussians are too many for a page; the most is {MAX_GAUSSIANS:,}"
        )


def describe_set(gaussians: Gaussians, levels: Sequence[int] = ()) -> dict[str, Any]:
    """Return the arrays of a set for a page.

    Parameters
    ----------
    gaussians : Gaussians
    levels : sequence of int, optional
        Numbers of first Gaussians that make a whole image each, ascending.

    Raises
    ------
    ValueError
        If the set has too many Gaussians or values that are not valid, or a level is out of range.
    """
    check_count(len(gaussians))
    data = gaussians.data()
    check(data)
    marks = [int(n) for n in levels]
    if marks != sorted(set(marks)) or (marks and not 1 <= marks[0] <= marks[-1] <= len(gaussians)):
        raise ValueError(f"levels are {marks}; expected ascending numbers up to {len(gaussians)}")
    color, background = decoded(gaussians)
    return {
        "width": gaussians.width,
        "height": gaussians.height,
        "cutoff": gaussians.cutoff,
        "levels": marks,
        "mean": to_text(data.arrays["mean"], "<f4"),
        "factor": to_text(data.arrays["factor"], "<f4"),
        "color": to_text(color, "<f4"),
        "background": background.tolist(),
    }


def decoded(gaussians: Gaussians) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the colours (N, C) and the background (C,) of a set, decoded to RGB."""
    arrays, space = gaussians.to_arrays(), gaussians.space
    black = np.stack(decode(space, list(np.zeros((gaussians.channels, 1)))))
    color = np.stack(decode(space, list(arrays["color"].T.astype(np.float64)))) - black
    return color.T, np.stack(decode(space, list(arrays["background"].astype(np.float64))))


def to_text(array: NDArray[Any], kind: DTypeLike) -> str:
    """Return the bytes of an array in base64."""
    return b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()


def light_of(space: str) -> int:
    """Return what sums are: 0 codes and data, 1 linear light, 2 logarithms of light, 3 normals."""
    return {"log": 2, "normal": 3}.get(space, int(space in LIGHT))


def channel_views(channels: int) -> list[tuple[str, tuple[int, int, int]]]:
    """Return names and triples of channels to look at.

    Examples
    --------
    >>> channel_views(3), channel_views(2)
    ([('Colour', (0, 1, 2))], [('1', (0, 0, 0)), ('2', (1, 1, 1))])
    """
    if channels == 3:
        return [("Colour", (0, 1, 2))]
    single = [(str(c + 1), (c, c, c)) for c in range(channels)]
    return [*([("1, 2, 3 as red, green, blue", (0, 1, 2))] if channels > 3 else []), *single]
