"""What a texture costs a renderer: the bytes that it holds, and the time of a lookup."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ..plugins import resident_bytes
from ..plugins.versions import Interaction, Texture

SIDE = 512
"""Lookups that are timed at once, along each side of a grid over the texture."""

ROUNDS = 20
"""Timings of each texture, of which the fastest counts; the textures take turns."""

NEGLIGIBLE = 1 << 14
"""Bytes that nobody saves: the smallest images take less."""

SLOWEST = 8.0
"""Time of a lookup, in lookups of the bitmap, from which on the bitmap is better. Lookups are a
small part of a rendering: the picture of a coated ball takes 1.07 to 1.12 times as long where they
take two to three times as long. On a busy machine, figures differ by a factor of two."""


class Cost(NamedTuple):
    """What the textures of an image cost.

    Attributes
    ----------
    bytes : int
        Memory of all of them between renderings, see `eigengs_dr.plugins.resident_bytes`.
    nanoseconds : float
        Time of a lookup of the first one, in a grid of points, on all cores.
    """

    bytes: int
    nanoseconds: float

    def is_better_than(self, other: Cost) -> bool:
        """Return whether bitmaps of this cost are better than Gaussians of the other one."""
        is_smaller = other.bytes - self.bytes > NEGLIGIBLE
        return is_smaller or other.nanoseconds > SLOWEST * self.nanoseconds


def costs_of(kinds: Sequence[Sequence[Texture]], raw: bool, channels: int) -> list[Cost]:
    """Measure textures that show the same image.

    Parameters
    ----------
    kinds : sequence of sequences of mitsuba.Texture
        For each kind, all its textures in the scene that share no memory.
    raw : bool
        Whether they hold data.
    channels : int

    Returns
    -------
    list of Cost
        One for each kind.
    """
    firsts = [textures[0] for textures in kinds]
    points = _grid()
    fastest = [float("inf")] * len(kinds)
    for _ in range(1 + ROUNDS):  # the first round compiles
        taken = [_time(texture, points, raw, channels) for texture in firsts]
        fastest = [min(pair) for pair in zip(fastest, taken, strict=True)]
    held = [sum(map(resident_bytes, textures)) for textures in kinds]
    return [Cost(b, 1e9 * t / SIDE**2) for b, t in zip(held, fastest, strict=True)]


def _grid() -> Interaction:
    """Return points row by row, as the pixels of a camera see them."""
    index = dr.arange(mi.UInt32, SIDE**2)
    points = dr.zeros(mi.SurfaceInteraction3f, SIDE**2)
    points.uv = (mi.Point2f(index % SIDE, index // SIDE) + 0.5) / SIDE
    if mi.is_spectral:
        points.wavelengths = type(points.wavelengths)(550)
    dr.eval(points)
    dr.sync_thread()
    return points


def _time(texture: Texture, points: Interaction, raw: bool, channels: int) -> float:
    """Return the seconds of a lookup at all points."""
    started = time.perf_counter()
    if not raw:
        dr.eval(texture.eval(points))
    elif channels == 1 or mi.is_monochromatic:
        dr.eval(texture.eval_1(points))
    else:
        dr.eval(texture.eval_3(points))
    dr.sync_thread()
    return time.perf_counter() - started
