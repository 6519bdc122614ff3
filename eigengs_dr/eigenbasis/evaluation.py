"""The PSNR of a basis and a model on image files held out of the training."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..backend.feedback import warn
from ..image.io import ImageError, check_image, load_image
from ..image.metrics import psnr
from ..image.resize import center_crop
from ..raster.render import render
from .eigengs import EigenGS
from .pca.basis import Eigenbasis
from .pca.truncation import TruncationCurve

OnImage = Callable[[int], None]
"""``watch(i)`` runs before image number i; an error that it raises ends the work."""


def truncation_curve_on(
    basis: Eigenbasis, files: Sequence[Path | str], watch: OnImage
) -> TruncationCurve | None:
    """Measure the truncation curve of images; see `Eigenbasis.truncation_curve`.

    Parameters
    ----------
    basis : Eigenbasis
    files : sequence of Path
        Images of any size; unreadable files are skipped.
    watch : callable
        See `OnImage`.

    Returns
    -------
    TruncationCurve or None
        None if no file can be read.
    """
    readable = _readable(files, basis, watch, [])
    first = next(readable, None)
    return None if first is None else basis.truncation_curve(chain([first], readable))


def evaluate(
    model: EigenGS, basis: Eigenbasis, files: Sequence[Path | str], watch: OnImage
) -> dict[str, float]:
    """Measure the PSNR of PCA, of projected colours and of exact colours.

    Parameters
    ----------
    model : EigenGS
    basis : Eigenbasis
        The basis that the model renders.
    files : sequence of Path
        Images of any size.
    watch : callable
        See `OnImage`.

    Returns
    -------
    dict of str to float
        Mean psnr_ycbcr over the images, in dB: "psnr_pca" of the basis, "psnr_init" of projected
        and "psnr_solved" of exact colours. Empty if no file can be read.

    Warns
    -----
    UserWarning
        If a file cannot be read.
    """
    rows, bad = [], list[str]()
    for image in _readable(files, basis, watch, bad):
        pictures = {
            "psnr_pca": basis.reconstruct(basis.project(image)),
            "psnr_init": render(model.encode(image, "projected")).numpy(),
            "psnr_solved": render(model.encode(image, "exact")).numpy(),
        }
        rows.append({name: psnr(image, picture, "ycbcr") for name, picture in pictures.items()})
    if bad:
        message = f"{len(bad)} of {len(files)} images held out were skipped, as {bad[0]}"
        warn(message)
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]} if rows else {}


def _readable(
    files: Sequence[Path | str], basis: Eigenbasis, watch: OnImage, bad: list[str]
) -> Iterator[NDArray[np.float32]]:
    """Read images and crop them to the size of a basis; append errors to `bad`."""
    for i, path in enumerate(files):
        watch(i)
        try:
            image = center_crop(
                check_image(load_image(path), copy=False), basis.width, basis.height
            )
        except (ImageError, OSError) as error:
            bad.append(str(error))
        else:
            yield image
