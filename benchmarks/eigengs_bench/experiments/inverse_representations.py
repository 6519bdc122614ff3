"""Representations of a poster: texels, Gaussians, or coefficients of an eigenbasis."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_bench.experiments.inverse_scene import POSTER, bitmap
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.color import rgb_to_ycbcr, to_linear
from eigengs_dr.plugins import keep_in_bounds, texture_of

GREY = 0.5  # coded value that texels and Gaussians start from
# Linear light a step, by the side of the bitmap, for the texel with the largest gradient.
TEXEL_RATES = {256: 0.08, 1024: 0.3}
# Pixels, 1 / pixels and coded values a step.
SPLAT_RATES = {"mean": 0.2, "factor": 0.03, "color": 0.01, "background": 0.005}
# Standard deviations of the first component a step, for the largest gradient.
COEFFICIENTS = f"{POSTER}.coefficients"
COEFFICIENT_RATE = 0.4
# Variance, of that of the first component, below which components move less and less: so few steps
# find what the first ones say of hidden parts, and the last ones are left to the splats.
DAMPING = 0.05
PRIOR = 1e-5  # weight of ``sum a^2 / lambda`` against the mean squared error of the photos
PULL = 0.5  # weight of the squared distance of colours from those of the first stage
FIRST_STAGE = 0.04  # share of the steps that the coefficients get before all Gaussians are freed


class Representation(NamedTuple):
    """A texture, and what is optimised of it: rates by the name of a parameter in the scene.

    Parameters are the values, times `scale` if there is one. ``prior(values, count)`` is added to
    the sum of squared errors of so many numbers; ``bound(values)`` brings values inside bounds.
    """

    texture: Any
    rates: dict[str, float]
    adam: dict[str, Any]
    prior: Callable[[Any, int], Any] = lambda values, count: 0
    bound: Callable[[Any], None] = lambda values: None
    scale: Any = None

    def put(self, values: Any, parameters: Any) -> None:
        """Write the values into the scene; gradients flow back to them."""
        for key in self.rates:
            parameters[key] = values[key] if self.scale is None else values[key] * self.scale


def texels(side: int) -> Representation:
    """Describe the poster by a square bitmap in linear light, from grey."""
    key, linear = f"{POSTER}.data", float(to_linear(np.float64(GREY)))

    def bound(values: Any) -> None:
        values[key] = dr.clip(values[key], 0, 1)

    texture = bitmap(np.full((side, side, 3), linear, np.float32))
    # Steps in proportion to gradients (Nicolet et al. 2021): with a rate for each, noise moves
    # texels that no photo shows well.
    return Representation(texture, {key: TEXEL_RATES[side]}, {"uniform": True}, bound=bound)


def splats(gaussians: Gaussians, pull: float = 0.0) -> Representation:
    """Describe it by all parameters of Gaussians; colours are pulled to where they start."""
    start = mi.TensorXf(gaussians.to_arrays()["color"])

    def prior(values: Any, count: int) -> Any:
        return pull * dr.sum(dr.square(values[f"{POSTER}.color"] - start), axis=None)

    def bound(values: Any) -> None:
        keep_in_bounds(values, POSTER, gaussians)

    rates = {f"{POSTER}.{name}": rate for name, rate in SPLAT_RATES.items()}
    # A rate for each, in which gradients below epsilon do not count: without, what a blurred photo
    # hardly tells of is made up.
    adam = {"beta_2": 0.99, "epsilon": 0.01}
    return Representation(mi.load_dict(texture_of(gaussians)), rates, adam, prior, bound)


def coefficients(model: EigenGS, file: Any) -> Representation:
    """Describe it by coefficients, in standard deviations of the first, from the mean image.

    To a PCA the family's images are normally distributed: the prior is minus the logarithm of the
    probability of the coefficients, up to a factor.
    """
    variances = np.zeros((len(model.components), max(model.components)))
    for row, values in zip(variances, model.eigenvalues, strict=True):
        row[: len(values)] = values
    largest = variances.max()
    damped = variances + DAMPING * largest
    scale, precisions = np.sqrt(largest * variances / damped), mi.TensorXf(largest / damped)

    def prior(values: Any, count: int) -> Any:
        return PRIOR * count * dr.sum(precisions * dr.square(values[COEFFICIENTS]), axis=None)

    texture = mi.load_dict({"type": "gaussian_texture", "model": str(file)})
    # Components are orthonormal, so that one rate fits all coefficients; a problem so well
    # conditioned needs less momentum than 0.9, which overshoots.
    adam, rates = {"beta_1": 0.5, "uniform": True}, {COEFFICIENTS: COEFFICIENT_RATE}
    return Representation(texture, rates, adam, prior, scale=mi.TensorXf(scale))


# What is optimised, and the step at which that ends; each made when the one before is through.
Stages = Iterator[tuple[Representation, int]]


def _splats(model: EigenGS, file: Any, steps: int) -> Stages:
    """The model's shapes, without colour on grey."""
    shapes = model.gaussians.to_arrays()
    mean, factor, color = (shapes[key] for key in ("mean", "factor", "color"))
    grey, size = rgb_to_ycbcr(np.full(3, GREY)), (model.gaussians.width, model.gaussians.height)
    yield splats(Gaussians.from_arrays(mean, factor, np.zeros_like(color), grey, size=size)), steps


def _both(model: EigenGS, file: Any, steps: int) -> Stages:
    """Coefficients first, then the Gaussians that they stand for."""
    first = coefficients(model, file)
    yield first, max(1, round(FIRST_STAGE * steps))
    rows = dr.detach(mi.traverse(first.texture)["coefficients"]).numpy()
    found = model.reconstruct(tuple(r[:k] for r, k in zip(rows, model.components, strict=True)))
    yield splats(found, PULL), steps


# How to recover a poster, from a model, its file and the number of steps.
METHODS: dict[str, Callable[[EigenGS, Any, int], Stages]] = {
    "texels1024": lambda model, file, steps: iter([(texels(1024), steps)]),
    "texels256": lambda model, file, steps: iter([(texels(256), steps)]),
    "gaussians": _splats,
    "coefficients": lambda model, file, steps: iter([(coefficients(model, file), steps)]),
    "both": _both,
}
