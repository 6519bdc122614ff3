"""A poster on a wall under a lamp, photos of it, and representations of it to recover."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.color import rgb_to_ycbcr, to_coded, to_linear
from eigengs_dr.plugins import keep_in_bounds, texture_of

DEPTH = 3  # longest path: from the lamp to the poster at once, or over the floor
SUBPIXELS = 2  # lookups along a side of a pixel of the recovered poster

# Places of cameras; the poster spans -1 to 1 along x and y.
LEFT, FRONT, RIGHT, GRAZING = (-2.4, 0.4, 3.0), (0, 0, 3.8), (2.4, -0.4, 3.0), (3.5, 0.3, 1.4)


class Condition(NamedTuple):
    """What photos are like: places of cameras, pixels a side, samples a pixel (their noise).

    `hidden` puts a board before the right half; with an aperture the poster is out of focus.
    """

    cameras: tuple[tuple[float, float, float], ...] = (LEFT, FRONT, RIGHT)
    side: int = 128
    samples: int = 1024
    hidden: bool = False
    aperture: float = 0.0
    fov: float = 36.0


CONDITIONS = {
    "cameras": Condition(),
    "grazing": Condition(cameras=(GRAZING,), side=72, aperture=0.08, fov=27.0),
    "hidden": Condition(hidden=True),
    "noise": Condition(samples=4),
}

POSTER = "poster.bsdf.reflectance"  # name of the unknown texture among the parameters of a scene


def scene_of(condition: Condition, texture: Any) -> Any:
    """Load the scene with a texture on the poster; all cameras share one wide film."""
    at = mi.ScalarTransform4f()
    upright = at.scale([1, -1, 1])  # rows of an image run down, v of a rectangle runs up
    lamp = at.look_at([1.5, 3, 3], [0, 0, 0], [0, 1, 0]).scale(0.7)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 40.0}}
    scene = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": DEPTH},
        "sensor": _cameras(condition),
        "poster": _rectangle(upright, {"type": "diffuse", "reflectance": texture}),
        "wall": _rectangle(at.translate([0, 0, -0.01]).scale(5), _grey(0.5)),
        "floor": _rectangle(at.translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(5), _grey(0.4)),
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": light},
    }
    if condition.hidden:
        scene["board"] = _rectangle(at.translate([1, 0, 0.005]).scale([1, 1.2, 1]), _grey(0.2))
    return mi.load_dict(scene)


def photograph(condition: Condition, image: NDArray[np.float32]) -> tuple[Any, Any]:
    """Render the photos of a poster, side by side in linear light, and return its texture too."""
    texture = bitmap(to_linear(image.clip(0, 1)))
    scene = scene_of(condition, texture)
    # Not a seed of the steps: noise that a method could reproduce is no noise.
    return dr.detach(mi.render(scene, spp=condition.samples, seed=1 << 20)), texture


def bitmap(pixels: NDArray[np.float32]) -> Any:
    """Load pixels in linear light, shape (H, W, 3), as a texture with derivatives."""
    data = mi.TensorXf(np.ascontiguousarray(pixels))
    return mi.load_dict({"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"})


def head_on(texture: Any, width: int, height: int) -> NDArray[np.float32]:
    """Look at a texture from the front: RGB of shape (height, width, 3), means of linear light."""
    columns, rows = width * SUBPIXELS, height * SUBPIXELS
    with dr.suspend_grad():
        i = dr.arange(mi.UInt32, columns * rows)
        si = dr.zeros(mi.SurfaceInteraction3f, columns * rows)
        si.uv = mi.Point2f((i % columns + 0.5) / columns, (i // columns + 0.5) / rows)
        color = np.array(texture.eval_3(si)).T
    blocks = color.reshape(height, SUBPIXELS, width, SUBPIXELS, 3)
    return to_coded(blocks.mean(axis=(1, 3)).clip(0, 1).astype(np.float32))


def _cameras(condition: Condition) -> dict[str, Any]:
    side, lens = condition.side, dict[str, Any](type="perspective")
    if condition.aperture:
        lens = {"type": "thinlens", "aperture_radius": condition.aperture, "focus_distance": 2.0}
    film: dict[str, Any] = {"type": "hdrfilm", "pixel_format": "rgb", "width": side, "height": side}
    film["rfilter"] = {"type": "box"}  # every sample counts for its own pixel alone
    batch: dict[str, Any] = {"type": "batch"}
    batch["film"] = {**film, "width": len(condition.cameras) * side}
    for number, place in enumerate(condition.cameras):
        view = mi.ScalarTransform4f().look_at(place, [0, 0, 0], [0, 1, 0])
        camera = {**lens, "fov": condition.fov, "to_world": view, "film": film}
        batch[f"camera{number}"] = camera
    return batch


def _rectangle(place: Any, bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def _grey(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


GREY = 0.5  # coded value that texels and Gaussians start from
# Linear light a step, by the side of the bitmap, for the texel with the largest gradient.
TEXEL_RATES = {256: 0.08, 1024: 0.3}
# Pixels, 1 / pixels and coded values a step.
SPLAT_RATES = {"mean": 0.2, "factor": 0.03, "color": 0.01, "background": 0.005}
# Standard deviations of the first component a step, for the largest gradient.
COEFFICIENTS = f"{POSTER}.coefficients"
COEFFICIENT_RATE = 0.4
# Variance, of the variance of the first component, below which components move less and less: few
# steps find what the first ones say of hidden parts, and the Gaussians do the rest.
DAMPING = 0.05
PRIOR = 1e-5  # weight of ``sum a^2 / lambda`` against the mean squared error of the photos
PULL = 0.5  # weight of the squared distance of colours from the first stage
FIRST_STAGE = 0.04  # share of the steps that the coefficients get before all Gaussians are freed


class Representation(NamedTuple):
    """A texture, and rates of its optimised parameters by their names in the scene.

    Parameters are the values, times `scale` if there is one. ``prior(values, count)`` adds to the
    sum of squared errors of `count` numbers; ``bound(values)`` brings values inside bounds.
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
    # Steps in proportion to gradients (Nicolet et al. 2021): else noise moves unseen texels.
    return Representation(texture, {key: TEXEL_RATES[side]}, {"uniform": True}, bound=bound)


