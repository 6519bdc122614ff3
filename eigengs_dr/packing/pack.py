"""Files of any kind: `load` opens them, and `pack` writes the smallest within a loss of PSNR."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..backend.entry_points import entry_point
from ..backend.types import ArrayLike, PathLike
from ..codec.egs import MAX_SECTIONS, SUFFIX
from ..codec.quantization import Steps
from ..eigenbasis.basis import Eigenbasis
from ..eigenbasis.eigengs import SHIPPED, EigenGS
from ..eigenbasis.files import BASIS_FORMAT, MODEL_FORMAT
from ..fitting.fit import Fit
from ..fitting.problem import Map, read_maps
from ..gaussian.channels import TextureMap, channel_weights, slices
from ..gaussian.file import FORMAT, LIGHTS, MATERIAL, kind_of, write_packed
from ..gaussian.gaussians import Gaussians, set_of
from ..image.io import check_data, check_image
from ..image.metrics import MAX_PSNR, psnr, psnr_from_mse
from ..image.pixels import check_encoding
from ..raster.render import picture_of
from ..relight.model import Relightable
from ..relight.packed import read_table, table_bytes
from ..storage.atomic import require_writable
from .rounding import MIN_MSE, Comparison, planes_of, round_within

Array = NDArray[np.floating]

Content = Gaussians | EigenGS | Eigenbasis | Relightable
"""What a file holds."""

READERS: dict[str, Callable[[PathLike, str | None], Content]] = {
    FORMAT: Gaussians.load,
    MATERIAL: Gaussians.load,
    MODEL_FORMAT: EigenGS.load,
    BASIS_FORMAT: lambda path, backend: Eigenbasis.load(path),
    LIGHTS: Relightable.load,
}
"""What reads a file, by its format."""


@entry_point
def load(path: PathLike, backend: str | None = None) -> Content:
    """Read what a file of this package holds, whatever it is.

    Parameters
    ----------
    path : path-like
        A file that a method `save` or `eigengs_dr.pack` wrote, or the name of a model of this
        package, such as ``"natural"``.
    backend : {"llvm", "cuda"}, optional
        See `eigengs_dr.Gaussians.load`.

    Returns
    -------
    Gaussians, EigenGS, Eigenbasis or Relightable

    Raises
    ------
    ValueError
        If the file is of another kind, damaged, or of a newer version.
    OSError
        If there is no such file, it is a folder, or it cannot be opened.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> type(eg.load("natural")).__name__
    'EigenGS'
    """
    file = SHIPPED.get(str(path), path)
    kind = kind_of(file)
    if kind not in READERS:
        raise ValueError(f"{file}: format is {kind[:40]!r}, expected one of {', '.join(READERS)}")
    return READERS[kind](file, backend)


BUDGET = 0.5
"""Default loss of PSNR in dB. For a larger loss, using fewer Gaussians saves more bits."""

MSE_WITHOUT_IMAGE = 1e-4
"""Mean squared error of a set that `pack` assumes if it gets no image: 40 dB."""


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
        psnr_rgb of each by name.
    psnr_drop : float
        Loss of PSNR in dB; without an image, from 40 dB, or the `psnr_held_out` of a model of
        lights.
    steps : Steps
        Steps of the rounding.
    """

    gaussians: Gaussians
    bytes: int
    bits_per_pixel: float
    psnr: float | dict[str, float]
    psnr_drop: float
    steps: Steps


