"""Registration of the plugins with the variants of Mitsuba."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend import recording

from .gaussian_environment import gaussian_environment
from .gaussian_texture import gaussian_texture
from .living import living_objects
from .versions import Properties, register_emitter, register_texture

PLUGINS: dict[str, tuple[Callable[[str, Any], None], Callable[[], type]]] = {
    "gaussian_texture": (register_texture, gaussian_texture),
    "gaussian_environment": (register_emitter, gaussian_environment),
}
"""How each plugin is registered, and what makes its class for the current variant."""


def register_plugins() -> None:
    """Register the plugins with the current variant of Mitsuba and with later ones.

    They are ``gaussian_texture`` and ``gaussian_environment``. Further calls change nothing. In
    scalar variants, a scene that uses them raises an error.

    Where Dr.Jit has one thread, as on one core, it gets two: with one, Mitsuba 3.9 waits forever as
    it reads or writes an EXR file.

    Raises
    ------
    ImportError
        If Mitsuba is not installed.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> mi.set_variant("llvm_ad_rgb")
    >>> eg.register_plugins()
    """
    if dr.thread_count() < 2:
        dr.set_thread_count(2)
    _follow()
    if mi.variant():
        _register(mi.variant())


@cache  # a second callback would register everything twice
def _follow() -> None:
    recording.find_shared = living_objects
    mi.detail.add_variant_callback(lambda old, new: _register(new))


@cache  # once for each variant
def _register(variant: str) -> None:
    scalar = variant.startswith("scalar")
    for name, (register, create) in PLUGINS.items():
        register(name, partial(_refuse, name) if scalar else create())


def _refuse(name: str, props: Properties) -> None:
    raise RuntimeError(
        f"{name} does not support the variant {mi.variant()}; "
        "use mi.set_variant('llvm_ad_rgb') or another variant of llvm, cuda or metal"
    )
