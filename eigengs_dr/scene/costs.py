"""The cost of textures and environments to a renderer: memory, and the time of a lookup."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from ..plugins import resident_bytes
from ..plugins.versions import Interaction, Texture

SIDE = 512
"""Lookups that are timed at once, along each side of a grid over the texture."""

ROUNDS = 20
"""Timings of each texture, of which the fastest counts; the textures take turns."""

NEGLIGIBLE = 1 << 14
"""Bytes that are not worth saving: the smallest images take less."""

SLOWEST = 8.0
"""Ratio of the lookup times of Gaussians and bitmap above which the bitmap is better. Lookups are a
small part of a rendering: the picture of a coated ball takes 1.07 to 1.12 times as long where they
take two to three times as long. On a busy machine, figures differ by a factor of two."""


class Cost(NamedTuple):
    """The cost of the textures of an image.

    Attributes
    ----------
    bytes : int
        Memory of all of them between renderings, see `eigengs_dr.plugins.resident_bytes`.
    nanoseconds : float
        Time of a lookup of the first one, in a grid of points, on all cores. Of an environment,
        time of a lookup and of a direction that is sampled.
    """

    bytes: int
    nanoseconds: float

    def is_better_than(self, other: Cost) -> bool:
        """Return whether bitmaps of this cost are better than Gaussians of another."""
        is_smaller = other.bytes - self.bytes > NEGLIGIBLE
        return is_smaller or other.nanoseconds > SLOWEST * self.nanoseconds


def costs_of(kinds: Sequence[Sequence[Any]], look: Callable[[Any, Interaction], Any]) -> list[Cost]:
    """Measure plugins that show the same image.

    Parameters
    ----------
    kinds : sequence of sequences of mitsuba.Texture or mitsuba.Emitter
        For each kind, all its plugins in the scene that share no memory.
    look : callable
        ``look(plugin, points)`` returns the lookups at points, see `of_texture`.

    Returns
    -------
    list of Cost
        One for each kind.
    """
    firsts = [plugins[0] for plugins in kinds]
    points = _grid()
    fastest = [float("inf")] * len(kinds)
    for _ in range(1 + ROUNDS):  # the first round compiles
        seconds = [_time(look, plugin, points) for plugin in firsts]
        fastest = [min(pair) for pair in zip(fastest, seconds, strict=True)]
    held = [sum(map(resident_bytes, plugins)) for plugins in kinds]
    return [Cost(b, 1e9 * t / SIDE**2) for b, t in zip(held, fastest, strict=True)]


def _grid() -> Interaction:
    """Return points row by row, as the pixels of a camera see them, and directions to them."""
    index = dr.arange(mi.UInt32, SIDE**2)
    points = dr.zeros(mi.SurfaceInteraction3f, SIDE**2)
    points.uv = (mi.Point2f(index % SIDE, index // SIDE) + 0.5) / SIDE
    points.wi = dr.normalize(mi.Vector3f(points.uv.x - 0.5, points.uv.y - 0.5, 0.5))
    if mi.is_spectral:
        points.wavelengths = type(points.wavelengths)(550)
    dr.eval(points)
    dr.sync_thread()
    return points


def _time(look: Callable[[Any, Interaction], Any], plugin: Any, points: Interaction) -> float:
    """Return the seconds of a lookup at all points."""
    started = time.perf_counter()
    dr.eval(look(plugin, points))
    dr.sync_thread()
    return time.perf_counter() - started


def of_texture(raw: bool, channels: int) -> Callable[[Texture, Interaction], Any]:
    """Return the lookup of a texture with so many channels; `raw` says whether it holds data."""

    def look(texture: Texture, points: Interaction) -> Any:
        if not raw:
            return texture.eval(points)
        grey = channels == 1 or mi.is_monochromatic
        return texture.eval_1(points) if grey else texture.eval_3(points)

    return look


def of_environment(emitter: mi.Emitter, points: Interaction) -> Any:
    """Look up an environment, and sample a direction."""
    return emitter.eval(points), emitter.sample_direction(points, points.uv)