@entry_point
@np.errstate(under="ignore")  # small weights become 0, whatever the caller does about that
def pack(
    gaussians: Gaussians | Fit | Relightable,
    output: str | os.PathLike[str],
    image: ArrayLike | Mapping[str, ArrayLike] | None = None,
    max_psnr_drop: float = BUDGET,
    sections: Sequence[int] | None = None,
    encoding: str | None = None,
) -> PackResult:
    """Write a set to the smallest ``.egs`` file whose loss of PSNR stays within a budget.

    Parameters
    ----------
    gaussians : Gaussians, Fit or Relightable
        Of a model of lights, its planes and its table are written; it takes no image.
    output : path-like
        File to write; an existing file is replaced atomically. `Gaussians.load` reads it, and
        `Relightable.load` that of a model.
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W), optional
        The image of the fit, as `fit` takes it; for a set with maps, the images by name. By default
        the rendering of the set.
    max_psnr_drop : float, optional
        Largest loss of PSNR in dB, above 0 and at most 100: against the image, at the native size
        and in the space of the set (psnr_ycbcr for YCbCr; linear light is compared as sRGB, and
        radiance in PU21). Without an image, the loss of a set of 40 dB whose errors add up. For
        maps, the loss refers to the mean over the maps of the ratio of the squared errors (of
        colours as sRGB) after and before, so that all maps lose about the same number of decibels.
        Without images, the errors of the maps are in the ratio of their weights in the fit.
        For a model of lights, the loss is that of its `psnr_held_out`, from the rounding of planes,
        as left-out photos show it, and of the table; the file holds the number after it.
    sections : sequence of int, optional
        Number of Gaussians in each section of the file, in the order of the set. A reader may stop
        after any section; the budget applies to each of these prefixes. By default one section.
        Inside a section, Gaussians are stored in Hilbert-curve order.
    encoding : {"srgb", "linear"}, optional
        The encoding of the pixels of the image, see `eigengs_dr.fit`.

    Returns
    -------
    PackResult

    Raises
    ------
    ValueError
        If the image or an argument does not match the set, the suffix is not ``.egs``, or no file
        meets the budget.
    OSError
        If the file cannot be written; an existing file does not change.

    Notes
    -----
    On one machine and backend, the same arguments give bit-identical files.
    """
    if Path(output).suffix.lower() != SUFFIX:
        raise ValueError(f"{output}: pack writes {SUFFIX} files; use this suffix, or save()")
    require_writable(output)  # before the work
    check_encoding(encoding)
    if encoding and image is None:
        raise ValueError("pack: encoding is for the pixels of an image; leave it out, or give one")
    if not 0 < max_psnr_drop <= MAX_PSNR:
        raise ValueError(
            f"pack: max_psnr_drop is {max_psnr_drop}; it must be above 0 and at most "
            f"{MAX_PSNR:g} dB, such as 0.5"
        )
    model = gaussians if isinstance(gaussians, Relightable) else None
    if model is not None and image is not None:
        raise ValueError("pack: a model of lights takes no image; leave it out")
    planes = gaussians.planes if isinstance(gaussians, Relightable) else set_of(gaussians)
    source: Gaussians = dr.detach(planes)
    rows = _section_rows(len(source), sections)
    if source.maps and len(rows) > 1:
        raise ValueError("pack: a set with maps has one section; leave out the sections")
    if model is None:
        compare = _compare_maps if source.maps else _compare
        maps, display, compared = compare(source, image, encoding)
    else:
        maps, display = (), []
        compared, table_of = _compare_planes(model, max_psnr_drop)
        unseen, lost = compared.extra_error, compared.error(source)  # of the table
        max_psnr_drop += psnr_from_mse(unseen + lost) - psnr_from_mse(unseen)
    weighted = source
    if maps:
        weights = type(source.color)(channel_weights(maps))
        color, background = source.color * weights, source.background * weights
        weighted = replace(source, color=color, background=background, maps=())
    attempt, before = round_within(weighted, compared, max_psnr_drop, rows)
    seen = psnr_from_mse(attempt.error)
    stored = seen if image is not None and not maps else math.nan
    after = psnr_from_mse(max(attempt.error + compared.extra_error, MIN_MSE))
    lights = b""
    if model is not None:
        before = compared.extra_error
        lights = table_of(after if math.isfinite(model.psnr_held_out) else math.nan)
    content = attempt.packed._replace(maps=maps, psnr=stored, lights=lights)
    size = write_packed(output, content)
    rounded = Gaussians.load(output, types_of(source.mean).backend)
    figure: float | dict[str, float] = seen
    if maps:
        pictures = picture_of(rounded)
        pairs = zip(maps, display, strict=True)
        figure = {m.name: psnr(pictures[m.name], image) for m, image in pairs}
    return PackResult(
        gaussians=rounded,
        bytes=size,
        bits_per_pixel=8 * size / (source.width * source.height),
        psnr=figure,
        psnr_drop=psnr_from_mse(before) - after,
        steps=attempt.packed.steps,
    )


