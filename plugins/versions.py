"""The one place for what differs between versions of Mitsuba.

After 3.9, `mitsuba.Texture` may become `mitsuba.Field`, and 3.10 has footprints of rays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import Float

Texture = Any
"""A ``mitsuba.Texture`` of the current variant."""

Interaction = Any
"""A ``mitsuba.SurfaceInteraction3f`` of the current variant."""

Properties = Any
"""``mitsuba.Properties``."""


def _renamed(holder: Any, before: str, after: str) -> Any:
    return getattr(holder, before if hasattr(holder, before) else after)


def texture_class() -> type:
    """Return the base class of textures."""
    found: type = _renamed(mi, "Texture", "Field")
    return found


def texture_kind() -> Any:
    """Return the member of `mitsuba.ObjectType` that stands for textures."""
    return _renamed(mi.ObjectType, "Texture", "Field")


def register_texture(name: str, create: Callable[[Properties], Texture]) -> None:
    """Register a texture with the current variant, by the type of the plugin in scenes."""
    _renamed(mi, "register_texture", "register_field")(name, create)


def has_footprints() -> bool:
    """Return whether rays carry footprints to surfaces: ``si.footprint``, Mitsuba 3.10."""
    return hasattr(mi.SurfaceInteraction3f, "footprint")


def footprint_of(si: Interaction) -> tuple[Float, ...] | None:
    """Return the footprint that the renderer found, without gradients.

    Parameters
    ----------
    si : mitsuba.SurfaceInteraction3f

    Returns
    -------
    tuple of 4 Float, or None
        The matrix m00, m01, m10, m11 whose columns span the ellipse of a pixel in uv; a column is
        as long as a pixel is wide, and 0 if the ray has no cone. None before Mitsuba 3.10.
    """
    if not hasattr(si, "footprint"):
        return None
    m = si.footprint
    return tuple(dr.detach(mi.Float(m[i, j])) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
