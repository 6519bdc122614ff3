"""What a fit has to do, in one record, whatever it was given: an image, a batch, maps, or a loss.

Several maps on one set of shapes are one image of many channels. Each map is multiplied by a
factor, so that all gain alike in decibels: by one over the root mean square error after a first
colour solve, or, where each map has a goal, over the error of its goal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, types_in, types_of
from ..backend.entry_points import check_types
from ..backend.selection import select
from ..backend.types import ArrayLike, PathLike, Values
from ..gaussian.channels import TextureMap, check_maps, check_name, slices, usual_space
from ..gaussian.gaussians import Gaussians, one_image
from ..image.io import read_image
from ..image.metrics import MAX_PSNR
from ..image.pixels import WHITE, EncodedImage, ImageError, codes_of, data_of, floats_of
from ..image.space import DATA, YCBCR, Space, space_of
from ..raster.tiles import Grid
from .channels import Channels, Measured, Row, Target, psnrs, restored
from .loss import PictureLoss
from .method import Model
from .objective import Objective, Pixels, squares_of
from .options import FitOptions, Goal, conflict_in
from .redistribution import squares_by_channel
from .start import check_start, load_start, set_in

Image = NDArray[np.float32]

PixelsOrPath: TypeAlias = ArrayLike | PathLike | EncodedImage
"""An image: array_like pixels, such as a ``mitsuba.Bitmap``; pixels that know their encoding; or
the path or the address of a file."""

Spaces: TypeAlias = "str | Mapping[str, str] | None"
"""The space of a picture, or those of several maps by name; data have one channel."""

MIN_MSE = (1 / 255) ** 2 / 12
"""Mean squared error of rounding to 8 bits: maps below it do not get more weight."""

MIN_WEIGHT = 1e-6
"""Smallest weight of a map; the largest is its inverse. Squares of maps that are 1e20 times as
large overflow single precision."""


@dataclass(frozen=True)
class Map:
    """A map of a material with more than pixels: a space, a weight or a goal.

    Attributes
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W); or path-like
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


