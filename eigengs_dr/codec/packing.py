"""The function `pack`, which writes the smallest file within a loss of PSNR."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.arrays import types_of
from ..backend.doors import door
from ..fitting.fit import Fit
from ..fitting.maps import Map, read_maps
from ..fitting.objective import values_in
from ..gaussian.channels import TextureMap, channel_weights, display_values, slices
from ..gaussian.gaussians import Gaussians, scale_channels, set_of
from ..image.color import LIGHT, rendered_as, to_coded, to_linear, to_pu21
from ..image.io import check_data, check_image
from ..image.metrics import MAX_PSNR, psnr, psnr_from_mse
from ..raster.render import picture_of
from .egs import MAX_SECTIONS, SUFFIX, write
from .quantization import Steps
from .rounding import MIN_MSE, Comparison, planes_of, round_within

Array = NDArray[np.floating]

BUDGET = 0.5
"""Loss of PSNR by default, in dB. For a larger loss, fewer Gaussians save more bits."""

MSE_WITHOUT_IMAGE = 1e-4
"""Mean squared error that `pack` assumes for a set if it has no image: 40 dB."""


class PackResult(NamedTuple):
    """Result of `eigengs_dr.pack`.

    Attributes
    ----------
    gaussians : Gaussians
        The rounded set in the order of the file.
    bytes : int
        Size of the file.
    bits_per_pixel : float
        Bits of the file per pixel of the native size.
    psnr : float, or dict of str to float
        PSNR of the rendering of the rounded set in dB, in the space of the budget, against the
        image; without an image, against the rendering of the set before rounding. For maps, the
        psnr_rgb of each by its name.
    psnr_drop : float
        Loss of PSNR in dB; without an image, from 40 dB.
    steps : Steps
        Steps of the rounding.
    """

    gaussians: Gaussians
    bytes: int
    bits_per_pixel: float
    psnr: float | dict[str, float]
    psnr_drop: float
    steps: Steps


@door
def pack(
    gaussians: Gaussians | Fit,
    output: str | os.PathLike[str],
    image: ArrayLike | Mapping[str, ArrayLike] | None = None,
    max_psnr_drop: float = BUDGET,
    sections: Sequence[int] | None = None,
    encoding: str | None = None,
) -> PackResult:
    """Write a set to the smallest ``.egs`` file whose loss of PSNR stays within a budget.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    output : path-like
        File to write; `pack` replaces an existing file atomically. `Gaussians.load` reads it.
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W), optional
        The image of the fit, as `fit` takes it; for a set with maps, the images by name. By default
        the rendering of the set.
    max_psnr_drop : float, optional
        Largest loss of PSNR in dB, above 0 and at most 100: against the image, at the native size
        and in the space of the set (psnr_ycbcr for YCbCr; `pack` compares linear light as sRGB, and
        radiance in PU21).
        Without an image, the loss of a set of 40 dB if the errors add. For maps, the loss is that
        of the mean over the maps of the squared error (of colours as sRGB) over that before: all
        maps lose about as many decibels. Without images, their errors are in the ratio of their
        weights in the fit.
    sections : sequence of int, optional
        Number of Gaussians in each section of the file, in the order of the set. A reader may stop
        after any section; the budget holds for each of these prefixes. By default one section.
        Inside a section, Gaussians are stored in Hilbert-curve order.
    encoding : {"srgb", "linear"}, optional
        What the pixels of the image are, see `eigengs_dr.fit`.

    Returns
    -------
    PackResult

    Raises
    ------
    ValueError
        If the image or an argument does not fit the set, the suffix is not ``.egs``, or no file
        meets the budget.
    OSError
        If the file cannot be written; an existing file then stays unchanged.

    Notes
    -----
    On one machine and backend, the same arguments give the same file bit for bit.
    """
    if Path(output).suffix.lower() != SUFFIX:
        raise ValueError(f"{output}: pack writes {SUFFIX} files; use this suffix, or save()")
    if not 0 < max_psnr_drop <= MAX_PSNR:
        raise ValueError(
            f"pack: max_psnr_drop is {max_psnr_drop}; it must be above 0 and at most "
            f"{MAX_PSNR:g} dB, such as 0.5"
        )
    whole: Gaussians = dr.detach(set_of(gaussians))
    rows = _section_rows(len(whole), sections)
    if whole.maps and len(rows) > 1:
        raise ValueError("pack: a set with maps has one section; leave the sections out")
    compare = _compare_maps if whole.maps else _compare
    maps, shown, compared = compare(whole, image, encoding)
    weighted = scale_channels(whole, channel_weights(maps)) if maps else whole
    found, before = round_within(replace(weighted, maps=()), compared, max_psnr_drop, rows)
    size = write(output, found.packed._replace(maps=maps))
    rounded = Gaussians.load(output, types_of(whole.mean).backend)
    after = psnr_from_mse(max(found.error + compared.unseen, MIN_MSE))
    figure: float | dict[str, float] = psnr_from_mse(found.error)
    if maps:
        pictures = picture_of(rounded)
        pairs = zip(maps, shown, strict=True)
        figure = {m.name: psnr(pictures[m.name], image) for m, image in pairs}
    return PackResult(
        gaussians=rounded,
        bytes=size,
        bits_per_pixel=8 * size / (whole.width * whole.height),
        psnr=figure,
        psnr_drop=psnr_from_mse(before) - after,
        steps=found.packed.steps,
    )


def _section_rows(count: int, sections: Sequence[int] | None) -> list[slice]:
    """Return the range of the Gaussians of each section."""
    counts = [count] if sections is None else [int(k) for k in sections]
    if not counts or min(counts) < 1 or sum(counts) != count or len(counts) > MAX_SECTIONS:
        raise ValueError(
            f"pack: sections are {counts[:8]}, expected 1 to {MAX_SECTIONS} numbers of Gaussians "
            f"above 0 whose sum is {count}"
        )
    ends = np.cumsum(counts).tolist()
    return [slice(end - k, end) for end, k in zip(ends, counts, strict=True)]


# --- A set of one image --------------------------------------------------------------------------


Images = ArrayLike | Mapping[str, ArrayLike] | None
Compared = tuple[tuple[TextureMap, ...], list[Array], Comparison]
"""The maps with their weights for packing, what people see of them, and the comparison."""


def _compare(g: Gaussians, image: Images, encoding: str | None) -> Compared:
    """Compare a set without maps with its image, or with its own rendering."""
    if isinstance(image, Mapping):
        raise ValueError("pack: the set has no maps; give its image alone")
    shown = _shown(g) if image is None else _image_of(g, image, encoding)
    # The best linear light is not the best sRGB picture. So compensation keeps a set in linear
    # light near its own rendering, not near the image.
    keeps = image is None or g.space in LIGHT

    def error(found: Gaussians) -> float:
        return float(np.mean(np.square(_shown(found) - shown, dtype=np.float64)))

    unseen = MSE_WITHOUT_IMAGE if image is None else 0.0
    return (), [], Comparison(error, planes_of(g) if keeps else shown, unseen)


def _image_of(g: Gaussians, image: ArrayLike, encoding: str | None) -> Array:
    """Return the image in the space of the comparison.

    It is the set's space; for linear light, sRGB, and for light above 1, PU21, which has bounds.
    """
    data = rendered_as(g.space) is None
    pixels = check_data(image) if data else check_image(image, g.channels == 1, encoding=encoding)
    expected = (g.height, g.width, g.channels)
    if pixels.shape != expected:
        raise ValueError(f"pack: image has shape {pixels.shape}, the set needs {expected}")
    if g.space == "radiance":
        return to_pu21(to_linear(pixels))
    return pixels if g.space == "linear" else values_in(pixels, g.space)


def _shown(g: Gaussians) -> Array:
    """Render a set in the space of the comparison, see `_image_of`."""
    planes = planes_of(g)
    if g.space == "radiance":
        return to_pu21(planes)
    return to_coded(np.maximum(planes, 0)) if g.space == "linear" else planes


# --- A set with maps -----------------------------------------------------------------------------


SMALL = 1 / 255
"""A small change of sums, to measure slopes by."""


def _compare_maps(g: Gaussians, images: Images, encoding: str | None) -> Compared:
    """Compare a set with maps with their images, or with its own rendering."""
    maps, cuts = g.maps, slices(g.maps)

    def show(sums: Array) -> list[Array]:
        return [display_values(m.space, sums[..., c]) for m, c in zip(g.maps, cuts, strict=True)]

    values = own = planes_of(g)
    shown = rendered = show(own)
    factors, unseen = [m.weight**2 for m in maps], MSE_WITHOUT_IMAGE
    if images is not None:
        shown, values = _images_of(g, images, encoding)
        factors, unseen = [1 / e for e in _errors(rendered, shown)], 0.0
        # The slope: how much the squared error of what is seen exceeds that of the sums. Equal
        # steps of weighted colours then add to each map an error in the ratio of its own.
        moved = _errors(show(own + np.float32(SMALL)), rendered)
        logs = 0.5 * np.log(np.multiply(factors, [error / SMALL**2 for error in moved]))
        weights = np.exp(logs - logs.mean()).tolist()
        maps = tuple(m._replace(weight=w) for m, w in zip(maps, weights, strict=True))
        for m, c in zip(maps, cuts, strict=True):
            if m.space in LIGHT:  # as a set of one image in linear light
                values[..., c] = own[..., c]
    scale = np.array(channel_weights(maps), np.float32)

    def error(found: Gaussians) -> float:
        seen = _errors(show(planes_of(found) / scale), shown)
        return float(np.mean(np.multiply(seen, factors)))

    return maps, shown, Comparison(error, values * scale, unseen)


def _images_of(g: Gaussians, images: Images, encoding: str | None) -> tuple[list[Array], Array]:
    """Return the images in the order of the maps, and their values in the spaces of the maps."""
    spaces = {m.name: m.space for m in g.maps}
    if not isinstance(images, Mapping):
        raise ValueError(f"pack: the set has maps; give the images of {', '.join(spaces)} by name")
    if sorted(images) != sorted(spaces):
        raise ValueError(
            f"pack: images are of {', '.join(images)}; give one of each of {', '.join(spaces)}"
        )
    given = {name: Map(images[name], space) for name, space in spaces.items()}
    found = read_maps(given, encoding=encoding)
    for image, m in zip(found, g.maps, strict=True):
        expected = (g.height, g.width, m.channels)
        if image.pixels.shape != expected:
            raise ValueError(
                f"pack: map {m.name!r} has shape {image.pixels.shape}, the set needs {expected}"
            )
    values = [values_in(image.pixels, image.space) for image in found]
    return [image.pixels for image in found], np.concatenate(values, axis=2)


def _errors(a: list[Array], b: list[Array]) -> list[float]:
    """Return the mean squared error of each map, of at least `MIN_MSE`."""
    pairs = zip(a, b, strict=True)
    return [max(float(np.mean(np.square(x - y, dtype=np.float64))), MIN_MSE) for x, y in pairs]
