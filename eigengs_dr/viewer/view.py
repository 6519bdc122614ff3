"""What a browser shows: the page of a set, a fit or a model, and their HTML in a notebook.

A page, which `view` makes, is one HTML file that needs neither other files nor a network.
"""

from __future__ import annotations

import os
import zlib
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, singledispatch
from html import escape
from pathlib import Path

import jinja2
import numpy as np
from numpy.typing import NDArray

from ..backend.types import ArrayLike, Record
from ..eigenbasis.basis import Eigenbasis
from ..eigenbasis.eigengs import EigenGS
from ..fitting.fit import Fit
from ..gaussian.file import check
from ..gaussian.gaussians import Gaussians, one_image, set_of
from ..image.io import Codes, displayed, read_photo
from ..image.metrics import psnr
from ..image.pixels import check_encoding, codes_of
from ..image.resize import resample
from ..raster.render import picture_of
from ..relight.lights import check_lights
from ..relight.model import Relightable
from ..storage.atomic import atomic_write
from .pictures import check_aspect, first_components, photo_uri, within


@dataclass(frozen=True, repr=False)
class Page:
    """A page for the browser that shows a set or a model.

    Jupyter shows it as the value of a cell. It needs WebGL 2, which browsers have supported since
    2021, but no network.

    Attributes
    ----------
    html : str
        The complete page.
    """

    html: str

    def __repr__(self) -> str:
        return f"Page({len(self.html.encode()):,} bytes)"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page atomically as an ``.html`` file.

        Raises
        ------
        ValueError
            If the name has another suffix.
        OSError
            If the file cannot be written; an existing file does not change.
        """
        if Path(path).suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"{path}: the name must end in .html")
        with atomic_write(path) as temporary:
            temporary.write_text(self.html, encoding="utf-8")

    def _repr_html_(self) -> str:
        """Return the page in a frame, so that styles do not mix."""
        style = "width: 100%; height: 560px; border: 1px solid #8886"
        return f'<iframe srcdoc="{escape(self.html)}" style="{style}"></iframe>'


@cache  # compiled once
def _template() -> jinja2.Template:
    """Return the template of a page; undefined values are errors, and text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("eigengs_dr.viewer", "web"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("page.html.j2")


def view(
    source: Gaussians | Fit | EigenGS | Relightable,
    image: ArrayLike | None = None,
    *,
    levels: Sequence[int] = (),
    title: str = "Gaussians",
    encoding: str | None = None,
    light: ArrayLike | None = None,
) -> Page:
    """Make a page for the browser that renders a set or a model as `render` does.

    The page pans and zooms without limits, and can show outlines, only the first Gaussians, and the
    parameters of the Gaussian under the pointer. For a model it has sliders for the first
    components of each channel, and draws random images. Of a model of lights, the light follows the
    pointer, and on a phone the finger, unless a photo is compared; buttons turn it to usual places.

    Parameters
    ----------
    source : Gaussians, Fit, EigenGS or Relightable
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W), optional
        A photo to compare with. A model encodes it, so that the sliders start from it. For a model
        of lights, a file is read as stored, without its EXIF orientation.
    levels : sequence of int, optional
        Number of Gaussians up to each level, as from `level_counts`.
    title : str, optional
        Title of the page.
    encoding : {"srgb", "linear"}, optional
        The encoding of the pixels of the image, see `fit`.
    light : array_like, shape (3,), optional
        For a model of lights, the direction of the light at first, by default that of the camera.
        It must be given with a photo, as that of the photo.

    Returns
    -------
    Page
        Save it with ``page.save("page.html")``; a notebook displays it.

    Raises
    ------
    ValueError
        If the set has more than a million Gaussians, a value is not finite, the image has another
        aspect ratio than a set (a model encodes any), a fit has a mean image of pixels, or a light
        is missing or no direction above the horizon.
    TypeError
        If the source has another type.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> page = eg.view(g, title="One Gaussian")
    >>> "One Gaussian" in page.html
    True
    """
    if not isinstance(source, Gaussians | Fit | EigenGS | Relightable):
        raise TypeError(
            f"{type(source).__name__} cannot be shown; expected Gaussians, Fit, EigenGS or "
            "Relightable"
        )
    check_encoding(encoding)
    if encoding and image is None:
        raise ValueError("encoding is for the pixels of an image; leave it out, or give one")
    model = source if isinstance(source, EigenGS) else None
    lights, presets, pixels = None, [], None
    if isinstance(source, Relightable):
        if image is not None and light is None:
            raise ValueError(
                "a photo is compared under its own light; give it as light, such as (0.3, 0.2, 0.9)"
            )
        direction = np.asarray(OVERHEAD if light is None else light)
        [start] = check_lights(direction[None], "light").tolist()
        gaussians, lights = source.relight(start), describe_lights(source) | {"start": start}
        presets = light_presets(source)
        if image is not None:
            presets.insert(0, ("As in the photo", start))
            # Lights belong to the pixels that a file stores, as in `Relightable.fit`.
            pixels = codes_of(read_photo(image, encoding, arrays="srgb", upright=False))
    else:
        if light is not None:
            raise ValueError("light is for a model of lights; leave it out")
        gaussians = one_image(set_of(source)) if model is None else model.gaussians
        if image is not None:
            pixels = displayed(image, gaussians.space, encoding)
    model_facts, note = None, ""
    if model is not None:
        counts = kept_counts(model)
        model_facts, note = describe_model(model, counts, pixels), describe_share(model, counts)
        if pixels is not None:
            gaussians = gaussians.scaled(pixels.shape[1], pixels.shape[0])
    elif pixels is not None:
        check_aspect(pixels, (gaussians.width, gaussians.height))
    summary = f"{len(gaussians):,} Gaussians, {gaussians.width} x {gaussians.height} pixels"
    if isinstance(source, Fit) and np.isfinite(source.psnr_rgb):
        summary += f"; psnr_rgb {source.psnr_rgb:.2f} dB"
    elif model is None and pixels is not None and gaussians.space.is_color:
        shown = picture_of(gaussians, pixels.shape[1], pixels.shape[0])
        summary += f"; psnr_rgb {psnr(shown, pixels, 'rgb'):.2f} dB"
    if isinstance(source, Relightable) and np.isfinite(source.psnr_held_out):
        summary += f"; left-out lights: psnr_rgb {source.psnr_held_out:.2f} dB"
    views = channel_views(gaussians.channels)
    facts = {
        "set": describe_set(gaussians, levels) | ({} if lights is None else {"color": None}),
        "light": gaussians.space.page_kind,
        "channels": views[0][1],
        "photo": None if pixels is None else photo_uri(pixels),
        "model": model_facts,
        "lights": lights,
    }
    html = _template().render(
        title=title,
        summary=summary,
        facts=facts,
        model_note=note,
        views=views,
        presets=presets,
        bright=not gaussians.space.bounded,
        color_name="Colour" if gaussians.space.is_color else "Values",
    )
    return Page(html)


# --- The data of a page: arrays in base64, with colours decoded to RGB ----------------------------

MAX_GAUSSIANS = 1 << 20
"""Largest number of Gaussians of a page; those of a photo take 25 bytes each."""


MEAN_STEP = 2.0**-10
"""Pixels to whose multiples a page rounds means."""


def check_count(count: int) -> None:
    """Raise ValueError if there are too many Gaussians for a page."""
    if count > MAX_GAUSSIANS:
        raise ValueError(
            f"{count:,} Gaussians are too many for a page; the limit is {MAX_GAUSSIANS:,}"
        )


def describe_set(gaussians: Gaussians, levels: Sequence[int] = ()) -> Record:
    """Return the arrays of a set for a page.

    Parameters
    ----------
    gaussians : Gaussians
    levels : sequence of int, optional
        Number of Gaussians up to each level, ascending.

    Raises
    ------
    ValueError
        If the set has too many Gaussians or invalid values, or a level is out of range.
    """
    check_count(len(gaussians))
    data = gaussians.data()
    check(data)
    marks = [int(n) for n in levels]
    if marks != sorted(set(marks)) or (marks and not 1 <= marks[0] <= marks[-1] <= len(gaussians)):
        raise ValueError(f"levels are {marks}; expected ascending numbers up to {len(gaussians)}")
    color, background = decoded(gaussians)
    mean = np.rint(data.arrays["mean"] / MEAN_STEP) * MEAN_STEP
    return {
        "width": gaussians.width,
        "height": gaussians.height,
        "cutoff": gaussians.cutoff,
        "levels": marks,
        "mean": deflated(mean),
        "factor": deflated(shortened(data.arrays["factor"])),
        "color": deflated(shortened(color)),
        "background": background.tolist(),
    }


def decoded(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the colours (N, C) and the background (C,) of a set, decoded to RGB."""
    arrays = gaussians.to_arrays()
    black = np.zeros_like(arrays["background"])
    rows = np.vstack([arrays["color"], arrays["background"], black]).astype(np.float64)
    rgb = gaussians.space.decode_image(rows) if gaussians.space.affine else rows
    return rgb[:-2] - rgb[-1], rgb[-2]


def to_text(array: NDArray[np.floating], kind: str = "<f8") -> str:
    """Return the bytes of an array in base64."""
    return b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()


def shortened(array: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return numbers of 13 significant bits: the zeros behind them take no bytes in a page."""
    fraction, exponent = np.frexp(array.astype(np.float64))
    return np.ldexp(np.rint(fraction * 2**13) / 2**13, exponent)


def deflated(rows: NDArray[np.floating], kind: str = "<f4") -> Record:
    """Return rows of floats (N, C) for a page: column after column, deflated.

    The bytes of a column are sorted by their place in a number, as deflate finds more that way.
    """
    columns = np.asfortranarray(rows, kind).T
    sorted_bytes = columns.view("u1").reshape(*columns.shape, -1).swapaxes(1, 2)
    data = b64encode(zlib.compress(sorted_bytes.tobytes(), 9)).decode()
    return {"rows": len(rows), "columns": len(columns), "kind": kind, "deflated": data}


def channel_views(channels: int) -> list[tuple[str, tuple[int, int, int]]]:
    """Return the names and the triples of channels that a page can show.

    Examples
    --------
    >>> channel_views(3), channel_views(2)
    ([('Colour', (0, 1, 2))], [('1', (0, 0, 0)), ('2', (1, 1, 1))])
    """
    if channels == 3:
        return [("Colour", (0, 1, 2))]
    single = [(str(c + 1), (c, c, c)) for c in range(channels)]
    return [*([("1, 2, 3 as red, green, blue", (0, 1, 2))] if channels > 3 else []), *single]


OVERHEAD = (0.0, 0.0, 1.0)
"""The light of a page at first: that of the camera."""

LEAST_RAKING = 0.17
"""Smallest z of a raking light: 10 degrees above the horizon."""


def describe_lights(model: Relightable) -> Record:
    """Return the planes of a model of lights and the functions of its table for a page."""
    check_count(len(model.planes))
    arrays, table = model.planes.to_arrays(), model.table
    scales = np.abs(arrays["color"]).max(axis=0, initial=0)
    scales = np.where(scales > 0, scales, 1)
    return {
        "kind": table.kind,
        "lights": to_text(table.lights),
        "coefficients": to_text(table.coefficients),
        "planes": deflated(arrays["color"] / scales, "<f2"),
        "scales": scales.tolist(),
        "background": arrays["background"].tolist(),
    }


def light_presets(model: Relightable) -> list[tuple[str, Sequence[float]]]:
    """Return names and directions of lights; raking ones are as low as those of the photos."""
    low = max(float(model.lights[:, 2].min()), LEAST_RAKING)
    aside = (1 - low**2) ** 0.5
    raking = [("Raking, left", (-aside, 0, low)), ("Raking, top", (0, aside, low))]
    return [*raking, ("From the camera", OVERHEAD)]


MAX_WEIGHT_BYTES = 1 << 20
"""Largest size of the weights in a page in bytes, before base64; a weight takes 2."""

MIN_COMPONENTS = 8
"""Number of components of each channel that a page always has: those with a slider."""


def describe_model(
    model: EigenGS, counts: Sequence[int], image: NDArray[np.float32] | None = None
) -> Record:
    """Return the components of a model for a page.

    Parameters
    ----------
    model : EigenGS
    counts : sequence of int
        See `kept_counts`.
    image : ndarray of float32, shape (H, W, 3), optional
        A photo in sRGB, which is encoded as the start of the sliders.
    """
    space = model.gaussians.space
    deviations = [np.sqrt(v[:n]) for v, n in zip(model.eigenvalues, counts, strict=True)]
    channels = []
    for name, weights, deviation in zip(space.names, model.weights, deviations, strict=True):
        kept = weights[: len(deviation)]
        scales = np.abs(kept).max(axis=1, initial=0)
        scales = np.where(scales > 0, scales, 1)
        channel = {"name": name, "deviations": deviation.tolist(), "scales": scales.tolist()}
        channels.append(channel | {"weights": deflated(kept.T / scales, "<f2")})
    photo = None
    if image is not None:
        color, background = decoded(model.encode(Codes(image)))
        scores = [  # coefficients in standard deviations
            (values[: len(d)] / np.maximum(d, np.finfo(float).tiny ** 0.5)).tolist()
            for values, d in zip(model.project(Codes(image)), deviations, strict=True)
        ]
        photo = {"color": deflated(shortened(color)), "background": background.tolist()}
        photo["scores"] = scores
    return {"matrix": space.to_rgb.tolist(), "channels": channels, "photo": photo}


def kept_counts(model: EigenGS) -> list[int]:
    """Return the number of components of each channel in a page: those of the largest variance."""
    max_count = MAX_WEIGHT_BYTES // (2 * (len(model.gaussians) + 1))
    variances = [np.inf, *np.sort(np.concatenate(model.eigenvalues))[::-1]]
    least = variances[min(max_count, len(variances) - 1)]
    return [max(min(MIN_COMPONENTS, len(v)), int((v >= least).sum())) for v in model.eigenvalues]


def describe_share(model: EigenGS, counts: Sequence[int]) -> str:
    """Return a sentence about the components that a page leaves out; empty if there are none."""
    components = sum(model.components)
    if sum(counts) == components:
        return ""
    kept = sum(v[:n].sum() for v, n in zip(model.eigenvalues, counts, strict=True))
    total = sum(v.sum() for v in model.eigenvalues)
    return (
        f"A random image uses the first {sum(counts)} of {components} components, "
        f"with {kept / total:.0%} of their variance."
    )


# --- What a notebook shows: pictures and a line of figures ----------------------------------------

MAX_PICTURE_SIDE = 480
"""Largest side of the picture of a set, in pixels. Smaller sets are shown at their native size."""

THUMBNAIL_WIDTH = 120
"""Width of a component, in pixels."""


@singledispatch
def to_html(value: object) -> str:
    """Return what a notebook shows of a set, a fit, a basis or a model: pictures and a line.

    Parameters
    ----------
    value : Gaussians, Fit, Eigenbasis, EigenGS or Relightable

    Returns
    -------
    str
        HTML, with the pictures in it.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> "<img" in eg.to_html(g)
    True
    """
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


@to_html.register
def _show_lights(model: Relightable) -> str:
    gaussians = model.relight(OVERHEAD)
    return _block(repr(model), *_images(picture_of(gaussians, *_shown_size(gaussians))))


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