# ---------------------------------------------------------------------------------------------
#  The record
# ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """What a fit has to do.

    Attributes
    ----------
    channels : tuple of Channels
    size : (int, int)
        Width and height in pixels.
    options : FitOptions
    start : Gaussians, Model or None
    weight : ndarray of float32, shape (H, W) or (H, W, C), or None
        Factors of the squared errors; without an image, how much each pixel matters.
    """

    channels: tuple[Channels, ...]
    size: tuple[int, int]
    options: FitOptions
    start: Gaussians | Model | None = None
    weight: Image | None = None

    @property
    def types(self) -> ArrayTypes:
        """Backend and precision of the sets: those of the start."""
        if self.start is None:
            return types_in(select(self.options.backend))
        return types_of(set_in(self.start).mean)

    @property
    def number(self) -> int:
        """Number of channels of a set."""
        return int(self.channels[-1].part.stop)

    @property
    def images(self) -> int:
        """Number of images of a batch."""
        return max(1, len(self.channels[0].targets))

    @property
    def has_maps(self) -> bool:
        """Whether the channels have names."""
        return bool(self.channels[0].name)

    @property
    def space(self) -> Space:
        """The space of a set of all channels."""
        return DATA if self.has_maps else self.channels[0].space

    @property
    def first_count(self) -> int:
        """Number of Gaussians that are placed first: a given number, or the first of a search."""
        area = self.size[0] * self.size[1]
        if self.options.searches:
            return self.options.first_try(area, self.number)
        return self.options.count_for(area)

    @property
    def levels(self) -> tuple[int, ...]:
        """Numbers of Gaussians up to each level; () without levels."""
        return self.options.levels_for(self.size[0] * self.size[1])

    @property
    def max_count(self) -> int:
        """Largest number of Gaussians that a search tries."""
        return self.options.max_count_for(self.size[0] * self.size[1], self.number)

    def pixels(self) -> Pixels:
        """Return the squared error of the images, with what the PSNRs need."""
        pixels = squares_of(self.channels, self.types, self.weight)
        pictures = tuple(c.picture(pixels.types, self.weight) for c in self.channels)
        return replace(pixels, pictures=pictures)

    def picture_loss(self) -> PictureLoss | None:
        """Return the loss of the user for the pictures of the fit, if there is one."""
        loss = self.options.loss
        return None if loss is None else PictureLoss(loss, self.channels, Grid(*self.size))

    def balanced(self, count: int) -> Problem:
        """Return the problem with factors of its maps by which all gain alike.

        Their geometric mean is 1 but for the user's weights. At its goal each map has the same
        weighted error. Without goals, the sum of the logarithms of the errors counts: its
        derivative weighs squared errors by one over their mean.

        Parameters
        ----------
        count : int
            Number of Gaussians of the first colour solve.
        """
        if not self.has_maps:
            return self
        if self.channels[0].goal is not None:
            logs = np.array([c.goal for c in self.channels]) / 20 * np.log(10)
            logs -= np.log([c.peak for c in self.channels])
        else:
            logs = -0.5 * np.log(np.maximum(self._first_errors(count), MIN_MSE))
        factors = np.exp(logs - logs.mean()).tolist()
        pairs = zip(self.channels, factors, strict=True)
        return replace(self, channels=tuple(c._replace(factor=c.factor * f) for c, f in pairs))

    def _first_errors(self, count: int) -> list[float]:
        """Return the mean squared error of each map after a first colour solve."""
        if len(self.channels) == 1:
            return [1.0]
        plain = replace(self, channels=tuple(c._replace(factor=1.0) for c in self.channels))
        pixels, options = plain.pixels(), self.options
        start = options.method.place_and_solve(pixels, count, options.seed)
        sums = np.array([s[0] for s in squares_by_channel(start, pixels)])
        return [float(sums[c.part].mean()) / np.prod(self.size) for c in self.channels]

    def measure(self, gaussians: Gaussians, objective: Objective, started: float) -> list[Measured]:
        """Measure a set, or the sets of a batch.

        Rows hold the seconds since `started`, a `time.perf_counter`, what the objective judges, and
        psnr_ycbcr and psnr_rgb: means over the maps that have them. Maps add maps, with both PSNRs
        of each, and with goals margin.
        """
        figures = psnrs(gaussians, objective.image.pictures)
        judged, goal = objective.judged(gaussians), self.options.goal
        seconds = time.perf_counter() - started  # steps run asynchronously, up to the figures
        measured = []
        for image in range(self.images):
            pairs = [dict(zip(_FIGURES, f.tolist(), strict=True)) for f in figures[..., image]]
            row: Row = {"seconds": seconds / self.images, **judged}
            row |= {name: _mean([pair[name] for pair in pairs]) for name in _FIGURES}
            if self.has_maps:
                row["maps"] = {c.name: p for c, p in zip(self.channels, pairs, strict=True)}
            margin = judged.get("margin", np.inf)
            if goal is not None:
                reached = zip(self.channels, pairs, strict=True)
                # The PSNR without an error is infinite, and the difference of two such is not a
                # number.
                margin = min(
                    min(_reached(pair, goal.key(c.space)), MAX_PSNR) - (c.goal or goal.psnr)
                    for c, pair in reached
                )
                if self.has_maps:
                    row["margin"] = margin
            measured.append(Measured(row, margin))
        return measured

    def fitted(self, gaussians: Gaussians) -> Gaussians:
        """Return a set of one image in the units of the fit: the inverse of `restored`."""
        scale, offset = self.channels[0].unit()
        background = (gaussians.background - offset) * (1 / scale)
        return replace(gaussians, color=gaussians.color * (1 / scale), background=background)

    def restored(self, gaussians: Gaussians, image: int = 0) -> Gaussians:
        """Return a set in the units of an image, with its maps."""
        maps = tuple(c.map for c in self.channels) if self.has_maps else ()
        units = [c.unit(image) for c in self.channels for _ in range(c.number)]
        return replace(restored(gaussians, units), maps=maps)


_FIGURES = ("psnr_ycbcr", "psnr_rgb")


def _reached(pair: dict[str, float], key: str) -> float:
    """Return the PSNR that counts for a goal: an exact picture reaches each.

    In 8 bits, 127.5 rounds to either side: rounding errors of floats would make about 50 dB of it.
    """
    return math.inf if pair["psnr_ycbcr"] > MAX_PSNR else pair[key]


def _mean(figures: list[float]) -> float:
    """Return the mean of the figures that are numbers; NaN if none is."""
    known = [figure for figure in figures if not np.isnan(figure)]
    return float(np.mean(known)) if known else np.nan


# ---------------------------------------------------------------------------------------------
#  From arguments to the record
# ---------------------------------------------------------------------------------------------


def problem_of(
    image: Any,
    options: FitOptions,
    weight: Image | None = None,
    size: tuple[int, int] | None = None,
    spaces: Spaces = None,
) -> Problem:
    """Return the problem of what `eigengs_dr.fit` was given.

    Raises
    ------
    ValueError
        If an image is unusable, or an argument would not be used.
    """
    given = options.given | {"size": size, "space": spaces}
    kind = "maps" if isinstance(image, Mapping) else "image"
    if conflict := conflict_in(given | {kind: image}):
        raise ValueError(conflict)
    if image is None:
        return _problem_of_loss(options, weight, size, spaces)
    if isinstance(image, Mapping):
        return _problem_of_maps(image, options, weight)
    if isinstance(spaces, Mapping):
        raise ValueError("spaces by name are for the maps of a loss; give an image one space")
    return problem_of_images([image], options, weight)


def problem_of_images(
    images: Sequence[PixelsOrPath], options: FitOptions, weight: Image | None = None
) -> Problem:
    """Return the problem of an image, or of a batch of images of one size."""
    start = None if options.start is None else load_start(options.start, options.backend)
    if isinstance(start, Gaussians):
        one_image(start)
    requested = options.space or (YCBCR if start is None else set_in(start).space)
    read = [pixels_in(image, requested, weight, options.encoding) for image in images]
    space, (height, width, channels) = read[0][1], read[0][0].shape
    options.check_image(width, height, channels)
    _check_weight_channels(weight, channels)
    if start is not None:
        check_start(set_in(start), (width, height), channels, space, options)
    targets = tuple(Target.of(pixels, space) for pixels, _ in read)
    one = Channels("", space, slice(0, channels), targets)
    return Problem((one,), (width, height), options, start, weight)


def _problem_of_maps(maps: Mapping[str, Any], options: FitOptions, weight: Image | None) -> Problem:
    """Return the problem of the images of maps."""
    channels = read_maps(maps, options.goal, weight, options.encoding)
    if options.goal is None and channels[0].goal is not None:
        if conflict := conflict_in(options.given | {"Map.goal": channels[0].goal}):
            raise ValueError(conflict)
        options = replace(options, target_psnr=Goal(channels[0].goal))
    height, width = channels[0].targets[0].pixels.shape[:2]
    options.check_image(width, height, channels[-1].part.stop)
    _check_weight_channels(weight, 1)
    return Problem(channels, (width, height), options, None, weight)


def _problem_of_loss(
    options: FitOptions, weight: Image | None, size: Any, spaces: Spaces
) -> Problem:
    """Return the problem of a loss whose picture is unknown."""
    loss = options.loss
    if loss is None or size is None:
        raise ValueError(
            "fit needs an image, or a loss and the size of its picture: "
            "fit(loss=f, size=(width, height))"
        )
    if np.shape(size) != (2,) or np.asarray(size).dtype.kind not in "iu":
        raise ValueError(f"size is {size!r}; give (width, height) in whole pixels")
    start = None if options.start is None else load_start(options.start, options.backend)
    if start is not None and not isinstance(start, Gaussians):
        raise ValueError("a model needs an image to start from; give a set")
    if start is not None and spaces is None:
        spaces = {m.name: m.space for m in start.maps} or start.space
    channels, (width, height) = _unknown_channels(spaces or loss.space), size
    problem = Problem(channels, (int(width), int(height)), options, start, weight)
    options.check_image(width, height, problem.number)
    if weight is not None and weight.shape[:2] != (height, width):
        shape = f"{weight.shape[1]}x{weight.shape[0]}"
        raise ValueError(f"weight is for {shape} pixels, but size is {width}x{height}")
    _check_weight_channels(weight, 1 if problem.has_maps else problem.number)
    if start is not None:
        check_start(start, problem.size, problem.number, problem.space, options)
    return problem


def _unknown_channels(spaces: Spaces) -> tuple[Channels, ...]:
    """Return channels by their spaces, of a picture or of maps by name."""
    named = spaces if isinstance(spaces, Mapping) else {"": YCBCR if spaces is None else spaces}
    known = {name: space_of(space) for name, space in named.items()}
    maps = [TextureMap(name, s, 1 if s.by_range else 3) for name, s in known.items()]
    if isinstance(spaces, Mapping):
        check_maps(maps, sum(m.channels for m in maps))
    return tuple(
        Channels(m.name, m.space, part) for m, part in zip(maps, slices(maps), strict=True)
    )


def read_maps(
    maps: Mapping[str, Any],
    goal: Goal | None = None,
    weight: Image | None = None,
    encoding: str | None = None,
) -> tuple[Channels, ...]:
    """Check the images of maps, and convert them to the spaces of their colours.

    Their factors are the weights of the user. For parameters and errors see `eigengs_dr.fit`.
    """
    given = {name: m if isinstance(m, Map) else Map(m) for name, m in maps.items()}
    read = {name: _read_map(name, m, goal, weight, encoding) for name, m in given.items()}
    sizes = {
        n: f"{c.targets[0].pixels.shape[1]}x{c.targets[0].pixels.shape[0]}" for n, c in read.items()
    }
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise ImageError(f"maps differ in size: {listed}; scale them to one size")
    described = [TextureMap(c.name, c.space, c.number) for c in read.values()]
    check_maps(described, sum(m.channels for m in described))
    lacking = [name for name, c in read.items() if c.goal is None]
    if 0 < len(lacking) < len(read):
        raise ValueError(
            f"map {lacking[0]!r} has no goal; give each map one, or target_psnr for the rest"
        )
    pairs = zip(read.values(), slices(described), strict=True)
    return tuple(channels._replace(part=part) for channels, part in pairs)


def _read_map(
    name: str, given: Map, goal: Goal | None, weight: Image | None, encoding: str | None
) -> Channels:
    check_name(name)
    try:
        numbers = check_types(vars(given), Map.__annotations__)
        if not MIN_WEIGHT <= numbers["weight"] <= 1 / MIN_WEIGHT:
            raise ValueError(f"weight is {given.weight}; it must be from 1e-6 to 1e6")
        space = usual_space(name) if given.space is None else space_of(given.space)
        pixels, space = pixels_in(given.image, space, weight, encoding)
        reached = goal.psnr if goal else None
        reached = Goal(numbers["goal"]).psnr if "goal" in numbers else reached
    except (TypeError, ValueError) as error:
        text = str(error).removeprefix("image: ")
        raise type(error)(f"map {name!r}: {text}") from None
    if space.by_range and pixels.shape[2] == 3 and (pixels == pixels[..., :1]).all():
        pixels = np.ascontiguousarray(pixels[..., :1])  # grey JPEG files often have three channels
    part, factor = slice(0, pixels.shape[2]), numbers["weight"]
    return Channels(name, space, part, (Target.of(pixels, space),), factor, reached)


def pixels_in(
    image: PixelsOrPath, space: Space, weight: Image | None = None, encoding: str | None = None
) -> tuple[Image, Space]:
    """Check an image, and convert it to display values (sRGB).

    Parameters
    ----------
    image : array_like
        See `eigengs_dr.fit`.
    space : Space
    weight : ndarray, shape (H, W) or (H, W, C), optional
        From `check_weight`. Pixels without any weight get the value of the nearest pixel with
        weight.
    encoding : {"srgb", "linear"}, optional

    Returns
    -------
    pixels : ndarray of float32, shape (H, W, 3) or (H, W, 1)
        sRGB, above 1 for light above 1; or the data. They may be the image itself.
    space : Space
        The given space, or another if the image is light above 1, see `Space.above_white`.

    Raises
    ------
    ImageError
        If the image is unusable.
    """
    read = read_image(image, not space.is_color, encoding if space.is_color else "linear")
    if weight is not None:
        read = read._replace(pixels=_filled(read, weight))
    if not space.is_color:
        pixels = data_of(read)
        space.check(pixels)
        return pixels, space
    pixels = codes_of(floats_of(read))
    bright = read.encoding == "linear" and pixels.max() > WHITE
    return pixels, space.above_white if bright else space


def _check_weight_channels(weight: Image | None, channels: int) -> None:
    """Raise ValueError unless weights (H, W) or (H, W, C) fit the number of channels."""
    if weight is not None and weight.ndim == 3 and weight.shape[2] not in (1, channels):
        raise ValueError(
            f"weight has {weight.shape[2]} channels, but the fit has {channels}; give (H, W), or "
            f"(H, W, {channels})"
        )


def _filled(image: EncodedImage, weight: Image) -> Values:
    """Return pixels in which those without weight have the value of the nearest others."""
    pixels = np.asarray(image.pixels)
    if pixels.ndim not in (2, 3) or pixels.shape[:2] != weight.shape[:2]:
        height, width = weight.shape[:2]
        raise ValueError(
            f"weight is for {width}x{height} pixels, but the image has shape {pixels.shape}"
        )
    ignored = ~(weight.reshape(*weight.shape[:2], -1) > 0).any(axis=2)
    if ignored.any():
        from scipy.ndimage import distance_transform_edt  # it takes 80 ms, and few fits need it

        nearest = distance_transform_edt(ignored, return_distances=False, return_indices=True)
        pixels = pixels[tuple(nearest)]
    return pixels
