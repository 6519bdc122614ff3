"""What a basis and a model are worth on image files that neither was made of."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..image.io import ImageError, load_image
from ..image.metrics import psnr
from ..image.resize import center_crop
from ..raster.render import render
from .basis import Eigenbasis
from .eigengs import EigenGS
from .truncation import TruncationCurve

OnImage = Callable[[int], None]
"""``watch(i)`` before image number i; what it raises ends the work."""


def truncation_curve_on(
    basis: Eigenbasis, files: Sequence[Path], watch: OnImage
) -> TruncationCurve | None:
    """Measure how the error of images falls with the components; see `Eigenbasis.fall`.

    Parameters
    ----------
    basis : Eigenbasis
    files : sequence of Path
        Images of any size. Those that cannot be read are left out.
    watch : callable

    Returns
    -------
    Fall or None
        None where no file can be read.
    """
    readable = _readable(files, basis, watch, [])
    first = next(readable, None)
    return None if first is None else basis.truncation_curve(chain([first], readable))


def evaluate(
    model: EigenGS, basis: Eigenbasis, files: Sequence[Path], watch: OnImage
) -> dict[str, float]:
    """Measure what components, projected and exact colours are worth.

    Parameters
    ----------
    model : EigenGS
    basis : Eigenbasis
        Its components.
    files : sequence of Path
    watch : callable

    Returns
    -------
    dict of str to float
        Means over the images, psnr_ycbcr in dB: "psnr_pca" of the components themselves,
        "psnr_init" of projected and "psnr_solved" of exact colours. Empty where none can be read.

    Warns
    -----
    UserWarning
        If some cannot.
    """
    rows, bad = [], list[str]()
    for image in _readable(files, basis, watch, bad):
        shown = {
            "psnr_pca": basis.reconstruct(basis.project(image)),
            "psnr_init": render(model.encode(image, "projected")).numpy(),
            "psnr_solved": render(model.encode(image, "exact")).numpy(),
        }
        rows.append({name: psnr(image, picture, "ycbcr") for name, picture in shown.items()})
    if bad:
        told = f"{len(bad)} of {len(files)} images held out were skipped, as {bad[0]}"
        warnings.warn(told, stacklevel=2)
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]} if rows else {}


def _readable(
    files: Sequence[Path], basis: Eigenbasis, watch: OnImage, bad: list[str]
) -> Iterator[NDArray[np.float32]]:
    """Read images and crop them to the size of a basis; why some cannot be goes into `bad`."""
    for i, path in enumerate(files):
        watch(i)
        try:
            image = center_crop(load_image(path), basis.width, basis.height)
        except ImageError as error:
            bad.append(str(error))
        else:
            yield image
