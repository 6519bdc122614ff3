"""The images of all maps as one image of many channels, each in units of its error."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..fitting.options import FitOptions
from ..fitting.target import FitTarget, make_target, read_pixels, unit_of
from ..gaussian.gaussians import Gaussians
from ..image.color import rendered_as
from ..image.metrics import float_space, psnrs_by_rows, target_key
from ..image.pixels import ImageError
from ..raster.render import picture_rows
from ..storage.npz import BadValue
from .maps import TextureMap, check_maps, check_name, show_sums, slices, usual_space

Image = NDArray[np.float32]


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
    """

    name: str
    space: str
    pixels: Image
    unit: float


def read_maps(
    maps: Mapping[str, ArrayLike], spaces: Mapping[str, str], encoding: str | None = None
) -> list[MapImage]:
    """Check the images of a material, and convert them to sRGB, normals or data.

    For parameters and errors see `eigengs_dr.fit_material`.
    """
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
    return images


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


def maps_of(images: Sequence[MapImage], weights: Sequence[float]) -> tuple[TextureMap, ...]:
    """Return the maps of images whose errors have some weights, in the units of the images."""
    return tuple(
        TextureMap(image.name, image.space, image.pixels.shape[2], weight / image.unit)
        for image, weight in zip(images, weights, strict=True)
    )


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


def score_maps(
    gaussians: Gaussians,
    images: Sequence[MapImage],
    weights: Sequence[float],
    started: float,
    goals: Sequence[float] | None = None,
    space: str = "rgb",
) -> dict[str, Any]:
    """Measure a set of all channels, each times the weight of its map.

    Returns
    -------
    dict
        seconds; psnr_ycbcr and psnr_rgb, means over the maps; maps, with both of each map; and with
        goals, spare: how far the map that is farthest from its goal is above it, in dB.
    """
    read = picture_rows(gaussians)
    seconds = time.perf_counter() - started
    found = {}
    for image, weight, own in zip(images, weights, slices(maps_of(images, weights)), strict=True):
        spaces = [float_space(image.space), "rgb"]
        shown: Callable[[slice], Any] = partial(_shown, read, own, weight, image.space)
        ycbcr, rgb = psnrs_by_rows(shown, image.pixels, spaces)
        found[image.name] = {"psnr_ycbcr": ycbcr, "psnr_rgb": rgb}
    row = {
        "seconds": seconds,
        **{key: float(np.mean([f[key] for f in found.values()])) for key in _FIGURES},
        "maps": found,
    }
    if goals is not None:
        levels = [found[image.name][target_key(image.space, space)] for image in images]
        row["spare"] = min(level - goal for level, goal in zip(levels, goals, strict=True))
    return row


_FIGURES = ("psnr_ycbcr", "psnr_rgb")


def _shown(read: Any, own: slice, weight: float, space: str, rows: slice) -> NDArray[Any]:
    return show_sums(space, read(rows)[..., own] / np.float32(weight))


def _list(names: Any) -> str:
    return ", ".join(map(str, names)) or "none"
