"""Sheets of a model or a basis: the mean image, some components, the Gaussians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.eigengs import EigenGS
from ..eigenbasis.pca.basis import Eigenbasis
from ..eigenbasis.pca.truncation import CHANNELS
from ..gaussian.gaussians import with_colors
from ..image.color import decode
from ..image.resize import join_pictures, resample, text_line
from ..raster.render import render
from .pictures import Picture, ellipses, within

FIRST = (1, 2, 3, 5, 10, 20, 50, 100, 200)
"""Numbers of the components to show of the first channel, counted from 1."""

OTHERS = (1, 2)
"""Numbers of the components to show of the other channels."""

CELL = 240
"""Longer side of a component in a sheet, in pixels."""

COLUMNS = 7
"""Pictures side by side in a sheet."""


def component_sheet(model: EigenGS, basis: Eigenbasis | None = None) -> Picture:
    """Draw the mean image, some components and the outlines of the Gaussians of a model.

    Parameters
    ----------
    model : EigenGS
    basis : Eigenbasis, optional
        The basis that the model was fitted to. The sheet shows its components above the rendered
        ones.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB, not clamped, under 2,000 pixels wide.
    """
    sources: list[EigenGS | Eigenbasis] = [model] if basis is None else [basis, model]
    columns = zip(*(first_components(source) for source in sources), strict=True)
    cells = [_captioned(column[0][0], *(picture for _, picture in column)) for column in columns]
    tables = [join_pictures(cells[k : k + COLUMNS], 1) for k in range(0, len(cells), COLUMNS)]
    outlines = _captioned("standard deviations", ellipses(model.gaussians, model.low))
    return join_pictures([*tables, outlines], 0)


def first_components(source: EigenGS | Eigenbasis) -> list[tuple[str, Picture]]:
    """Draw the mean image and some components of a basis, or as the Gaussians of a model show them.

    Components are signed, so mid-grey is zero. A component of a colour difference has the two
    colours of that difference.

    Parameters
    ----------
    source : EigenGS or Eigenbasis

    Returns
    -------
    list of (str, ndarray of float, shape (H, W, 3))
        Names and pictures in RGB, not clamped; the longer side has `CELL` pixels.
    """
    if isinstance(source, EigenGS):
        space, counts = source.gaussians.space, source.components
        mean, picks = render(source.gaussians).numpy(), _picks(counts)
        planes: Picture = np.zeros(0)
        if picks:  # there are at most 13, so one program renders all
            weights = np.stack([source.weights[channel][j] for channel, j in picks], axis=1)
            rendered = render(with_colors(source.gaussians, weights, "data")).numpy()
            planes = np.moveaxis(rendered, 2, 0)
    else:
        space, counts = source.space, tuple(map(len, source.components))
        mean, picks = np.stack(decode(space, list(source.mean)), axis=2), _picks(counts)
        planes = np.array([source.components[channel][j] for channel, j in picks])
    shown = [("mean", _cell(mean))]
    for (channel, j), plane in zip(picks, planes, strict=True):
        # A quantile, because one bright pixel must not make everything else grey.
        scale = 0.5 / (np.quantile(np.abs(plane), 0.999) or 1)
        picture = _cell(0.5 + scale * plane[..., None] * _hue(space, channel))
        shown.append((f"{CHANNELS[space][channel]} {j + 1}", picture))
    return shown


def _picks(components: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return the channels and indices of the components to show."""
    return [
        (channel, number - 1)
        for channel, count in enumerate(components)
        for number in (OTHERS if channel else FIRST)
        if number <= count
    ]


def _hue(space: str, channel: int) -> NDArray[np.float32]:
    """Return the RGB direction of one channel of a space; its largest entry is 1."""
    difference = np.subtract(decode(space, list(np.eye(3)[channel])), decode(space, [0.0] * 3))
    return (difference / np.abs(difference).max()).astype(np.float32)


def _cell(picture: Picture) -> Picture:
    """Resize a picture for a sheet."""
    width, height = within(CELL, picture.shape[1], picture.shape[0])
    return resample(picture.astype(np.float32), width, height)


def _captioned(text: str, *pictures: Picture) -> Picture:
    """Stack pictures below a line of text."""
    return join_pictures([text_line(text, pictures[0].shape[1]), *pictures], 0)
