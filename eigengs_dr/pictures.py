"""Pictures of models: what the components look like, and where the splats lie."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .color import decode
from .components import colored
from .eigengs import EigenGS
from .gaussians import Gaussians
from .images import resampled
from .pca import CHANNELS, Eigenbasis
from .rendering import render

FIRST = (1, 2, 3, 5, 10, 20, 50, 100, 200)
"""Components of the first channel that are shown, counted from 1."""

OTHERS = (1, 2)
"""Components of the other channels that are shown."""

CELL = 240
"""Longer side of a component in a sheet, in pixels."""

COLUMNS = 7
"""Pictures side by side in a sheet."""

GAP = 8
"""White pixels between pictures."""

OUTLINES = 800
"""Longer side of a picture of ellipses, in pixels."""

LOW_COLOR, HIGH_COLOR = (214, 96, 20), (30, 90, 160)
"""Outlines of the splats for low frequencies, orange, and of all others, blue."""

Picture = NDArray[Any]


def component_sheet(model: EigenGS, basis: Eigenbasis | None = None) -> Picture:
    """Draw the mean image and some components of a model, and the outlines of its splats.

    Components are signed: they are shown around mid-grey, those of a colour difference in the
    colours between which they change.

    Parameters
    ----------
    model : EigenGS
    basis : Eigenbasis, optional
        What the model was fitted to: shown above what the Gaussians render, on the same scale.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB, not clamped, under 2,000 pixels wide.

    Raises
    ------
    ValueError
        If the basis has another size, space or number of components than the model.
    """
    if basis is not None:
        _require_same(model, basis)
    columns = [_mean(model, basis), *_components(model, basis)]
    tables = [
        _joined(columns[first : first + COLUMNS], 1) for first in range(0, len(columns), COLUMNS)
    ]
    outlines = [_captioned("standard deviations", ellipses(model.gaussians, model.low))]
    if model.low:
        outlines += _parts_of_mean(model)
    return _joined([*tables, _joined(outlines, 1)], 0)


def ellipses(gaussians: Gaussians, low: int = 0) -> Picture:
    """Draw the outline of every splat at one standard deviation.

    Parameters
    ----------
    gaussians : Gaussians
    low : int, optional
        So many splats, the first ones, are drawn in orange over the others in blue.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB on white, the longer side 800 pixels.
    """
    from PIL import Image, ImageDraw

    width, height = _within(OUTLINES, gaussians.width, gaussians.height)
    # Lines are drawn at twice the size and averaged: Pillow's have jagged edges.
    arrays = gaussians.scaled(2 * width, 2 * height).to_arrays()
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    a, b, c = arrays["factor"].T[:, :, None]
    y = np.sin(turn) / c
    x = (np.cos(turn) - b * y) / a
    points = np.stack([x, y], axis=2) + arrays["mean"][:, None]
    image = Image.new("RGB", (2 * width, 2 * height), "white")
    draw = ImageDraw.Draw(image)
    for n in reversed(range(len(points))):
        outline = LOW_COLOR if n < low else HIGH_COLOR
        draw.polygon(points[n].ravel().tolist(), outline=outline, width=2)
    return np.asarray(image.resize((width, height), Image.Resampling.BOX)) / 255


def _require_same(model: EigenGS, basis: Eigenbasis) -> None:
    """Raise ValueError for a basis that the model was not fitted to."""
    shapes = model.gaussians
    made = (shapes.width, shapes.height, shapes.space, model.components)
    given = (basis.width, basis.height, basis.space, tuple(map(len, basis.components)))
    if made != given:
        raise ValueError(f"basis is {given}, the model {made}; pass the basis it was fitted to")


def _mean(model: EigenGS, basis: Eigenbasis | None) -> Picture:
    """Column of the mean image."""
    pictures = [render(model.gaussians).numpy()]
    if basis is not None:
        pictures.insert(0, np.stack(decode(basis.space, list(basis.mean)), axis=2))
    return _captioned("mean", *map(_cell, pictures))


def _components(model: EigenGS, basis: Eigenbasis | None) -> list[Picture]:
    """One column a component that is shown."""
    space = model.gaussians.space
    chosen = [
        (channel, number - 1)
        for channel, count in enumerate(model.components)
        for number in (OTHERS if channel else FIRST)
        if number <= count
    ]
    if not chosen:
        return []
    # At most 13 channels, so one program renders all.
    weights = np.stack([model.weights[channel][j] for channel, j in chosen], axis=1)
    rendered = render(colored(model.gaussians, weights, "data")).numpy()
    columns = []
    for (channel, j), plane in zip(chosen, np.moveaxis(rendered, 2, 0), strict=True):
        planes = [plane] if basis is None else [basis.components[channel][j], plane]
        # One bright pixel must not make everything else grey.
        scale = 0.5 / (np.quantile(np.abs(planes[0]), 0.999) or 1)
        hue = _hue(space, channel)
        pictures = [_cell(0.5 + scale * plane[..., None] * hue) for plane in planes]
        columns.append(_captioned(f"{CHANNELS[space][channel]} {j + 1}", *pictures))
    return columns


def _parts_of_mean(model: EigenGS) -> list[Picture]:
    """What the splats for low and for high frequencies add to the mean image."""
    low = render(model.gaussians[: model.low]).numpy()
    high = render(model.gaussians).numpy() - low
    rest = len(model.gaussians) - model.low
    return [
        _captioned(f"mean by {model.low} low", _cell(low)),
        _captioned(f"mean by {rest} high", _cell(0.5 + high)),
    ]


def _hue(space: str, channel: int) -> NDArray[np.float32]:
    """RGB that one channel of a space adds, its largest entry 1."""
    added = np.subtract(decode(space, list(np.eye(3)[channel])), decode(space, [0.0] * 3))
    return (added / np.abs(added).max()).astype(np.float32)


def _within(longest: int, width: int, height: int) -> tuple[int, int]:
    """Width and height of the same shape with a given longer side."""
    scale = longest / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _cell(picture: Picture) -> Picture:
    """Bring a picture to the size of a sheet."""
    width, height = _within(CELL, picture.shape[1], picture.shape[0])
    return resampled(picture.astype(np.float32), width, height)


def _captioned(text: str, *pictures: Picture) -> Picture:
    """Put pictures on top of each other, below a line of text."""
    from PIL import Image, ImageDraw

    line = Image.new("RGB", (pictures[0].shape[1], 12), "white")
    ImageDraw.Draw(line).text((0, 0), text, fill="black")
    return _joined([np.asarray(line) / 255, *pictures], 0)


def _joined(pictures: list[Picture], axis: int) -> Picture:
    """Put pictures below each other (axis 0) or side by side (axis 1), on white."""
    most = max(picture.shape[1 - axis] for picture in pictures)
    padded = []
    for picture in pictures:
        room = [(0, 0)] * 3
        room[axis], room[1 - axis] = (0, GAP), (0, most - picture.shape[1 - axis])
        padded.append(np.pad(picture, room, constant_values=1))
    return np.concatenate(padded, axis)
