"""Several maps on one set of shapes: their images as one image of many channels.

Each map is multiplied by a factor, so that all gain alike in decibels: by one over the root mean
square error after a first colour solve, or, where each map has a goal, over the error of its goal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.arguments import plain_numbers
from ..backend.arrays import ArrayTypes
from ..gaussian.channels import TextureMap, check_maps, check_name, slices, usual_space
from ..gaussian.gaussians import Gaussians
from ..image.pixels import ImageError
from ..image.space import DATA, Space, space_of
from ..storage.npz import BadValue
from .loss import View
from .measure import Row, psnrs
from .objective import Data, Pixels, data_of, picture
from .options import FitOptions, Goal
from .pixels import read_pixels
from .placement.adaptive import squares_by_channel

Image = NDArray[np.float32]

MIN_MSE = (1 / 255) ** 2 / 12
"""Mean squared error of rounding to 8 bits: maps below it do not get more weight."""


MIN_WEIGHT = 1e-6
"""Smallest weight of a map; the largest is its inverse. Squares of maps that are 1e20 times as
large overflow single precision."""


@dataclass(frozen=True)
class Map:
    """A map in a mapping of images that needs more than pixels.

    Attributes
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W); or path-like or URL
    space : str or None
        By default "linear" for albedo, color and the like, "normal" for normals, and "data" for
        other names, see `eigengs_dr.gaussian.channels.usual_space`.
    weight : float
        Factor of its errors, from 1e-6 to 1e6. It multiplies the factor that `eigengs_dr.fit`
        finds.
    goal : float or None
        The PSNR in dB that it must reach; by default that of the fit.
    """

    image: Any
    space: str | None = None
    weight: float = 1.0
    goal: float | None = None


class MapImage(NamedTuple):
    """The image of one map, checked.

    Attributes
    ----------
    name : str
    space : Space
    pixels : ndarray of float32, shape (H, W, C)
        sRGB, normals or data.
    data : Data
        The image as it would be fitted alone.
    factor : float
        The user's factor of its errors.
    goal : float or None
        The PSNR in dB that it must reach.
    """

    name: str
    space: Space
    pixels: Image
    data: Data
    factor: float = 1.0
    goal: float | None = None

    def map(self, weight: float) -> TextureMap:
        """Return the map for a weight of its errors in the fit, in the unit of the image."""
        scale = self.data.affine.scale
        return TextureMap(self.name, self.space, self.pixels.shape[2], weight / scale)


def read_maps(
    maps: Mapping[str, Any],
    goal: Goal | None = None,
    weight: Image | None = None,
    encoding: str | None = None,
) -> list[MapImage]:
    """Check the images of maps, and convert them to the spaces of their colours.

    For parameters and errors see `eigengs_dr.fit`.
    """
    given = {name: m if isinstance(m, Map) else Map(m) for name, m in maps.items()}
    images = [_read_map(name, m, goal, weight, encoding) for name, m in given.items()]
    sizes = {image.name: f"{image.pixels.shape[1]}x{image.pixels.shape[0]}" for image in images}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise ImageError(f"maps differ in size: {listed}; scale them to one size")
    described = [image.map(1) for image in images]
    try:
        check_maps(described, sum(m.channels for m in described))
    except BadValue as error:
        raise ValueError(str(error)) from None
    lacking = [image.name for image in images if image.goal is None]
    if 0 < len(lacking) < len(images):
        raise ValueError(
            f"map {lacking[0]!r} has no goal; give each map one, or target_psnr for the rest"
        )
    return images


def _read_map(
    name: str, given: Map, goal: Goal | None, weight: Image | None, encoding: str | None
) -> MapImage:
    try:
        check_name(name)
    except BadValue as error:
        raise ValueError(str(error)) from None
    try:
        weights = plain_numbers(vars(given), Map.__annotations__)
        if not MIN_WEIGHT <= weights["weight"] <= 1 / MIN_WEIGHT:
            raise ValueError(f"weight is {given.weight}; it must be from 1e-6 to 1e6")
        space = usual_space(name) if given.space is None else space_of(given.space)
        pixels, space = read_pixels(given.image, space, weight, encoding)
        reached = goal.psnr if goal else None
        reached = Goal(weights["goal"]).psnr if "goal" in weights else reached
    except ValueError as error:
        text = str(error).removeprefix("image: ")
        raise type(error)(f"map {name!r}: {text}") from None
    if space.by_range:
        pixels = _without_copies(pixels)
    return MapImage(name, space, pixels, data_of(pixels, space), weights["weight"], reached)


def _without_copies(pixels: Image) -> Image:
    """Reduce data with three equal channels to one: grey JPEG files often have three."""
    first = pixels[..., :1]
    if pixels.shape[2] == 3 and (pixels == first).all():
        return np.ascontiguousarray(first)
    return pixels


def combine(
    images: Sequence[MapImage],
    factors: Sequence[float],
    types: ArrayTypes,
    weight: Image | None = None,
) -> Pixels:
    """Join images to an objective of all channels, each times the factor of its map.

    Errors of light weigh more in the dark, as in a fit of one image.
    """
    parts = [image.data for image in images]
    values = _join([d.values for d in parts], factors)
    placement_images = _join([d.placement_image for d in parts], factors)
    curvature = weight
    if any(d.curvature is not None for d in parts):
        layers = [np.ones_like(d.values) if d.curvature is None else d.curvature for d in parts]
        curvature = np.concatenate(layers, axis=2)
        if weight is not None:
            curvature *= np.atleast_3d(weight)
    objective = Pixels.of(Data(values, placement_images, curvature), DATA, types)
    firsts = [channels.start for channels in slices([image.map(1) for image in images])]
    pictures = [
        picture(types, image.space, [image.pixels], [image.data], weight, first, factor)
        for image, first, factor in zip(images, firsts, factors, strict=True)
    ]
    return replace(objective, pictures=tuple(pictures))


def views_of(images: Sequence[MapImage], factors: Sequence[float]) -> list[View]:
    """Return the views of the channels of `combine`."""
    maps = [image.map(1) for image in images]
    return [
        View(m.name, m.space, range(channels.start, channels.stop), a.scale / factor, a.offset)
        for m, channels, a, factor in zip(
            maps, slices(maps), (image.data.affine for image in images), factors, strict=True
        )
    ]


def _join(parts: Sequence[Image], factors: Sequence[float]) -> Image:
    return np.concatenate(
        [part * np.float32(f) for part, f in zip(parts, factors, strict=True)], axis=2
    )


def balance(
    images: Sequence[MapImage],
    options: FitOptions,
    count: int,
    types: ArrayTypes,
    weight: Image | None = None,
) -> list[float]:
    """Return the factors of the maps, with the geometric mean 1 but for the user's weights.

    At its goal each map has the same weighted error. Without goals, the sum of the logarithms of
    the errors counts: its derivative weighs squared errors by one over their mean.
    """
    goals = [image.goal for image in images if image.goal is not None]
    if goals:
        peaks = [1.0 if i.space.has_codes(i.pixels) else 1 / i.data.affine.scale for i in images]
        logs = np.array(goals) / 20 * np.log(10)
        logs += np.log([i.data.affine.scale * p for i, p in zip(images, peaks, strict=True)])
    else:
        errors = _first_errors(images, options, count, types, weight)
        logs = -0.5 * np.log(np.maximum(errors, MIN_MSE))
    factors = np.exp(logs - logs.mean()).tolist()
    return [image.factor * factor for image, factor in zip(images, factors, strict=True)]


def _first_errors(
    images: Sequence[MapImage],
    options: FitOptions,
    count: int,
    types: ArrayTypes,
    weight: Image | None,
) -> list[float]:
    """Return the mean squared error of each map after a first colour solve."""
    if len(images) == 1:
        return [1.0]
    objective = combine(images, [1.0] * len(images), types, weight)
    start = options.method.place_and_solve(objective, count, options.seed)
    sums = [s[0] for s in squares_by_channel(start, objective)]
    area = objective.grid.width * objective.grid.height
    ends = np.cumsum([image.pixels.shape[2] for image in images])
    return [float(part.mean()) / area for part in np.split(np.array(sums), ends[:-1])]


def score_maps(
    gaussians: Gaussians, objective: Pixels, images: Sequence[MapImage], goal: Goal | None = None
) -> Row:
    """Measure a set of all channels, each multiplied by the factor of its map.

    Returns
    -------
    dict
        psnr_ycbcr and psnr_rgb, means over the maps that have them; maps, with both of each map;
        and with goals, margin: the decibels of the worst map above its goal.
    """
    figures = psnrs(gaussians, objective.pictures)[..., 0]
    by_name = {
        image.name: dict(zip(_FIGURES, pair.tolist(), strict=True))
        for image, pair in zip(images, figures, strict=True)
    }
    means = [
        float(column[~np.isnan(column)].mean()) if not np.isnan(column).all() else np.nan
        for column in figures.T
    ]
    row: Row = {**dict(zip(_FIGURES, means, strict=True)), "maps": by_name}
    goals = [image.goal for image in images if image.goal is not None]
    if goals and goal:
        reached = [by_name[image.name][goal.key(image.space)] for image in images]
        row["margin"] = min(psnr - goal for psnr, goal in zip(reached, goals, strict=True))
    return row


_FIGURES = ("psnr_ycbcr", "psnr_rgb")
