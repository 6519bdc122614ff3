"""Pictures of sets and models: outlines of Gaussians, components, and photos in a page."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.basis import Eigenbasis
from ..eigenbasis.eigengs import EigenGS
from ..eigenbasis.truncation import CHANNELS
from ..gaussian.covariance import outline
from ..gaussian.gaussians import Gaussians, with_colors
from ..image.io import to_8bit
from ..image.resize import resample
from ..image.sheet import join_pictures, text_line
from ..image.space import DATA, Space, space_of
from ..raster.render import render

ELLIPSES_SIDE = 800
"""Longer side of a picture of ellipses, in pixels."""

MAX_OUTLINES = 2000
"""Largest number of outlines over a picture; more would hide each other."""

MIN_SIDE = 512
"""Smallest longer side of a picture under outlines, in pixels; smaller pictures are enlarged."""

WHITE_SHARE = 0.6
"""Share of white that is blended into a picture under outlines."""

MAX_REACH = 100
"""Largest extent of a drawn outline, in longer sides of the picture. A longer outline would look
straight, and Pillow does not accept larger coordinates."""

LOW_COLOR, HIGH_COLOR = (214, 96, 20), (30, 90, 160)
"""Colours of outlines: orange for the Gaussians of low frequencies, blue for all others."""

Picture = NDArray[np.floating]
Color = tuple[int, int, int]


def ellipses(gaussians: Gaussians, low: int = 0) -> Picture:
    """Draw the outline of every Gaussian at one standard deviation.

    Parameters
    ----------
    gaussians : Gaussians
    low : int, optional
        Number of Gaussians of low frequencies. These first Gaussians are orange and drawn on top;
        all others are blue.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB on white; the longer side has 800 pixels.
    """
    width, height = within(ELLIPSES_SIDE, gaussians.width, gaussians.height)
    colors = [LOW_COLOR] * low + [HIGH_COLOR] * (len(gaussians) - low)
    return _outlined(np.ones((height, width, 3)), gaussians, colors)


def overlay(gaussians: Gaussians, picture: Picture) -> Picture:
    """Draw the outlines of Gaussians at one standard deviation over a lightened picture.

    At most 2,000 Gaussians are drawn, which are selected at random with a fixed seed.

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
    # A regular selection would show stripes if the Gaussians lie on a grid.
    selection = np.random.default_rng(0).permutation(len(gaussians))[:MAX_OUTLINES]
    light = WHITE_SHARE + (1 - WHITE_SHARE) * np.clip(picture, 0, 1)
    subset = gaussians[selection]
    return _outlined(light, subset, [HIGH_COLOR] * len(subset))


def comparison(image: Picture, picture: Picture, gaussians: Gaussians) -> Picture:
    """Put an image, its fit, and the outlines of the Gaussians over the fit side by side.

    Parameters
    ----------
    image, picture : ndarray of float, shape (H, W, 3) or (H, W, 1)
        The image and its fit, RGB or grey, of one size.
    gaussians : Gaussians
        The Gaussians of the fit.

    Returns
    -------
    ndarray of float, shape (k * H, 3 * k * W, 3)
        RGB. Every pixel is repeated k times along both axes; k is the smallest number for which the
        longer side of each part has at least 512 pixels.
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
    # Pillow's lines are not antialiased; drawing at twice the size and averaging smooths them.
    pixels = np.broadcast_to(to_8bit(picture), (height, width, 3)).astype(np.uint8)
    image = Image.fromarray(pixels.repeat(2, axis=0).repeat(2, axis=1))
    draw = ImageDraw.Draw(image)
    arrays = gaussians.scaled(2 * width, 2 * height).to_arrays()
    points = outline(arrays["factor"]) + arrays["mean"].astype(np.float64)[:, None]
    for n in reversed(np.flatnonzero(_is_visible(points, image.size))):
        draw.line(points[n].ravel().tolist(), fill=colors[n], width=2)
    return np.asarray(image.resize((width, height), Image.Resampling.BOX), np.float32) / 255


def _is_visible(points: Picture, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which outlines may cross a picture and are small enough for Pillow."""
    low, high = points.min(axis=1), points.max(axis=1)
    longest = MAX_REACH * max(size)
    near = (low > -longest) & (high < longest)
    return (near & (high >= 0) & (low <= size)).all(axis=1)


def within(longest: int, width: int, height: int) -> tuple[int, int]:
    """Scale width and height to a given longer side."""
    scale = longest / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


FIRST_CHANNEL_COMPONENTS = (1, 2, 3, 5, 10, 20, 50, 100, 200)
"""Components of the first channel that are shown, counted from 1."""

OTHER_CHANNEL_COMPONENTS = (1, 2)
"""Components of the other channels that are shown, counted from 1."""

CELL_SIDE = 240
"""Longer side of a component in a sheet, in pixels."""

SHEET_COLUMNS = 7
"""Number of pictures side by side in a sheet."""


