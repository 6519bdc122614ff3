"""Registration of the plugins with the variants of Mitsuba."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.recording import keep_objects

from .gaussian_environment import gaussian_environment
from .gaussian_relightable import gaussian_relightable
from .gaussian_texture import gaussian_texture
from .versions import register

PLUGINS: dict[str, tuple[str, Callable[[], type]]] = {
    "gaussian_texture": ("texture", gaussian_texture),
    "gaussian_environment": ("emitter", gaussian_environment),
    "gaussian_relightable": ("bsdf", gaussian_relightable),
}
"""The kind of each plugin, and what makes its class for the current variant."""

KINDS = ("BSDF", "Emitter", "Medium", "PhaseFunction", "Sensor", "Shape", "Texture")
"""Classes with virtual calls; another thread may drop their objects while one renders."""


def register_plugins() -> None:
    """Register the plugins with the current variant of Mitsuba and with later ones.

    They are ``gaussian_texture``, ``gaussian_environment`` and ``gaussian_relightable``. Further
    calls change nothing. In scalar variants, a scene that uses them raises an error.

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
    mi.detail.add_variant_callback(lambda old, new: _register(new))


@cache  # once for each variant
def _register(variant: str) -> None:
    scalar = variant.startswith("scalar")
    if not scalar:
        keep_objects(getattr(mi, f"{kind}Ptr") for kind in KINDS)
    for name, (kind, create) in PLUGINS.items():
        register(kind, name, partial(_refuse, name) if scalar else create())


def _refuse(name: str, props: mi.Properties) -> None:
    raise RuntimeError(
        f"{name} does not support the variant {mi.variant()}; "
        "use mi.set_variant('llvm_ad_rgb') or another variant of llvm, cuda or metal"
    )
