"""HTML of sets, fits, bases and models for Jupyter: pictures and a line of figures."""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from html import escape

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.basis import Eigenbasis
from ..eigenbasis.eigengs import EigenGS
from ..fitting.fit import Fit
from ..gaussian.gaussians import Gaussians
from ..image.resize import resample
from ..raster.render import picture_of
from .pictures import first_components, photo_uri, within
from .view import MAX_GAUSSIANS

MAX_PICTURE_SIDE = 480
"""Largest side of the picture of a set, in pixels. Smaller sets are shown at their native size."""

THUMBNAIL_WIDTH = 120
"""Width of a component, in pixels."""


@singledispatch
def to_html(value: object) -> str:
    """Return HTML of a set, a fit, a basis or a model."""
    return f"<pre>{escape(repr(value))}</pre>"


@to_html.register
def _show_set(gaussians: Gaussians) -> str:
    if len(gaussians) > MAX_GAUSSIANS:  # rendering would take seconds
        return _block(repr(gaussians))
    return _block(repr(gaussians), *_images(picture_of(gaussians, *_shown_size(gaussians))))


@to_html.register
def _show_fit(fit: Fit) -> str:
    size = _shown_size(fit.gaussians)
    if isinstance(fit.image, Mapping):
        small = {name: resample(image, *size) for name, image in fit.image.items()}
        return _block(repr(fit), *_images(small))
    return _block(repr(fit), *_images(resample(fit.image, *size)))


def _shown_size(gaussians: Gaussians) -> tuple[int, int]:
    size = gaussians.width, gaussians.height
    return within(min(MAX_PICTURE_SIDE, max(size)), *size)


@to_html.register(Eigenbasis)
@to_html.register(EigenGS)
def _show_components(source: EigenGS | Eigenbasis) -> str:
    return _block(repr(source), *_images(dict(first_components(source)), THUMBNAIL_WIDTH))


def _images(
    pictures: NDArray[np.float32] | Mapping[str, NDArray[np.float32]],
    max_width: int = MAX_PICTURE_SIDE,
) -> list[str]:
    """Return a picture, or pictures with their names, as HTML."""
    if isinstance(pictures, Mapping):
        return [
            f'<figure style="margin: 0; text-align: center">{_images(picture, max_width)[0]}'
            f"<figcaption>{escape(name)}</figcaption></figure>"
            for name, picture in pictures.items()
        ]
    style = f"max-width: min(100%, {max_width}px)"
    return [f'<img src="{photo_uri(np.asarray(pictures, np.float32))}" style="{style}" alt="">']


def _block(text: str, *parts: str) -> str:
    style = "display: flex; flex-wrap: wrap; gap: 16px; align-items: flex-end"
    return f'<div><code>{escape(text)}</code><div style="{style}">{"".join(parts)}</div></div>'