def splats(gaussians: Gaussians, pull: float = 0.0) -> Representation:
    """Describe it by all parameters of Gaussians; colours are pulled to where they start."""
    start = mi.TensorXf(gaussians.to_arrays()["color"])

    def prior(values: Any, count: int) -> Any:
        return pull * dr.sum(dr.square(values[f"{POSTER}.color"] - start), axis=None)

    def bound(values: Any) -> None:
        keep_in_bounds(values, POSTER, gaussians)

    rates = {f"{POSTER}.{name}": rate for name, rate in SPLAT_RATES.items()}
    # A rate for each; gradients below epsilon do not count, as a blurred photo has little detail.
    adam = {"beta_2": 0.99, "epsilon": 0.01}
    return Representation(mi.load_dict(texture_of(gaussians)), rates, adam, prior, bound)


def coefficients(model: EigenGS, file: Any) -> Representation:
    """Describe it by coefficients, in standard deviations of the first, from the mean image.

    The prior is minus the logarithm of their normal density by the PCA, up to a factor.
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
    # Components are orthonormal: one rate fits all, and the usual momentum of 0.9 overshoots.
    adam, rates = {"beta_1": 0.5, "uniform": True}, {COEFFICIENTS: COEFFICIENT_RATE}
    return Representation(texture, rates, adam, prior, scale=mi.TensorXf(scale))


# Representations, and the step at which each ends.
Stages = Iterator[tuple[Representation, int]]


def _splats(model: EigenGS, file: Any, steps: int) -> Stages:
    shapes = model.gaussians.to_arrays()
    mean, factor, color = (shapes[key] for key in ("mean", "factor", "color"))
    grey, size = rgb_to_ycbcr(np.full(3, GREY)), (model.gaussians.width, model.gaussians.height)
    yield splats(Gaussians.from_arrays(mean, factor, np.zeros_like(color), grey, size=size)), steps


def _both(model: EigenGS, file: Any, steps: int) -> Stages:
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
