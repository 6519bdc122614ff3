"""The function `pack_material`: a material in few bytes, within a given loss of PSNR."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.arrays import types_of
from ..backend.display import to_html
from ..backend.recording import exclusive
from ..gaussian.gaussians import Gaussians
from ..image.color import LIGHT
from ..image.metrics import psnrs_by_rows
from ..material.maps import TextureMap, show_sums, slices
from ..material.material import Material, scale_channels
from ..material.target import combine, read_maps
from ..raster.render import render
from .egs import channel_weights
from .packing import BUDGET, MIN_MSE, MSE_WITHOUT_IMAGE, check_request, section_rows, write_smallest
from .quantization import Steps

Array = NDArray[np.floating]

SMALL = 1 / 255
"""A small change of sums, to measure slopes by."""


class MaterialPackResult(NamedTuple):
    """Result of `pack_material`.

    Attributes
    ----------
    material : Material
        The rounded material in the order of the file.
    bytes : int
        Size of the file.
    bits_per_pixel : float
        Bits of the file per pixel of the native size, for all maps together.
    psnr : dict of str to float
        psnr_rgb in dB of each map against its image; without images, against the rendering before
        rounding.
    psnr_drop : float
        Loss in dB, see max_psnr_drop of `pack_material`.
    steps : Steps
        Steps of the rounding.
    """

    material: Material
    bytes: int
    bits_per_pixel: float
    psnr: dict[str, float]
    psnr_drop: float
    steps: Steps

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return to_html(self)


@exclusive()
def pack_material(
    material: Material,
    output: str | os.PathLike[str],
    images: Mapping[str, ArrayLike] | None = None,
    max_psnr_drop: float = BUDGET,
    encoding: str | None = None,
) -> MaterialPackResult:
    """Write a material to the smallest ``.egs`` file whose loss of PSNR stays within a budget.

    All maps lose about as many decibels. Without images, they get errors in the ratio of their
    weights in the fit.

    Parameters
    ----------
    material : Material
    output : path-like
        File to write; an existing file is replaced atomically. `Material.load` reads it.
    images : mapping of str to array_like, optional
        The images of the fit, as `eigengs_dr.fit_material` takes them. By default the renderings.
    max_psnr_drop : float, optional
        Largest loss in dB, above 0 and at most 100: of the mean over the maps of the squared error
        (of colours as sRGB) over that before. Without images, over that of weighted errors of 40
        dB.
    encoding : {"srgb", "linear"}, optional
        What the pixels of colours are, see `eigengs_dr.fit`.

    Returns
    -------
    MaterialPackResult

    Raises
    ------
    ValueError
        If the images do not fit the maps, the suffix is not ``.egs``, or no file meets the budget.
    OSError
        If the file cannot be written; an existing file then stays unchanged.
    """
    check_request(output, max_psnr_drop)
    maps, g = material.maps, dr.detach(material.gaussians)
    own = render(g).numpy()
    shown, values = _shown(own, maps), own
    factors, unseen = [m.weight**2 for m in maps], MSE_WITHOUT_IMAGE
    if images is not None:
        rendered = shown
        shown, values = _images_of(material, images, encoding)
        factors = [1 / e for e in _errors(rendered, shown)]
        # Equal steps of weighted colours then add to each map an error in the ratio of its own.
        logs = 0.5 * np.log(np.multiply(factors, _slopes(own, rendered, maps)))
        weights, cuts = np.exp(logs - logs.mean()), slices(maps)
        maps = tuple(m._replace(weight=float(w)) for m, w in zip(maps, weights, strict=True))
        unseen = 0.0
        for m, c in zip(maps, cuts, strict=True):
            if m.space in LIGHT:  # as `pack` keeps light near its own rendering
                values[..., c] = own[..., c]
    scale = np.array(channel_weights(maps), np.float32)

    def errors(found: Gaussians) -> list[float]:
        seen = _errors(_shown(render(found).numpy() / scale, maps), shown)
        return [float(np.mean(np.multiply(seen, factors)))]

    weighted = scale_channels(g, scale.tolist())
    rows = section_rows(len(g), None)
    target = values * scale
    figures = write_smallest(output, weighted, target, errors, max_psnr_drop, rows, unseen, maps)
    found = Material.load(output, types_of(g.mean).backend)
    pictures = found.pictures()
    figures["psnr"] = {
        m.name: psnrs_by_rows(pictures[m.name].__getitem__, image, ["rgb"])[0]
        for m, image in zip(maps, shown, strict=True)
    }
    return MaterialPackResult(material=found, **figures)


def _images_of(
    material: Material, images: Mapping[str, ArrayLike], encoding: str | None
) -> tuple[list[Array], Array]:
    """Return the images in the order of the maps, and their values in the spaces of the maps."""
    spaces = {m.name: m.space for m in material.maps}
    if sorted(images) != sorted(spaces):
        raise ValueError(
            f"pack: images are of {', '.join(images)}; give one of each of {', '.join(spaces)}"
        )
    found = read_maps({name: images[name] for name in spaces}, spaces, encoding)
    g = material.gaussians
    for image, m in zip(found, material.maps, strict=True):
        expected = (g.height, g.width, m.channels)
        if image.pixels.shape != expected:
            raise ValueError(
                f"pack: map {m.name!r} has shape {image.pixels.shape}, the material needs "
                f"{expected}"
            )
    units = [image.unit for image in found]
    pixels: list[Array] = [i.pixels * np.float32(i.unit) for i in found]
    return pixels, combine(found, units).values


def _shown(sums: Array, maps: tuple[TextureMap, ...]) -> list[Array]:
    """Convert sums of all channels to what people look at, map by map."""
    return [show_sums(m.space, sums[..., c]) for m, c in zip(maps, slices(maps), strict=True)]


def _slopes(sums: Array, shown: list[Array], maps: tuple[TextureMap, ...]) -> list[float]:
    """Return how much the squared error of what is seen exceeds that of the sums, map by map."""
    moved = _errors(_shown(sums + np.float32(SMALL), maps), shown)
    return [error / SMALL**2 for error in moved]


def _errors(a: list[Array], b: list[Array]) -> list[float]:
    """Return the mean squared error of each map, of at least `MIN_MSE`."""
    pairs = zip(a, b, strict=True)
    return [max(float(np.mean(np.square(x - y, dtype=np.float64))), MIN_MSE) for x, y in pairs]
