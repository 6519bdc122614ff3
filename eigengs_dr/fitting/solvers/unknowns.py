"""The unknowns of the colour solve: vectors with a part for each image of a batch."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ...raster.binning.tiles import Grid
from ...raster.kernels import sum_by_image

Unknowns = tuple[list, list]
"""Colours of all Gaussians and backgrounds of all images: a Float for each channel in both."""


def negate(x: Unknowns) -> Unknowns:
    """Return ``-x``."""
    return [-v for v in x[0]], [-v for v in x[1]]


def multiply(x: Unknowns, y: Unknowns) -> Unknowns:
    """Return the products of all entries."""
    color, background = (
        [a * b for a, b in zip(u, v, strict=True)] for u, v in zip(x, y, strict=True)
    )
    return color, background


def dots(x: Unknowns, y: Unknowns, grid: Grid) -> list:
    """Return the inner products for each channel, Floats of shape (images,)."""
    color, background = multiply(x, y)
    dr.eval(color)
    return [sum_by_image(c, grid) + b for c, b in zip(color, background, strict=True)]


def add_multiple(x: Unknowns, factors: list, y: Unknowns, image: Any) -> Unknowns:
    """Return ``x + factor y``; a factor has one value for each image, see `spread`."""
    color = [dr.fma(spread(f, image), b, a) for a, f, b in zip(x[0], factors, y[0], strict=True)]
    return color, [dr.fma(f, b, a) for a, f, b in zip(x[1], factors, y[1], strict=True)]


def spread(values: Any, image: Any) -> Any:
    """Return the value of the image of each entry; `image` is None if there is only one."""
    return values if image is None else dr.gather(type(values), values, image)
