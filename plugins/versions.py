"""The one place for what differs between versions of Mitsuba."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

Texture = Any
"""A ``mitsuba.Texture`` of the current variant."""

Interaction = Any
"""A ``mitsuba.SurfaceInteraction3f`` of the current variant."""

Properties = Any
"""``mitsuba.Properties``."""


def texture_class() -> Any:
    """Return the base class of textures: `mitsuba.Texture`, perhaps `mitsuba.Field` after 3.9."""
    return mi.Texture if hasattr(mi, "Texture") else mi.Field


def register_texture(name: str, create: Any) -> None:
    """Register a texture with the current variant.

    Parameters
    ----------
    name : str
        Type of the plugin in scenes.
    create : callable
        Makes the texture from `mitsuba.Properties`.
    """
    register = mi.register_texture if hasattr(mi, "register_texture") else mi.register_field
    register(name, create)


def has_footprints() -> bool:
    """Return whether rays carry footprints to surfaces: ``si.footprint``, Mitsuba 3.10."""
    return hasattr(mi.SurfaceInteraction3f, "footprint")


def footprint_of(si: Interaction) -> tuple | None:
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
