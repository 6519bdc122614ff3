"""Representations of a poster: texels, Gaussians, or coefficients of an eigenbasis."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_bench.experiments.inverse_scene import POSTER, bitmap
from eigengs_dr.color import rgb_to_ycbcr, to_linear
from eigengs_dr.eigengs import EigenGS
from eigengs_dr.gaussians import Gaussians
from eigengs_dr.plugins import keep_in_bounds, texture_of

GREY = 0.5  # coded value that texels and Gaussians start from
# Linear light a step, by the side of the bitmap, for the texel with the largest gradient.
TEXEL_RATES = {256: 0.08, 1024: 0.3}
# Pixels, 1 / pixels and coded values a step.
SPLAT_RATES = {"mean": 0.2, "factor": 0.03, "color": 0.01, "background": 0.005}
# Standard deviations of the first component a step, for the largest gradient.
COEFFICIENT_RATE = 0.4
# Variance, of that of the first component, below which components move less and less: so few steps
# find what the first ones say of hidden parts, and the last ones are left to the splats.
DAMPING = 0.05
PRIOR = 1e-5  # weight of ``sum a^2 / lambda`` against the mean squared error of the photos
PULL = 0.5  # weight of the squared distance of colours from those of the first stage
FIRST_STAGE = 0.04  # share of the steps that the coefficients get before all Gaussians are freed


class Texels:
    """A square bitmap in linear light, from grey.

    Every representation has its Mitsuba texture, rates by the name of a parameter in the scene,
    options of Adam, a prior that is added to the sum of squared errors, and bounds.
    """

    # Steps in proportion to gradients (Nicolet et al. 2021): with a rate for each, noise moves
    # texels that no photo shows well.
    adam: dict[str, Any] = {"uniform": True}  # noqa: RUF012

    def __init__(self, side: int) -> None:
        linear = float(to_linear(np.float64(GREY)))
        self.texture: Any = bitmap(np.full((side, side, 3), linear, np.float32))
        self.rates: dict[str, float] = {f"{POSTER}.data": TEXEL_RATES[side]}

    def begin(self, parameters: Any) -> dict[str, Any]:
        """Values to optimise, by name."""
        return {key: parameters[key] for key in self.rates}

    def put(self, values: Any, parameters: Any) -> None:
        """Write the values into the scene; gradients flow back to them."""
        for key in self.rates:
            parameters[key] = values[key]

    def prior(self, values: Any, count: int) -> Any:
        """Return what is added to the sum of squared errors of so many numbers."""
        return 0

    def bound(self, values: Any) -> None:
        """Bring the values back inside their bounds."""
        for key in self.rates:
            values[key] = dr.clip(values[key], 0, 1)


class Splats(Texels):
    """All parameters of a set of Gaussians, whose colours are pulled to where they start."""

    # A rate for each, in which gradients below epsilon do not count: without, what a blurred photo
    # hardly tells of is made up.
    adam = {"beta_2": 0.99, "epsilon": 0.01}  # noqa: RUF012

    def __init__(self, gaussians: Gaussians, pull: float = 0.0) -> None:
        self.texture = mi.load_dict(texture_of(gaussians))
        self.start, self.pull = gaussians, pull
        self.colors = mi.TensorXf(gaussians.to_arrays()["color"])
        self.rates = {f"{POSTER}.{name}": rate for name, rate in SPLAT_RATES.items()}

    def prior(self, values: Any, count: int) -> Any:
        """Squares of how far the colours went."""
        change = values[f"{POSTER}.color"] - self.colors
        return self.pull * dr.sum(dr.square(change), axis=None)

    def bound(self, values: Any) -> None:
        """Bring means and factors back inside their bounds."""
        keep_in_bounds(values, POSTER, self.start)


class Coefficients(Texels):
    """Coefficients of a model, in standard deviations of the first, from the mean image.

    To a PCA the family's images are normally distributed: that is the prior.
    """

    # Components are orthonormal, so that one rate fits all coefficients; a problem so well
    # conditioned needs less momentum than 0.9, which overshoots.
    adam = {"beta_1": 0.5, "uniform": True}  # noqa: RUF012

    def __init__(self, model: EigenGS, file: Any) -> None:
        self.model = model
        self.texture = mi.load_dict({"type": "gaussian_texture", "model": str(file)})
        variances = np.zeros((len(model.components), max(model.components)))
        for row, values in zip(variances, model.eigenvalues, strict=True):
            row[: len(values)] = values
        largest = variances.max()
        damped = variances + DAMPING * largest
        self.scale = mi.TensorXf(np.sqrt(largest * variances / damped))
        self.precisions = mi.TensorXf(largest / damped)
        self.key = f"{POSTER}.coefficients"
        self.rates = {self.key: COEFFICIENT_RATE}

    def put(self, values: Any, parameters: Any) -> None:
        """Write the coefficients into the scene; gradients flow back to the values."""
        parameters[self.key] = values[self.key] * self.scale

    def prior(self, values: Any, count: int) -> Any:
        """Minus the logarithm of the probability of the coefficients, up to a factor."""
        return PRIOR * count * dr.sum(self.precisions * dr.square(values[self.key]), axis=None)

    def bound(self, values: Any) -> None:
        """Leave them as they are."""

    def gaussians(self) -> Gaussians:
        """The Gaussians that the coefficients stand for now."""
        rows = dr.detach(mi.traverse(self.texture)["coefficients"]).numpy()
        kept = zip(rows, self.model.components, strict=True)
        return self.model.reconstruct(tuple(row[:k] for row, k in kept))


# What is optimised, and the step at which that ends; each made when the one before is through.
Stages = Iterator[tuple[Texels, int]]


def _splats(model: EigenGS, file: Any, steps: int) -> Stages:
    """The model's shapes, without colour on grey."""
    shapes = model.gaussians.to_arrays()
    mean, factor, color = (shapes[key] for key in ("mean", "factor", "color"))
    grey, size = rgb_to_ycbcr(np.full(3, GREY)), (model.gaussians.width, model.gaussians.height)
    yield Splats(Gaussians.from_arrays(mean, factor, np.zeros_like(color), grey, size=size)), steps


def _both(model: EigenGS, file: Any, steps: int) -> Stages:
    first = Coefficients(model, file)
    yield first, max(1, round(FIRST_STAGE * steps))
    yield Splats(first.gaussians(), PULL), steps


# How to recover a poster, from a model, its file and the number of steps.
METHODS: dict[str, Callable[[EigenGS, Any, int], Stages]] = {
    "texels1024": lambda model, file, steps: iter([(Texels(1024), steps)]),
    "texels256": lambda model, file, steps: iter([(Texels(256), steps)]),
    "gaussians": _splats,
    "coefficients": lambda model, file, steps: iter([(Coefficients(model, file), steps)]),
    "both": _both,
}
