"""The objects of all scenes: another thread may drop them while one thread records a rendering."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

KINDS = ("BSDF", "Emitter", "Medium", "PhaseFunction", "Sensor", "Shape", "Texture")
"""Classes with virtual calls. Dr.Jit records a call for all objects of a class in the process, one
after the other, and ends the process or reads freed memory if one is freed meanwhile. Mitsuba
renders without Python's lock, so another thread that drops a scene does not wait for it."""

NONE = 0xFFFFFFFF
"""A number that no object has."""


def living_objects() -> list[object]:
    """Return the objects of all scenes of the current variant."""
    if not mi.variant() or mi.variant().startswith("scalar"):
        return []
    return [one for kind in KINDS for one in _living(getattr(mi, f"{kind}Ptr"))]


def _living(pointer: type) -> Iterator[object]:
    """Yield the objects of a class. Dr.Jit numbers them from 1; some numbers are free."""

    def known(number: int) -> object:
        return dr.reinterpret_array(pointer, mi.UInt32(number))[0]

    try:
        known(NONE)  # raises, unless there never was an object
        return
    except RuntimeError:
        number = 1
    while True:
        try:
            one = known(number)
        except RuntimeError:  # that was the last one
            return
        if one is not None:
            yield one
        number += 1
