"""Reuse of lookups: a material that asks twice for the colour of a point pays once.

A BSDF looks its textures up in its evaluation and again in its sampling, often in one recorded
program. Dr.Jit merges equal gathers of a bitmap, but not equal loops.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi


class _Lookups(threading.local):
    """The lookups of this thread since its last change of scope, by what they depend on.

    Dr.Jit starts another scope with every nested call, loop and branch. A result may be used again
    only if there was none since, but for the loops of the lookups themselves: else it could belong
    to a branch that has ended.
    """

    def __init__(self) -> None:
        self.scope = -1
        self.found: dict[tuple, tuple[Any, Any]] = {}


_lookups = _Lookups()


def reused(texture: Any, si: Any, inputs: tuple, look_up: Callable[[], list]) -> list:
    """Return the result of a lookup, from an earlier one with the same inputs if there is one.

    Parameters
    ----------
    texture : mitsuba.Texture
    si : mitsuba.SurfaceInteraction3f
    inputs : tuple of str
        Attributes of `si` on which the lookup depends.
    look_up : callable
        Makes the result, for all lanes of the program: of two callers, one may need other lanes.

    Returns
    -------
    list of Float
        Never shared where there are gradients: they must not cross `drjit.isolate_grad`.
    """
    if dr.grad_enabled(texture.packed) or not _is_traced():
        return look_up()
    backend = dr.backend_v(mi.Float)
    if dr.detail.scope(backend) != _lookups.scope:
        _lookups.found.clear()
    # The values keep their indices, so that no other variable has them.
    values = [texture.packed, *(getattr(si, name) for name in inputs)]
    key = (id(texture), *dr.detail.collect_indices(values))
    entry = _lookups.found.get(key)
    if entry is None:
        entry = look_up(), values
        _lookups.found[key] = entry
    _lookups.scope = dr.detail.scope(backend)
    return entry[0]


def _is_traced() -> bool:
    """Return whether Dr.Jit traces a program that is not frozen.

    In wavefronts a result would take memory. A recording of a frozen program ends the process if
    results of an earlier program are freed meanwhile.
    """
    return dr.flag(dr.JitFlag.SymbolicScope) and not dr.flag(dr.JitFlag.FreezingScope)
