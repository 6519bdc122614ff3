"""What refinement starts from: Gaussians placed by the image or by a basis, with their colours.

The registries of placements and initialisers are here. To add one, write one file and one entry
below: ``module:function``, which is imported when it is first used.
"""

from __future__ import annotations

from collections.abc import Callable
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..image.color import rgb_to_ycbcr, to_linear

if TYPE_CHECKING:
    from ..gaussian.gaussians import Gaussians
    from .options import FitOptions

PLACEMENTS = {
    "random": "eigengs_dr.fitting.placement.random:place_random",
    "grid": "eigengs_dr.fitting.placement.grid:place_grid",
    "adaptive": "eigengs_dr.fitting.placement.adaptive:place_adaptive",
}
"""Where Gaussians start by the image alone; each entry is a `Placement`."""

INITIALIZERS = {
    **dict.fromkeys(PLACEMENTS, "eigengs_dr.fitting.redistribute:start_from_placement"),
    "eigen": "eigengs_dr.eigenbasis.initializer:start_from_basis",
}
"""Initialisers by the name that ``init`` takes; each entry is an `Initializer`."""

DARKNESS, BLACK = 0.3, 0.003
"""Errors of light I weigh ``max(I, BLACK)^-DARKNESS``: by the root of the slope of the sRGB curve,
between errors of light, which spare the dark, and errors of codes. At 5000 splats and 300 steps
that gains 0.7 dB of psnr_rgb over no weights, on 12 training images of ImageNet classes."""


class Placement(Protocol):
    """Places and shapes Gaussians by the image alone."""

    def __call__(
        self, image: NDArray[np.floating], count: int, generator: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return means (count, 2) in pixels and factors (count, 3) for an image (H, W, C)."""


class FitTarget(NamedTuple):
    """What a fit aims at.

    Attributes
    ----------
    pixels : ndarray of float32, shape (H, W, C)
        The image as it was given: RGB, or data.
    values : ndarray of float32, shape (H, W, C)
        The image in the space of the colours.
    weight : ndarray of float32, shape (H, W, C), or None
        Errors are multiplied by the weight before they are squared.
    """

    pixels: NDArray[np.float32]
    values: NDArray[np.float32]
    weight: NDArray[np.float32] | None = None


class FitProblem(NamedTuple):
    """What descent starts from, and what it aims at.

    Attributes
    ----------
    gaussians : Gaussians
    target : ndarray of float32, shape (H, W, C)
        The image in the space of the set; without the mean image if that one stays pixels.
    weight : ndarray of float32, shape (H, W, C), or None
        Errors are multiplied by the weight before they are squared.
    base_image : ndarray of float32, shape (H, W, 3), or None
        RGB that renderings of the set are added to: the mean image, if it stays pixels.
    redistribute : callable, or None
        ``redistribute(gaussians, count)`` places Gaussians anew where a fitted set left much error;
        None unless the image alone places them.
    """

    gaussians: Gaussians
    target: NDArray[np.float32]
    weight: NDArray[np.float32] | None = None
    base_image: NDArray[np.float32] | None = None
    redistribute: Callable[[Gaussians, int], Gaussians] | None = None


class Initializer(Protocol):
    """Places Gaussians and finds their colours."""

    def __call__(self, target: FitTarget, options: FitOptions) -> FitProblem:
        """Return the start of a fit."""


def initialize(pixels: NDArray[np.float32], options: FitOptions) -> FitProblem:
    """Place Gaussians and find their colours: everything of a fit that comes before refinement.

    Parameters
    ----------
    pixels : ndarray of float32, shape (H, W, C)
        As `eigengs_dr.image.io.check_image` returns them.
    options : FitOptions

    Raises
    ------
    ValueError
        If the basis does not fit the other options; one line.
    """
    start: Initializer = resolve_name(INITIALIZERS[options.initializer])
    return start(make_target(pixels, options.color), options)


def make_target(pixels: NDArray[np.float32], color: str) -> FitTarget:
    """Bring pixels (H, W, C) to the space of the colours, and weigh errors there."""
    if color == "ycbcr":
        return FitTarget(pixels, rgb_to_ycbcr(pixels))
    if color == "linear":
        light = to_linear(pixels)
        return FitTarget(pixels, light, dark_weight(light))
    return FitTarget(pixels, pixels)


def dark_weight(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """What errors of linear light, of any shape, are multiplied by before they are squared.

    ``max(light, BLACK)^-DARKNESS``, where 1 is white; see there.
    """
    return np.asarray(np.maximum(light, BLACK) ** -DARKNESS, np.float32)
