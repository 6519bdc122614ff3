"""The function `view`, which makes a page of a set, a fit or a model.

A page is one HTML file that needs no other file and no network.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from ..backend.recording import exclusive
from ..eigenbasis.eigengs import EigenGS
from ..fitting.fit import Fit
from ..gaussian.gaussians import Gaussians, one_image
from ..image.color import UNBOUNDED, rendered_as
from ..image.io import check_data, check_image
from ..storage.atomic import atomic_write
from .facts import channel_views, describe_model, describe_set, describe_share, light_of
from .pictures import check_aspect, photo_uri

SCRIPTS = (
    "data.js",
    "camera.js",
    "shaders.js",
    "renderer.js",
    "model.js",
    "gestures.js",
    "viewer.js",
    "panel.js",
    "main.js",
)
"""The programs of the page, in the order in which they run."""

FRAME_HEIGHT = 560
"""Height of a page inside a notebook, in pixels."""


@dataclass(frozen=True, repr=False)
class Page:
    """A page for the browser that shows a set or a model.

    Jupyter shows it as the value of a cell. It needs WebGL 2, which browsers have since 2021, and
    no network.

    Attributes
    ----------
    html : str
        The whole page.
    """

    html: str

    def __repr__(self) -> str:
        return f"Page({len(self.html):,} bytes)"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page as an ``.html`` file, completely or not at all.

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
        """Show the page in a frame of its own, so that neither page styles the other."""
        style = f"width: 100%; height: {FRAME_HEIGHT}px; border: 1px solid #8886"
        return f'<iframe srcdoc="{escape(self.html)}" style="{style}"></iframe>'


def build_page(**values: Any) -> Page:
    """Fill the template; for the values see ``web/page.html.j2``. Text is escaped."""
    loader = _environment().loader
    assert loader is not None
    scripts = [Markup(_source(name)) for name in SCRIPTS]
    template = _environment().get_template("page.html.j2")
    return Page(template.render(style=Markup(_source("page.css")), scripts=scripts, **values))


@cache
def _environment() -> jinja2.Environment:
    """Return the environment of the template; an unknown value is an error."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("eigengs_dr.viewer", "web"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )


def _source(name: str) -> str:
    loader = _environment().loader
    assert loader is not None
    return loader.get_source(_environment(), name)[0]


@exclusive()
def view(
    source: Gaussians | Fit | EigenGS,
    image: ArrayLike | None = None,
    *,
    levels: Sequence[int] = (),
    title: str = "Gaussians",
    encoding: str | None = None,
) -> Page:
    """Make a page for the browser that draws a set or a model as `render` does.

    The page pans and zooms without end, and shows outlines, the first Gaussians alone, and the
    parameters of the one under the pointer. For a model it has sliders for the first components of
    each channel, and draws random images.

    Parameters
    ----------
    source : Gaussians, Fit or EigenGS
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W), optional
        The photo, to compare with. A model encodes it, so that the sliders move it.
    levels : sequence of int, optional
        Numbers of first Gaussians that make a whole image each, as from `level_counts`.
    title : str, optional
        Title of the page.
    encoding : {"srgb", "linear"}, optional
        What the pixels of the image are, see `fit`.

    Returns
    -------
    Page
        Save it by ``page.save("page.html")``; a notebook shows it.

    Raises
    ------
    ValueError
        If the set has more than a million Gaussians, a value is not finite, the image has another
        aspect ratio than the set, or a fit has a mean image of pixels.
    TypeError
        If the source is something else.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> page = eg.view(g, title="One Gaussian")
    >>> "One Gaussian" in page.html
    True
    """
    if isinstance(source, Fit):
        if source.mean_image is not None:
            raise ValueError("the fit has a mean image of pixels, which a page cannot draw")
        source = source.gaussians
    if isinstance(source, Gaussians):
        one_image(source)
    if not isinstance(source, Gaussians | EigenGS):
        raise TypeError(
            f"{type(source).__name__} cannot be shown; expected Gaussians, Fit or EigenGS"
        )
    gaussians = source if isinstance(source, Gaussians) else source.gaussians
    pixels = None if image is None else _photo(image, gaussians.space, encoding)
    model = None
    if isinstance(source, EigenGS):
        model = describe_model(source, pixels)
        if pixels is not None:
            gaussians = gaussians.scaled(pixels.shape[1], pixels.shape[0])
    elif pixels is not None:
        check_aspect(pixels, (gaussians.width, gaussians.height))
    views = channel_views(gaussians.channels)
    facts = {
        "set": describe_set(gaussians, levels),
        "light": light_of(gaussians.space),
        "channels": views[0][1],
        "photo": None if pixels is None else photo_uri(pixels),
        "model": model,
    }
    return build_page(
        title=title,
        summary=f"{len(gaussians):,} Gaussians, {gaussians.width} x {gaussians.height} pixels",
        facts=facts,
        photo=pixels is not None,
        model=model is not None,
        model_note=describe_share(source) if isinstance(source, EigenGS) else "",
        levels=bool(levels),
        views=views if len(views) > 1 else [],
        bright=gaussians.space in UNBOUNDED,
        color_name="Colour" if rendered_as(gaussians.space) else "Values",
    )


def _photo(image: ArrayLike, space: str, encoding: str | None) -> NDArray[np.float32]:
    """Return a photo as people look at it: sRGB, or data."""
    data = rendered_as(space) is None
    return check_data(image) if data else check_image(image, encoding=encoding)
