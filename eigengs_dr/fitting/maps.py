"""Several maps on one set of shapes: their images as one image of many channels.

Each map is multiplied by a weight, so that all gain alike in decibels: by one over the root mean
square error after a first colour solve, or, where each map has a goal, over the error of its goal.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..gaussian.channels import TextureMap, check_maps, check_name, slices, usual_space
from ..gaussian.gaussians import Gaussians
from ..image.color import rendered_as
from ..image.metrics import target_key
from ..image.pixels import ImageError
from ..storage.npz import BadValue
from .measure import Row, Shown, psnrs
from .options import FitOptions, check_goal
from .placement.adaptive import residual
from .start import start_from_placement
from .target import FitTarget, make_target, read_pixels, unit_of

Image = NDArray[np.float32]

MIN_MSE = (1 / 255) ** 2 / 12
"""Mean squared error of rounding to 8 bits: maps below it do not get more weight."""


class MapImage(NamedTuple):
    """The image of one map.

    Attributes
    ----------
    name : str
    space : str
        Space of the Gaussians, one of `eigengs_dr.image.color.SPACES`.
    pixels : ndarray of float32, shape (H, W, C)
        sRGB, normals or data, in units of `unit`.
    unit : float
        1, or the largest value of data above 1.5.
    factor : float
        The user's factor of its errors.
    goal : float or None
        The PSNR in dB that it shall reach.
    """

    name: str
    space: str
    pixels: Image
    unit: float
    factor: float = 1.0
    goal: float | None = None

    def map(self, weight: float) -> TextureMap:
        """Return the map for a weight of its errors in the fit, in the unit of the image."""
        return TextureMap(self.name, self.space, self.pixels.shape[2], weight / self.unit)


def read_maps(
    maps: Mapping[str, ArrayLike],
    spaces: Mapping[str, str] | None = None,
    encoding: str | None = None,
    weights: Mapping[str, float] | None = None,
    target_psnr: float | Mapping[str, float] | None = None,
) -> list[MapImage]:
    """Check the images of maps, and convert them to sRGB, normals or data.

    For parameters and errors see `eigengs_dr.fit`.
    """
    spaces = spaces or {}
    if unknown := [name for name in spaces if name not in maps]:
        raise ValueError(f"space names {unknown[0]!r}, which is no map; maps are {_list(maps)}")
    images = [_read_map(name, image, spaces.get(name), encoding) for name, image in maps.items()]
    sizes = {image.name: f"{image.pixels.shape[1]}x{image.pixels.shape[0]}" for image in images}
    if len(set(sizes.values())) > 1:
        shown = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise ImageError(f"maps differ in size: {shown}; scale them to one size")
    found = [TextureMap(i.name, i.space, i.pixels.shape[2]) for i in images]
    try:
        check_maps(found, sum(m.channels for m in found))
    except BadValue as error:
        raise ValueError(str(error)) from None
    goals, factors = _goals(images, target_psnr), _factors(images, weights or {})
    return [
        image._replace(factor=factor, goal=goal)
        for image, factor, goal in zip(images, factors, goals, strict=True)
    ]


def _read_map(name: str, image: ArrayLike, space: str | None, encoding: str | None) -> MapImage:
    try:
        check_name(name)
    except BadValue as error:
        raise ValueError(str(error)) from None
    try:
        options = FitOptions(space=space or usual_space(name), encoding=encoding)
        pixels, options = read_pixels(image, options)
    except ValueError as error:
        text = str(error).removeprefix("image: ")
        raise type(error)(f"map {name!r}: {text}") from None
    if rendered_as(options.space) is None and options.space != "normal":
        pixels = _without_copies(pixels)
    unit = unit_of(pixels, options.space)
    return MapImage(name, options.space, pixels if unit == 1 else pixels / np.float32(unit), unit)


def _without_copies(pixels: Image) -> Image:
    """Return one channel of data whose three are equal: JPEG files of grey often have three."""
    first = pixels[..., :1]
    if pixels.shape[2] == 3 and (pixels == first).all():
        return np.ascontiguousarray(first)
    return pixels


def _goals(
    images: Sequence[MapImage], target: float | Mapping[str, float] | None
) -> list[float | None]:
    """Return the goal of each map in dB, if there are goals; check their names."""
    if target is None:
        return [None] * len(images)
    names = [image.name for image in images]
    if not isinstance(target, Mapping):
        target = dict.fromkeys(names, target)
    if sorted(target) != sorted(names):
        raise ValueError(
            f"target_psnr names {', '.join(target)}; give one number, or one for each of "
            f"{', '.join(names)}"
        )
    goals = [float(target[name]) for name in names]
    for goal in goals:
        check_goal(goal)
    return [*goals]


def _factors(images: Sequence[MapImage], weights: Mapping[str, float]) -> list[float]:
    """Return the factor of the errors of each map; check the names."""
    names = [image.name for image in images]
    for name, weight in weights.items():
        if name not in names:
            raise ValueError(f"weights names {name!r}, which is no map; maps are {names}")
        if not (np.isfinite(weight) and weight > 0):
            raise ValueError(f"weights: {name!r} has {weight}; it must be above 0")
    return [float(weights.get(name, 1.0)) for name in names]


def shape_of(images: Sequence[MapImage]) -> NDArray[np.float32]:
    """Return an image without memory that has the shape of all maps."""
    channels = sum(image.pixels.shape[2] for image in images)
    return np.broadcast_to(np.float32(0), (*images[0].pixels.shape[:2], channels))


def combine(images: Sequence[MapImage], weights: Sequence[float]) -> FitTarget:
    """Join images to one of all channels, each times the weight of its map.

    Returns
    -------
    FitTarget
        Errors of light weigh more in the dark, as in a fit of one image.
    """
    targets = [make_target(image.pixels, image.space) for image in images]
    values = _join([t.values for t in targets], weights)
    shown = _join([t.shown for t in targets], weights)
    dark = None
    if any(t.weight is not None for t in targets):
        ones = [np.ones_like(t.values) if t.weight is None else t.weight for t in targets]
        dark = np.concatenate(ones, axis=2)
    return FitTarget(values, values, shown, dark)


def _join(parts: Sequence[Image], weights: Sequence[float]) -> Image:
    return np.concatenate(
        [part * np.float32(w) for part, w in zip(parts, weights, strict=True)], axis=2
    )


def balance(images: Sequence[MapImage], options: FitOptions) -> list[float]:
    """Return the weights of the maps, with the geometric mean 1 but for the user's factors.

    At its goal each map has the same weighted error. Without goals, the sum of the logarithms of
    the errors counts: its derivative weighs squared errors by one over their mean.
    """
    goals = [image.goal for image in images if image.goal is not None]
    if goals:
        logs = np.array(goals) / 20 * np.log(10)
    else:
        errors = _first_errors(images, options)
        logs = -0.5 * np.log(np.maximum(errors, MIN_MSE))
    weights = np.exp(logs - logs.mean()).tolist()
    return [image.factor * weight for image, weight in zip(images, weights, strict=True)]


def _first_errors(images: Sequence[MapImage], options: FitOptions) -> list[float]:
    """Return the mean squared error of each map after a first colour solve."""
    if len(images) == 1:
        return [1.0]
    target = combine(images, [1.0] * len(images))
    start = start_from_placement(target, options).gaussians
    missed = residual(start, target.values)
    if target.weight is not None:
        missed *= target.weight
    squares = np.square(missed).mean(axis=(0, 1), dtype=np.float64)
    ends = np.cumsum([image.pixels.shape[2] for image in images])
    return [float(part.mean()) for part in np.split(squares, ends[:-1])]


def score_maps(
    gaussians: Gaussians,
    images: Sequence[MapImage],
    weights: Sequence[float],
    started: float,
    space: str = "rgb",
) -> Row:
    """Measure a set of all channels, each times the weight of its map.

    Returns
    -------
    dict
        seconds; psnr_ycbcr and psnr_rgb, means over the maps; maps, with both of each map; and with
        goals, margin: how far the map that is farthest from its goal is above it, in dB.
    """
    own = slices([image.map(1) for image in images])
    parts = [
        Shown(image.pixels, image.space, channels, weight)
        for image, channels, weight in zip(images, own, weights, strict=True)
    ]
    figures = psnrs(gaussians, parts)[..., 0]
    found = {
        image.name: dict(zip(_FIGURES, pair.tolist(), strict=True))
        for image, pair in zip(images, figures, strict=True)
    }
    row = {
        "seconds": time.perf_counter() - started,
        **dict(zip(_FIGURES, figures.mean(axis=0).tolist(), strict=True)),
        "maps": found,
    }
    goals = [image.goal for image in images if image.goal is not None]
    if goals:
        levels = [found[image.name][target_key(image.space, space)] for image in images]
        row["margin"] = min(level - goal for level, goal in zip(levels, goals, strict=True))
    return row


_FIGURES = ("psnr_ycbcr", "psnr_rgb")


def _list(names: Iterable[str]) -> str:
    return ", ".join(map(str, names)) or "none"
