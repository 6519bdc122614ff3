"""The bounds of the parameters of Gaussians."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend.arrays import types_of

MIN_DEVIATION = 0.25
"""Smallest standard deviation along an axis of the factor, in pixels. A narrower Gaussian can fall
between pixel centres, where it has no gradient."""


def clip_parameters(
    mean: Any, factor: Any, color: Any, background: Any, width: Any, height: Any
) -> tuple[Any, Any, Any, Any]:
    """Return the parameters of Gaussians within their bounds.

    A mean lies in the image. a and c lie between 1 / (twice the longer side) and
    1 / `MIN_DEVIATION`, and b within +-1 / `MIN_DEVIATION`. A mean that is not finite becomes the
    centre of the image, a and c become 1 / `MIN_DEVIATION`, b and colours become 0.

    Parameters
    ----------
    mean, factor, color, background
        See `eigengs_dr.Gaussians`.
    width, height : Float, shape (1,)
        Native size in pixels.
    """
    types = types_of(mean)
    # In double precision, because cuda divides approximately in single.
    longer = dr.float64_array_t(types.Float)(dr.maximum(width, height))
    low, high = types.Float(0.5 / longer), 1 / MIN_DEVIATION

    def inside(x: Any, low: Any, high: Any, otherwise: Any) -> Any:
        return dr.select(dr.isfinite(x), dr.clip(x, low, high), otherwise)

    a, b, c = factor
    return (
        types.Float2(
            inside(mean[0], 0.0, width, 0.5 * width), inside(mean[1], 0.0, height, 0.5 * height)
        ),
        types.Float3(
            inside(a, low, high, high), inside(b, -high, high, 0.0), inside(c, low, high, high)
        ),
        dr.select(dr.isfinite(color), color, 0),
        dr.select(dr.isfinite(background), background, 0),
    )
