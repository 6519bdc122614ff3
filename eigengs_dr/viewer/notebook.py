"""What Jupyter shows of sets, fits, bases and models: a picture, a curve, and a line of figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import singledispatch
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..codec.packing import PackResult
from ..eigenbasis.eigengs import EigenGS
from ..eigenbasis.pca.basis import Eigenbasis
from ..fitting.fit import Fit
from ..gaussian.gaussians import Gaussians
from ..raster.render import picture_of
from .facts import MAX_GAUSSIANS
from .pictures import photo_uri
from .sheets import first_components

WIDTH, HEIGHT = 300, 170
"""Size of the chart in pixels."""

LEFT, RIGHT, TOP, BOTTOM = 44, 12, 24, 34
"""Space around the curve, in pixels."""


def draw_curve(points: Sequence[tuple[float, float]], x_name: str, y_name: str) -> str:
    """Draw a curve with the smallest and the largest value along each axis.

    Parameters
    ----------
    points : sequence of (float, float)
        x and y; points that are not finite are left out.
    x_name, y_name : str
        Names of the axes.

    Returns
    -------
    str
        SVG; empty for fewer than two points.
    """
    finite = [p for p in points if all(map(math.isfinite, p))]
    if len(finite) < 2:
        return ""
    (x0, x1), (y0, y1) = ((min(v), max(v)) for v in zip(*finite, strict=True))
    right, floor = WIDTH - RIGHT, HEIGHT - BOTTOM

    def place(x: float, y: float) -> str:
        across = (x - x0) / ((x1 - x0) or 1)
        up = (y - y0) / ((y1 - y0) or 1)
        return f"{LEFT + across * (right - LEFT):.1f},{floor - up * (floor - TOP):.1f}"

    line = " ".join(place(x, y) for x, y in finite)
    texts = (
        (LEFT, TOP - 10, "start", y_name),
        (LEFT - 6, TOP + 4, "end", f"{y1:.4g}"),
        (LEFT - 6, floor + 4, "end", f"{y0:.4g}"),
        (LEFT, floor + 16, "start", f"{x0:.3g}"),
        (right, floor + 16, "end", f"{x1:.3g}"),
        ((LEFT + right) / 2, floor + 30, "middle", x_name),
    )
    labels = "".join(
        f'<text x="{x}" y="{y}" text-anchor="{anchor}" fill="currentColor">{text}</text>'
        for x, y, anchor, text in texts
    )
    axes = f"M{LEFT},{TOP}V{floor}H{right}"
    return (
        f'<svg width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'style="font: 11px sans-serif"><title>{y_name} over {x_name}</title>'
        f'<path d="{axes}" fill="none" stroke="currentColor" opacity="0.5"/>'
        f'<polyline points="{line}" fill="none" stroke="#1f77b4" stroke-width="2"/>{labels}</svg>'
    )


MAX_SIDE = 480
"""Longest side of the picture of a set, in pixels. Smaller sets are shown at their size."""

THUMBNAIL = 120
"""Width of a component, in pixels."""


@singledispatch
def to_html(value: Any) -> str:
    """Return HTML of a set, a fit, a basis or a model."""
    return f"<pre>{escape(repr(value))}</pre>"


@to_html.register
def _show_set(gaussians: Gaussians) -> str:
    if len(gaussians) > MAX_GAUSSIANS:  # drawing them takes seconds
        return _block(repr(gaussians))
    scale = min(1.0, MAX_SIDE / max(gaussians.width, gaussians.height))
    width, height = (max(1, round(scale * s)) for s in (gaussians.width, gaussians.height))
    shown = picture_of(gaussians, width, height)
    return _block(repr(gaussians), *(_maps(shown) if gaussians.maps else [_image(shown)]))


@to_html.register
def _show_fit(fit: Fit) -> str:
    scale = -(-max(fit.gaussians.width, fit.gaussians.height) // MAX_SIDE)
    curve = [(row["seconds"], row["psnr_rgb"]) for row in fit.trace]
    if isinstance(fit.image, Mapping):
        pictures = _maps({name: image[::scale, ::scale] for name, image in fit.image.items()})
    else:
        pictures = [_image(fit.image[::scale, ::scale])]
    return _block(repr(fit), *pictures, draw_curve(curve, "seconds", "PSNR in RGB, dB"))


@to_html.register
def _show_packed(packed: PackResult) -> str:
    psnr = f"psnr={packed.psnr:.2f}" if isinstance(packed.psnr, float) else "psnr_rgb: "
    if isinstance(packed.psnr, Mapping):
        psnr += ", ".join(f"{name} {value:.2f}" for name, value in packed.psnr.items())
    text = f"{packed.bytes:,} bytes, {packed.bits_per_pixel:.3f} bpp, {psnr}"
    return _block(text) + _show_set(packed.gaussians)


def _maps(pictures: Mapping[str, NDArray[Any]]) -> list[str]:
    """Return the pictures of maps with their names."""
    return [
        f'<figure style="margin: 0; text-align: center">{_image(picture)}'
        f"<figcaption>{escape(name)}</figcaption></figure>"
        for name, picture in pictures.items()
    ]


@to_html.register
def _show_basis(basis: Eigenbasis) -> str:
    return _block(repr(basis), *_figures(basis))


@to_html.register
def _show_model(model: EigenGS) -> str:
    return _block(repr(model), *_figures(model))


def _figures(source: EigenGS | Eigenbasis) -> list[str]:
    style = f"margin: 0; width: {THUMBNAIL}px; text-align: center"
    return [
        f'<figure style="{style}">{_image(picture, THUMBNAIL)}'
        f"<figcaption>{escape(name)}</figcaption></figure>"
        for name, picture in first_components(source)
    ]


def _image(picture: NDArray[Any], most: int = MAX_SIDE) -> str:
    """Return a picture as HTML; of data with 2 or more than 3 channels, the first is shown."""
    shown = picture if picture.shape[2] in (1, 3) else picture[..., :1]
    style = f"max-width: min(100%, {most}px)"
    return f'<img src="{photo_uri(np.asarray(shown, np.float32))}" style="{style}" alt="">'


def _block(text: str, *parts: str) -> str:
    style = "display: flex; flex-wrap: wrap; gap: 16px; align-items: flex-end"
    return f'<div><code>{escape(text)}</code><div style="{style}">{"".join(parts)}</div></div>'
