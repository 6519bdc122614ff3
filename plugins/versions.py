"""The one place for differences between versions of Mitsuba.

3.10 has footprints of rays (pull request 1964) and finds plugins by itself (1943, see `entry`).
Pull request 1885, which is open, turns `mitsuba.Texture` into `mitsuba.Field`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import cache, partial
from operator import methodcaller
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.types import Float, Mask

Texture = Any
"""A ``mitsuba.Texture`` of the current variant."""


def _renamed(holder: Any, before: str, after: str) -> Any:
    return getattr(holder, before if hasattr(holder, before) else after)


def texture_class() -> type:
    """Return the base class of textures."""
    texture: type = _renamed(mi, "Texture", "Field")
    return texture


def texture_kind() -> object:
    """Return the member of `mitsuba.ObjectType` that stands for textures."""
    return _renamed(mi.ObjectType, "Texture", "Field")


def register(kind: str, name: str, create: Callable[[mi.Properties], Any]) -> None:
    """Register a plugin with the current variant.

    Parameters
    ----------
    kind : {"texture", "emitter", "bsdf"}
    name : str
        The type of the plugin in scenes.
    create : callable
        A class of the kind, or a function that refuses the properties.
    """
    if kind == "texture" and not hasattr(mi, "register_texture"):
        kind, create = "field", _as_field(create) if isinstance(create, type) else create
    getattr(mi, f"register_{kind}")(name, reason_first(create))


@cache
def columns_beyond() -> tuple[int, int]:
    """Return how many columns an ``envmap`` repeats beyond its left and its right border.

    Mitsuba 3.9 repeats one on both sides, and others one on the right side alone.
    """
    columns = 4
    black = mi.Bitmap(np.zeros((columns, columns, 3), np.float32))
    small = mi.load_dict({"type": "envmap", "bitmap": black})
    beyond = mi.traverse(small)["data"].shape[1] - columns
    return beyond // 2, beyond - beyond // 2


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


def _as_field(texture: Any) -> type:
    """Return a class of textures with the methods that `mitsuba.Field` asks for in addition.

    A field says what it holds, and is asked for that by one method for each kind. C++ passes the
    arguments of a field before `active`, in some of its methods; a texture takes none.
    """
    kinds = mi.FieldValueType

    class SurfaceField(texture):
        def out_type(self) -> object:
            if self.channels == 1:
                return kinds.Float
            light = self.space.is_color and not self.raw
            return kinds.Spectrum if mi.is_spectral and light else kinds.Color3

        def domain(self) -> object:
            return mi.FieldDomain.Surface

        def supports_jit(self) -> bool:
            return True

        def supports_surface_queries(self) -> bool:
            return True

        def eval_1(self, si: mi.SurfaceInteraction3f, *rest: Mask, active: Mask = True) -> object:
            return super().eval_1(si, rest[-1] if rest else active)

        def eval_color3(
            self, si: mi.SurfaceInteraction3f, *rest: Mask, active: Mask = True
        ) -> object:
            return super().eval_3(si, rest[-1] if rest else active)

        def eval_spec(
            self, si: mi.SurfaceInteraction3f, *rest: Mask, active: Mask = True
        ) -> object:
            return super().eval(si, rest[-1] if rest else active)

    return SurfaceField


def has_footprints() -> bool:
    """Return whether rays carry footprints to surfaces: ``si.footprint``, Mitsuba 3.10."""
    return hasattr(mi.SurfaceInteraction3f, "footprint")


def footprint_of(si: mi.SurfaceInteraction3f) -> tuple[Float, ...] | None:
    """Return the footprint from the renderer, without gradients.

    Parameters
    ----------
    si : mitsuba.SurfaceInteraction3f

    Returns
    -------
    tuple of 4 Float, or None
        The matrix m00, m01, m10, m11 whose columns span the ellipse of a pixel in uv; a column is
        as long as a pixel is wide, or shorter where a pixel takes several samples, and 0 if the
        ray has no cone or the scene had no texture to filter when it was made. None before
        Mitsuba 3.10.
    """
    if not hasattr(si, "footprint"):
        return None
    m = si.footprint
    return tuple(dr.detach(mi.Float(m[i, j])) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
