"""Values of the channels of ``gaussian_texture``: decoding, clamping, luminance."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.image.color import UNBOUNDED, rendered_as, to_linear
from eigengs_dr.image.normals import unit_codes
from eigengs_dr.image.radiance import LOG_SLOPE, from_log

from .spectrum import mean_weights


def show(texture: Any, value: Any) -> Any:
    """Clamp and decode a channel, unless raw.

    The clamp conserves energy; light that may exceed 1 has no upper bound. Gradients ignore the
    clamp: else a colour that a step moved out of the range would never come back.
    """
    if texture.raw:
        return value
    if texture.space in UNBOUNDED:
        value = from_log(value) if texture.space == "log" else value
        return dr.replace_grad(dr.maximum(value, 0), value)
    value = dr.replace_grad(dr.clip(value, 0, 1), value)
    return to_linear(value) if texture.space in ("ycbcr", "rgb") else value


def show_all(texture: Any, values: list) -> list:
    """Apply `show` to all channels; normals get the length 1 instead, unless raw."""
    if texture.space == "normal" and not texture.raw:
        return unit_codes(values)
    return [show(texture, value) for value in values]


def slope_of(texture: Any, value: Any) -> Any:
    """Return the derivative of `show` for a channel that it does not clamp."""
    if texture.space == "log" and not texture.raw:
        return (from_log(value) + 1 / LOG_SLOPE) * math.log1p(LOG_SLOPE)
    if texture.raw or texture.space not in ("ycbcr", "rgb"):
        return type(value)(1)
    curved = 2.4 / 1.055 * dr.power((dr.maximum(value, 0.04045) + 0.055) * (1 / 1.055), 1.4)
    return dr.select(value <= 0.04045, 1 / 12.92, curved)


def is_shown(texture: Any, value: Any) -> Any:
    """Return whether `show` does not clamp a channel."""
    if texture.raw:
        return type(value)(0) == 0
    return (value >= 0) & ((value <= 1) | (texture.space in UNBOUNDED))


def luminance(color: list) -> Any:
    """Return the luminance of three channels, or the one channel there is."""
    return color[0] if len(color) == 1 else mi.luminance(mi.Color3f(*color))


def brightness(texture: Any, color: list) -> Any:
    """Return what the texture reflects or emits in the mean: of wavelengths, where it has spectra.

    Parameters
    ----------
    texture : mitsuba.Texture
    color : list of Float
        Channels from `show`.

    Returns
    -------
    Float
        In spectral variants the mean of the spectrum of `upsample`, as of a ``bitmap``; else the
        luminance.
    """
    if mi.is_spectral and len(color) == 3 and not texture.raw and rendered_as(texture.space):
        return sum(w * c for w, c in zip(mean_weights(), color, strict=True))
    return luminance(color)


def keep_finite(x: Any) -> Any:
    """Replace values that are not finite, which an optimiser may leave, by 0."""
    return dr.select(dr.isfinite(x), x, 0)
