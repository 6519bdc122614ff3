"""Values of the channels of ``gaussian_texture``: decoding, clamping, luminance."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.image.color import to_linear


def show(texture: Any, value: Any) -> Any:
    """Clamp and decode a channel, unless raw.

    The clamp conserves energy. Gradients ignore it: else a colour that a step moved out of the
    range would never come back.
    """
    if texture.raw:
        return value
    value = dr.replace_grad(dr.clip(value, 0, 1), value)
    return to_linear(value) if texture.space in ("ycbcr", "rgb") else value


def slope_of(texture: Any, value: Any) -> Any:
    """Return the derivative of `show` for a channel in [0, 1]."""
    if texture.raw or texture.space not in ("ycbcr", "rgb"):
        return type(value)(1)
    curved = 2.4 / 1.055 * dr.power((dr.maximum(value, 0.04045) + 0.055) * (1 / 1.055), 1.4)
    return dr.select(value <= 0.04045, 1 / 12.92, curved)


def luminance(color: list) -> Any:
    """Return the luminance of three channels, or the one channel there is."""
    return color[0] if len(color) == 1 else mi.luminance(mi.Color3f(*color))


def keep_finite(x: Any) -> Any:
    """Replace values that are not finite, which an optimiser may leave, by 0."""
    return dr.select(dr.isfinite(x), x, 0)
