"""Pictures of models and fits: components, and outlines of the Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.components.solve import with_colors
from ..eigenbasis.eigengs import EigenGS
from ..eigenbasis.pca.basis import Eigenbasis
from ..eigenbasis.pca.component_counts import CHANNELS
from ..gaussian.covariance import outline
from ..gaussian.gaussians import Gaussians
from ..image.color import decode
from ..image.io import to_8bit
from ..image.montage import join_pictures, text_line
from ..image.pixels import check_image
from ..image.resize import resample
from ..raster.render import render

FIRST = (1, 2, 3, 5, 10, 20, 50, 100, 200)
"""Numbers of the components to show of the first channel, counted from 1."""

OTHERS = (1, 2)
"""Numbers of the components to show of the other channels."""

CELL = 240
"""Longer side of a component in a sheet, in pixels."""

COLUMNS = 7
"""Pictures side by side in a sheet."""

OUTLINES = 800
"""Longer side of a picture of ellipses, in pixels."""

MAX_OUTLINES = 2000
"""Most outlines over a picture; more of them hide each other."""

MIN_SIDE = 512
"""Shortest longer side of a picture under outlines, in pixels; smaller pictures are enlarged."""

LIGHTER = 0.6
"""Share of white that lightens a picture under outlines."""

MAX_REACH = 100
"""Farthest reach of an outline to draw, in longer sides of the picture. A longer outline would
look straight, and Pillow takes no larger coordinates."""

LOW_COLOR, HIGH_COLOR = (214, 96, 20), (30, 90, 160)
"""Colours of outlines: orange for the Gaussians of low frequencies, blue for all others."""

Picture = NDArray[Any]
Color = tuple[int, int, int]


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
    tables = [
        join_pictures(columns[first : first + COLUMNS], 1)
        for first in range(0, len(columns), COLUMNS)
    ]
    outlines = [_captioned("standard deviations", ellipses(model.gaussians, model.low))]
    if model.low:
        outlines += _parts_of_mean(model)
    return join_pictures([*tables, join_pictures(outlines, 1)], 0)


def ellipses(gaussians: Gaussians, low: int = 0) -> Picture:
    """Draw the outline of every Gaussian at one standard deviation.

    Parameters
    ----------
    gaussians : Gaussians
    low : int, optional
        Number of Gaussians of low frequencies. These first Gaussians are orange and on top, all
        others are blue.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB on white; the longer side has 800 pixels.
    """
    width, height = _within(OUTLINES, gaussians.width, gaussians.height)
    colors = [LOW_COLOR] * low + [HIGH_COLOR] * (len(gaussians) - low)
    return _outlined(np.ones((height, width, 3)), gaussians, colors)


def overlay(gaussians: Gaussians, picture: Picture) -> Picture:
    """Draw the outlines of Gaussians at one standard deviation over a lightened picture.

    The function draws at most 2,000 Gaussians. It picks them at random, with a fixed seed.

    Parameters
    ----------
    gaussians : Gaussians
        Of any space and native size.
    picture : ndarray of float, shape (H, W, 3) or (H, W, 1)
        RGB or grey; clamped.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB.
    """
    # Regular picks would draw stripes if the Gaussians lie on a grid.
    picks = np.random.default_rng(0).permutation(len(gaussians))[:MAX_OUTLINES]
    under = LIGHTER + (1 - LIGHTER) * np.clip(picture, 0, 1)
    subset = gaussians[picks]
    return _outlined(under, subset, [HIGH_COLOR] * len(subset))


def displayed(image: Picture, color: str) -> Picture:
    """Return an image from `eigengs_dr.load_image` as people look at it: sRGB, or data."""
    return np.asarray(image) if color == "data" else check_image(image, copy=False)


def comparison(image: Picture, picture: Picture, gaussians: Gaussians) -> Picture:
    """Put an image, its fit, and the fit under outlines of its Gaussians side by side.

    Parameters
    ----------
    image, picture : ndarray of float, shape (H, W, 3) or (H, W, 1)
        The image and its fit, RGB or grey, of one size.
    gaussians : Gaussians
        The Gaussians of the fit.

    Returns
    -------
    ndarray of float, shape (k * H, 3 * k * W, 3)
        RGB. Every pixel is repeated k times along both axes; k is the smallest number that gives
        each part a longer side of at least 512 pixels.
    """
    times = -(-MIN_SIDE // max(image.shape[:2]))
    shape = (*image.shape[:2], 3)
    parts = [np.broadcast_to(part, shape) for part in (image, picture)]
    large = [part.repeat(times, axis=0).repeat(times, axis=1) for part in parts]
    return np.concatenate([*large, overlay(gaussians, large[1])], axis=1)


def _outlined(picture: Picture, gaussians: Gaussians, colors: list[Color]) -> Picture:
    """Draw outlines at one standard deviation, the first Gaussian on top."""
    from PIL import Image, ImageDraw

    height, width = picture.shape[:2]
    # Lines of Pillow have jagged edges; at twice the size, averaging smooths them.
    under = np.broadcast_to(to_8bit(picture), (height, width, 3)).astype(np.uint8)
    image = Image.fromarray(under.repeat(2, axis=0).repeat(2, axis=1))
    draw = ImageDraw.Draw(image)
    points = _outlines(gaussians.scaled(2 * width, 2 * height))
    for n in reversed(np.flatnonzero(_in_sight(points, image.size))):
        draw.line(points[n].ravel().tolist(), fill=colors[n], width=2)
    return np.asarray(image.resize((width, height), Image.Resampling.BOX), np.float32) / 255


def _outlines(gaussians: Gaussians) -> Picture:
    """Return closed outlines at one standard deviation, shape (N, 25, 2)."""
    arrays = gaussians.to_arrays()
    return outline(arrays["factor"]) + arrays["mean"].astype(np.float64)[:, None]


def _in_sight(points: Picture, size: tuple[int, int]) -> Picture:
    """Tell which outlines may cross a picture and are small enough for Pillow."""
    low, high = points.min(axis=1), points.max(axis=1)
    longest = MAX_REACH * max(size)
    near = (low > -longest) & (high < longest)
    return (near & (high >= 0) & (low <= size)).all(axis=1)


def _require_same(model: EigenGS, basis: Eigenbasis) -> None:
    """Raise ValueError unless a basis has the size, space and components of a model."""
    shapes = model.gaussians
    expected = (shapes.width, shapes.height, shapes.space, model.components)
    actual = (basis.width, basis.height, basis.space, tuple(map(len, basis.components)))
    if expected != actual:
        raise ValueError(
            f"basis is {actual}, the model {expected}; pass the basis it was fitted to"
        )


def _mean(model: EigenGS, basis: Eigenbasis | None) -> Picture:
    """Draw the column of the mean image."""
    pictures = [render(model.gaussians).numpy()]
    if basis is not None:
        pictures.insert(0, np.stack(decode(basis.space, list(basis.mean)), axis=2))
    return _captioned("mean", *map(_cell, pictures))


def _components(model: EigenGS, basis: Eigenbasis | None) -> list[Picture]:
    """Draw one column for each component of the sheet."""
    space = model.gaussians.space
    picks = [
        (channel, number - 1)
        for channel, count in enumerate(model.components)
        for number in (OTHERS if channel else FIRST)
        if number <= count
    ]
    if not picks:
        return []
    # There are at most 13 channels, so one program renders all.
    weights = np.stack([model.weights[channel][j] for channel, j in picks], axis=1)
    rendered = render(with_colors(model.gaussians, weights, "data")).numpy()
    columns = []
    for (channel, j), plane in zip(picks, np.moveaxis(rendered, 2, 0), strict=True):
        planes = [plane] if basis is None else [basis.components[channel][j], plane]
        # A quantile, because one bright pixel must not make everything else grey.
        scale = 0.5 / (np.quantile(np.abs(planes[0]), 0.999) or 1)
        hue = _hue(space, channel)
        pictures = [_cell(0.5 + scale * plane[..., None] * hue) for plane in planes]
        columns.append(_captioned(f"{CHANNELS[space][channel]} {j + 1}", *pictures))
    return columns


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


def _within(longest: int, width: int, height: int) -> tuple[int, int]:
    """Scale width and height to a given longer side."""
    scale = longest / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _cell(picture: Picture) -> Picture:
    """Resize a picture for a sheet."""
    width, height = _within(CELL, picture.shape[1], picture.shape[0])
    return resample(picture.astype(np.float32), width, height)


def _captioned(text: str, *pictures: Picture) -> Picture:
    """Stack pictures below a line of text."""
    return join_pictures([text_line(text, pictures[0].shape[1]), *pictures], 0)