def _section_rows(count: int, sections: Sequence[int] | None) -> list[slice]:
    """Return the range of the Gaussians of each section."""
    counts = [count] if sections is None else list(sections)
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
"""The maps with their weights for packing, their display values, and the comparison."""


def _compare(g: Gaussians, image: Images, encoding: str | None) -> Compared:
    """Compare a set without maps with its image, or with its own rendering."""
    if isinstance(image, Mapping):
        raise ValueError("pack: the set has no maps; give a single image")
    target = _display(g) if image is None else _image_of(g, image, encoding)
    # The best fit in linear light is not the best sRGB picture. So the compensation of a set in
    # linear light aims at its own rendering, not at the image.
    keeps_rendering = image is None or g.space.is_light

    def error(rounded: Gaussians) -> float:
        return float(np.mean(np.square(_display(rounded) - target, dtype=np.float64)))

    extra_error = MSE_WITHOUT_IMAGE if image is None else 0.0
    return (), [], Comparison(error, planes_of(g) if keeps_rendering else target, extra_error)


def _image_of(g: Gaussians, image: ArrayLike, encoding: str | None) -> Array:
    """Return the image in the space of the comparison.

    This is the space of the set, except for linear light (sRGB) and light above 1 (PU21, which is
    bounded).
    """
    if g.space.is_color:
        pixels = check_image(image, g.channels == 1, encoding=encoding)
    else:
        pixels = check_data(image)
    expected = (g.height, g.width, g.channels)
    if pixels.shape != expected:
        raise ValueError(f"pack: image has shape {pixels.shape}, the set needs {expected}")
    return g.space.comparable(g.space.values_of(pixels))


def _display(g: Gaussians) -> Array:
    """Render a set in the space of the comparison, see `_image_of`."""
    return g.space.comparable(planes_of(g))


# --- The planes of a model of lights --------------------------------------------------------------


LIGHTS_DEAD_ZONE = 0.2
"""Dead zone of planes, whose faint colours are mostly noise: 1 to 5 % fewer bytes and up to 0.1 dB
more of left-out photos than with that of images (two sets)."""


def _compare_planes(
    model: Relightable, max_psnr_drop: float
) -> tuple[Comparison, Callable[[float], bytes]]:
    """Compare planes, whose errors add up to that of left-out photos, and pictures by the table.

    The rounding of the table adds the error of the pictures of the photos. Bytes are spent best
    where one more bit of any number lowers the error by as much, so the table gets the share of the
    error that its numbers are of all numbers. Returned as well is what writes that table
    beside the PSNR of left-out photos.
    """
    target, table = planes_of(model.planes), model.table
    known = math.isfinite(model.psnr_held_out)
    unseen = 10 ** (-model.psnr_held_out / 10) if known else MSE_WITHOUT_IMAGE
    plain = np.concatenate([target, np.ones_like(target[..., :1])], axis=2)
    moments = np.tensordot(plain, plain, ((0, 1), (0, 1))) / target[..., 0].size
    numbers = len(model.planes) * (NUMBERS_OF_SHAPE + model.planes.channels)
    share = table.values.size / (table.values.size + numbers)
    error_of_table = share * unseen * (10 ** (max_psnr_drop / 10) - 1)
    squares = np.diag(moments)[:-1]

    def table_of(psnr: float) -> bytes:
        return table_bytes(table, squares, error_of_table, psnr, model.brightest)

    rounded_table, *_ = read_table(table_of(math.nan), len(squares))
    change = rounded_table.at(table.lights) - table.at(table.lights)
    of_table = float(np.einsum("nck,kl,ncl->nc", change, moments, change).mean())

    def error(rounded: Gaussians) -> float:
        return float(np.square(planes_of(rounded) - target).sum(axis=2).mean()) + of_table

    return Comparison(error, target, unseen, LIGHTS_DEAD_ZONE), table_of


