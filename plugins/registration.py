"""Registration of the plugins with the variants of Mitsuba."""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import cache, partial
from operator import methodcaller
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.recording import keep_objects

from .gaussian_environment import gaussian_environment
from .gaussian_relightable import gaussian_relightable
from .gaussian_texture import gaussian_texture

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


def register(kind: str, name: str, create: Callable[[mi.Properties], Any]) -> None:
    """Register a plugin ("texture", "emitter" or "bsdf") with the current variant."""
    getattr(mi, f"register_{kind}")(name, reason_first(create))


_ended: Generator[None] = (_ for _ in ())
_ended.close()  # its method `throw` raises an error, and adds no traceback


def reason_first(create: Callable[[mi.Properties], Any]) -> type:
    """Return a class that calls `create` and raises its errors without a traceback.

    Mitsuba prints an error of a plugin as nanobind does: the traceback, then what went wrong. Every
    Python function that an error passes adds to the traceback. So `__new__` returns the error, and
    ``__init__``, which runs no Python code, raises it.
    """

    class Created:
        made = create

        def __new__(cls, props: mi.Properties) -> Any:
            try:
                return create(props)
            except Exception as error:
                refusal = object.__new__(cls)
                refusal.end = partial(_ended.throw, error.with_traceback(None))
                return refusal

        end: Callable[[], None]
        __init__ = property(methodcaller("end"))

    return Created
