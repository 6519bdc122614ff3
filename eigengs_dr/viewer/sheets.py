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

Column = tuple[str, list[Picture]]
"""A name, and pictures on one scale: of a component, or as Gaussians render it, or both."""


def component_sheet(model: EigenGS, basis: Eigenbasis | None = None) -> Picture:
    """Draw the mean image, some components and the outlines of the Gaussians of a model.

    Components are signed, so mid-grey is zero. A component of a colour difference has the two
    colours of that difference.

    Parameters
    ----------
    model : EigenGS
    basis : Eigenbasis, optional
        The basis that the model was fitted to. The sheet shows its components above the rendered
        ones, on the same scale.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB, not clamped, under 2,000 pixels wide.

    Raises
    ------
    ValueError
        If the basis and the model differ in size, space or number of components.
    """
    if basis is not None:
        _require_same(model, basis)
    columns = [_mean(model, basis), *_components(model, basis)]
    captioned = [_captioned(name, *pictures) for name, pictures in columns]
    rows = range(0, len(captioned), COLUMNS)
    tables = [join_pictures(captioned[k : k + COLUMNS], 1) for k in rows]
    outlines = [_captioned("standard deviations", ellipses(model.gaussians, model.low))]
    if model.low:
        outlines += _parts_of_mean(model)
    return join_pictures([*tables, join_pictures(outlines, 1)], 0)


def first_components(source: EigenGS | Eigenbasis) -> list[tuple[str, Picture]]:
    """Draw the mean image and some components of a basis, or as the Gaussians of a model show them.

    Parameters
    ----------
    source : EigenGS or Eigenbasis

    Returns
    -------
    list of (str, ndarray of float, shape (H, W, 3))
        Names and pictures in RGB, not clamped; the longer side has `CELL` pixels.
    """
    if isinstance(source, EigenGS):
        columns = [_mean(source, None), *_components(source, None)]
    else:
        columns = [("mean", [_cell(_mean_of(source))])]
        for channel, j in _picks(tuple(map(len, source.components))):
            columns.append(_column(source.space, channel, j, [source.components[channel][j]]))
    return [(name, pictures[0]) for name, pictures in columns]


def _require_same(model: EigenGS, basis: Eigenbasis) -> None:
    """Raise ValueError unless a basis has the size, space and components of a model."""
    shapes = model.gaussians
    expected = (shapes.width, shapes.height, shapes.space, model.components)
    actual = (basis.width, basis.height, basis.space, tuple(map(len, basis.components)))
    if expected != actual:
        raise ValueError(
            f"basis is {actual}, the model {expected}; pass the basis it was fitted to"
        )


def _mean(model: EigenGS, basis: Eigenbasis | None) -> Column:
    """Draw the column of the mean image."""
    pictures = [render(model.gaussians).numpy()]
    if basis is not None:
        pictures.insert(0, _mean_of(basis))
    return "mean", [_cell(picture) for picture in pictures]


def _mean_of(basis: Eigenbasis) -> Picture:
    """Return the mean image of a basis in RGB."""
    return np.stack(decode(basis.space, list(basis.mean)), axis=2)


def _components(model: EigenGS, basis: Eigenbasis | None) -> list[Column]:
    """Draw one column for each component of the sheet."""
    picks = _picks(model.components)
    if not picks:
        return []
    # There are at most 13 channels, so one program renders all.
    weights = np.stack([model.weights[channel][j] for channel, j in picks], axis=1)
    rendered = render(with_colors(model.gaussians, weights, "data")).numpy()
    columns = []
    for (channel, j), plane in zip(picks, np.moveaxis(rendered, 2, 0), strict=True):
        planes = [plane] if basis is None else [basis.components[channel][j], plane]
        columns.append(_column(model.gaussians.space, channel, j, planes))
    return columns


def _picks(components: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return the channels and indices of the components to show."""
    return [
        (channel, number - 1)
        for channel, count in enumerate(components)
        for number in (OTHERS if channel else FIRST)
        if number <= count
    ]


def _column(space: str, channel: int, j: int, planes: list[Picture]) -> Column:
    """Draw one component, (H, W), or several forms of it on one scale."""
    # A quantile, because one bright pixel must not make everything else grey.
    scale = 0.5 / (np.quantile(np.abs(planes[0]), 0.999) or 1)
    hue = _hue(space, channel)
    pictures = [_cell(0.5 + scale * plane[..., None] * hue) for plane in planes]
    return f"{CHANNELS[space][channel]} {j + 1}", pictures


def _parts_of_mean(model: EigenGS) -> list[Picture]:
    """Draw the shares of the Gaussians of low and of high frequencies in the mean image."""
    low = render(model.gaussians[: model.low]).numpy()
    high = render(model.gaussians).numpy() - low
    rest = len(model.gaussians) - model.low
    return [
        _captioned(f"mean by {model.low} low", _cell(low)),
        _captioned(f"mean by {rest} high", _cell(0.5 + high)),
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