NUMBERS_OF_SHAPE = 5
"""Numbers of a Gaussian besides its colours: mean and covariance."""


# --- A set with maps -----------------------------------------------------------------------------


DIFFERENCE = 1 / 255
"""Change of the sums by which slopes are measured, with 1 as white."""


def _compare_maps(g: Gaussians, images: Images, encoding: str | None) -> Compared:
    """Compare a set with maps with the images of the maps, or with its own rendering."""
    maps, parts = g.maps, slices(g.maps)

    def display(sums: Array) -> list[Array]:
        return [m.space.display_sums(sums[..., c]) for m, c in zip(g.maps, parts, strict=True)]

    values = sums = planes_of(g)
    targets = rendered = display(sums)
    factors, extra_error = [m.weight**2 for m in maps], MSE_WITHOUT_IMAGE
    if images is not None:
        targets, values = _images_of(g, images, encoding)
        factors, extra_error = [1 / e for e in _errors(rendered, targets)], 0.0
        # The slope: the ratio of the squared errors of display values and of sums. Equal steps of
        # weighted colours then add an error to each map that is proportional to its own.
        changed = _errors(display(sums + np.float32(DIFFERENCE)), rendered)
        logs = 0.5 * np.log(np.multiply(factors, [error / DIFFERENCE**2 for error in changed]))
        weights = np.exp(logs - logs.mean()).tolist()
        maps = tuple(m._replace(weight=w) for m, w in zip(maps, weights, strict=True))
        for m, c in zip(maps, parts, strict=True):
            if m.space.is_light:  # as in `_compare`
                values[..., c] = sums[..., c]
    scale = np.array(channel_weights(maps), np.float32)

    def error(rounded: Gaussians) -> float:
        errors = _errors(display(planes_of(rounded) / scale), targets)
        return float(np.mean(np.multiply(errors, factors)))

    return maps, targets, Comparison(error, values * scale, extra_error)


def _images_of(g: Gaussians, images: Images, encoding: str | None) -> tuple[list[Array], Array]:
    """Return the images in the order of the maps, and their values in the spaces of the maps."""
    spaces = {m.name: m.space for m in g.maps}
    if not isinstance(images, Mapping):
        raise ValueError(f"pack: the set has maps; give the images of {', '.join(spaces)} by name")
    if sorted(images) != sorted(spaces):
        raise ValueError(
            f"pack: there are images of {', '.join(images)}; give one of each of "
            f"{', '.join(spaces)}"
        )
    named = {name: Map(images[name], space) for name, space in spaces.items()}
    pixels = [channels.targets[0].pixels for channels in read_maps(named, encoding=encoding)]
    for image, m in zip(pixels, g.maps, strict=True):
        expected = (g.height, g.width, m.channels)
        if image.shape != expected:
            raise ValueError(
                f"pack: map {m.name!r} has shape {image.shape}, the set needs {expected}"
            )
    values = [m.space.values_of(image) for m, image in zip(g.maps, pixels, strict=True)]
    return pixels, np.concatenate(values, axis=2)


def _errors(a: list[Array], b: list[Array]) -> list[float]:
    """Return the mean squared error of each map, at least `MIN_MSE`."""
    pairs = zip(a, b, strict=True)
    return [max(float(np.mean(np.square(x - y, dtype=np.float64))), MIN_MSE) for x, y in pairs]
