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

import jinja2
from numpy.typing import ArrayLike

from ..backend.recording import exclusive
from ..eigenbasis.eigengs import EigenGS
from ..fitting.fit import Fit
from ..gaussian.gaussians import Gaussians, one_image, set_of
from ..image.color import UNBOUNDED, rendered_as
from ..storage.atomic import atomic_write
from .facts import LIGHTS, channel_views, describe_model, describe_set, describe_share
from .pictures import check_aspect, displayed, photo_uri

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


@cache
def _template() -> jinja2.Template:
    """Return the template of a page; an unknown value is an error, and text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("eigengs_dr.viewer", "web"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("page.html.j2")


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
    if not isinstance(source, Gaussians | Fit | EigenGS):
        raise TypeError(
            f"{type(source).__name__} cannot be shown; expected Gaussians, Fit or EigenGS"
        )
    whole = source if isinstance(source, EigenGS) else None
    gaussians = one_image(set_of(source)) if whole is None else whole.gaussians
    pixels = None if image is None else displayed(image, gaussians.space, encoding)
    model = None if whole is None else describe_model(whole, pixels)
    if pixels is not None and whole is not None:
        gaussians = gaussians.scaled(pixels.shape[1], pixels.shape[0])
    elif pixels is not None:
        check_aspect(pixels, (gaussians.width, gaussians.height))
    views = channel_views(gaussians.channels)
    facts = {
        "set": describe_set(gaussians, levels),
        "light": LIGHTS.get(gaussians.space, 0),
        "channels": views[0][1],
        "photo": None if pixels is None else photo_uri(pixels),
        "model": model,
    }
    html = _template().render(
        title=title,
        summary=f"{len(gaussians):,} Gaussians, {gaussians.width} x {gaussians.height} pixels",
        facts=facts,
        model_note="" if whole is None else describe_share(whole),
        views=views,
        bright=gaussians.space in UNBOUNDED,
        color_name="Colour" if rendered_as(gaussians.space) else "Values",
    )
    return Page(html)