def component_sheet(model: EigenGS, basis: Eigenbasis | None = None) -> Picture:
    """Draw the mean image, some components and the outlines of the Gaussians of a model.

    Parameters
    ----------
    model : EigenGS
    basis : Eigenbasis, optional
        The basis to which the model was fitted. Its components are shown above the rendered ones.

    Returns
    -------
    ndarray of float, shape (H, W, 3)
        RGB, not clamped, less than 2,000 pixels wide.
    """
    sources: list[EigenGS | Eigenbasis] = [model] if basis is None else [basis, model]
    columns = zip(*(first_components(source) for source in sources), strict=True)
    cells = [_captioned(column[0][0], *(picture for _, picture in column)) for column in columns]
    starts = range(0, len(cells), SHEET_COLUMNS)
    rows = [join_pictures(cells[k : k + SHEET_COLUMNS], 1) for k in starts]
    outlines = _captioned("standard deviations", ellipses(model.gaussians, model.low))
    return join_pictures([*rows, outlines], 0)


def first_components(source: EigenGS | Eigenbasis) -> list[tuple[str, Picture]]:
    """Return pictures of the mean image and some components of a basis, or as rendered by a model.

    Components are signed, so mid-grey is zero. A component of a colour difference has the two
    colours of that difference.

    Parameters
    ----------
    source : EigenGS or Eigenbasis

    Returns
    -------
    list of (str, ndarray of float, shape (H, W, 3))
        Names and pictures in RGB, not clamped; the longer side has `CELL_SIDE` pixels.
    """
    if isinstance(source, EigenGS):
        space, counts = source.gaussians.space, source.components
        mean, selection = render(source.gaussians).numpy(), _selected(counts)
        planes: Picture = np.zeros(0)
        if selection:  # there are at most 13, so one program renders all
            weights = np.stack([source.weights[channel][j] for channel, j in selection], axis=1)
            rendered = render(with_colors(source.gaussians, weights, DATA)).numpy()
            planes = np.moveaxis(rendered, 2, 0)
    else:
        space, counts = space_of(source.space), tuple(map(len, source.components))
        mean, selection = np.stack(space.decode(list(source.mean)), axis=2), _selected(counts)
        planes = np.array([source.components[channel][j] for channel, j in selection])
    named = [("mean", _cell(mean))]
    for (channel, j), plane in zip(selection, planes, strict=True):
        # A quantile, so that one bright pixel does not make everything else grey.
        scale = 0.5 / (np.quantile(np.abs(plane), 0.999) or 1)
        picture = _cell(0.5 + scale * plane[..., None] * _hue(space, channel))
        named.append((f"{CHANNELS[space][channel]} {j + 1}", picture))
    return named


def _selected(components: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return the channels and indices of the components that are shown."""
    return [
        (channel, number - 1)
        for channel, count in enumerate(components)
        for number in (OTHER_CHANNEL_COMPONENTS if channel else FIRST_CHANNEL_COMPONENTS)
        if number <= count
    ]


def _hue(space: Space, channel: int) -> NDArray[np.float32]:
    """Return the RGB direction of one channel of a space; its largest entry is 1."""
    difference = np.subtract(space.decode(list(np.eye(3)[channel])), space.decode([0.0] * 3))
    return (difference / np.abs(difference).max()).astype(np.float32)


def _cell(picture: Picture) -> Picture:
    """Resize a picture to the size of a cell of a sheet."""
    width, height = within(CELL_SIDE, picture.shape[1], picture.shape[0])
    return resample(picture.astype(np.float32), width, height)


def _captioned(text: str, *pictures: Picture) -> Picture:
    """Stack pictures below a line of text."""
    return join_pictures([text_line(text, pictures[0].shape[1]), *pictures], 0)


MAX_PHOTO_SIDE = 2048
"""Largest side of a photo in a page, in pixels; larger photos are scaled down."""

JPEG_QUALITY = 92
"""Quality of photos in JPEG, from 0 to 100."""


def check_aspect(pixels: Picture, size: tuple[int, int]) -> None:
    """Raise ValueError unless a photo has the aspect ratio of a set, (width, height)."""
    height, width = pixels.shape[:2]
    if abs(width * size[1] - height * size[0]) > max(*size, width, height):
        raise ValueError(
            f"the photo has {width}x{height} pixels, the set {size[0]}x{size[1]}; "
            "give the photo to which the set was fitted"
        )


def photo_uri(pixels: NDArray[np.float32]) -> str:
    """Return a data URI of a photo, as JPEG, or as PNG if that is smaller.

    Parameters
    ----------
    pixels : ndarray of float32, shape (H, W, C)
        sRGB or data; clamped. Of data with 2 or more than 3 channels, the first is shown.
    """
    from PIL import Image

    height, width, channels = pixels.shape
    pixels = pixels if channels == 3 else pixels[..., :1]
    small = resample(pixels, *within(min(MAX_PHOTO_SIDE, max(width, height)), width, height))
    codes = to_8bit(small).astype(np.uint8)
    picture = Image.fromarray(codes[..., 0] if codes.shape[2] == 1 else codes)
    jpeg, png = BytesIO(), BytesIO()
    picture.save(jpeg, "jpeg", quality=JPEG_QUALITY, subsampling=0)
    picture.save(png, "png", optimize=True)
    kind, file = min(("jpeg", jpeg), ("png", png), key=lambda candidate: candidate[1].tell())
    return f"data:image/{kind};base64,{b64encode(file.getvalue()).decode()}"
