"""The function `fit_for_scene`, which finds the fewest Gaussians for the cameras of a scene.

The target of the fit is not the image but a smoother texture that looks the same to the cameras
(`eigengs_dr.scene.target`). A search then finds the smallest number of Gaussians with
which every camera sees the texture at a given PSNR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, zoom
from skimage.transform import resize_local_mean

from ..backend.arrays import types_in
from ..backend.entry_points import entry_point, shows_progress
from ..backend.interrupts import Interrupted
from ..backend.selection import backend_of, select
from ..backend.types import ArrayLike, Texture
from ..fitting.channels import Measured, restored
from ..fitting.loop import Descent
from ..fitting.method import DEFAULT
from ..fitting.objective import Objective, Pixels
from ..fitting.options import Goal
from ..fitting.search import search_count
from ..gaussian.covariance import max_deviation
from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import Gaussians
from ..image.io import displayed
from ..image.metrics import psnr as psnr_of
from ..image.pixels import check_encoding
from ..image.space import DATA, LINEAR, Affine, Space, space_of
from ..plugins.cone import PIXEL, check_scene
from ..raster.render import render
from .rendering import Progress, stages
from .target import error_weights, seen_by, smoothest_target
from .visibility import Box, Visibility, visibility

COLORS = ("linear", "radiance", "data")
"""Names of the spaces of textures: linear light to 1, or of any range, or data."""

PIXELS = 4
"""Fewest pixels per Gaussian at the start of the search."""

FEWER, GAIN = (64, 16, 4, 1), 8.0
"""Parts of that number that are placed in turn, and decibels that a search gains: the first part
that is no further below the goal is the start. A fit of few Gaussians needs few texels."""

ENOUGH = 2.0
"""Smallest number of texels per pixel without an enlargement. With fewer texels the image is
interpolated bilinearly, as bitmaps are; else no sample would show the Gaussians between texels.
With twice as many and more it is halved, again and again: the cameras see the same, and the fit
takes a quarter of the time. 1,024 x 1,024 texels at 6 and more texels per pixel: 1,390 instead of
1,515 Gaussians for 40 dB, and 46.81 instead of 46.87 dB between the renderings."""

DETAIL = 64
"""Fewest seen texels per Gaussian in a fit. A target with four times as many is halved, again and
again: 200 Gaussians show no more of an enlarged image, and a step takes the time of its texels."""

EXACT = 99.0
"""PSNR from which on sets are alike."""

ROUNDING = 1e-3
"""By how much data may exceed 0 and 1."""

FINER = 3
"""Factor of the enlargement; odd, so that the centres of texels stay samples."""

Image = NDArray[np.float32]


class SceneFit(NamedTuple):
    """Result of `fit_for_scene`.

    Attributes
    ----------
    gaussians : Gaussians
        Set of the size of the image, without Gaussians that touch only unseen texels.
    psnr : tuple of float
        PSNR in dB for each camera that sees the texture, in the order of the scene: the view of the
        Gaussians against the view of the image.
    visibility : Visibility
        What the cameras see of the texels of the image.
    tried : list of (int, float)
        Number of Gaussians and lowest PSNR of a camera, for each attempt of the search.
    """

    gaussians: Gaussians
    psnr: tuple[float, ...]
    visibility: Visibility
    tried: list[tuple[int, float]]

    def __repr__(self) -> str:
        g, seen = self.gaussians, ", ".join(f"{psnr:.2f}" for psnr in self.psnr)
        return f"SceneFit({len(g)} Gaussians, {g.width}x{g.height} pixels, psnr=({seen}))"


@shows_progress
@entry_point
def fit_for_scene(
    scene: Any,
    texture: str | Texture | Sequence[str | Texture],
    image: ArrayLike,
    target_psnr: float = 40.0,
    space: str = "linear",
    max_gaussians: int | None = None,
    iterations: int = 400,
    wrap_mode: str | Sequence[str] = "repeat",
    encoding: str | None = None,
    progress: Any = None,
) -> SceneFit:
    """Find the fewest Gaussians with which all cameras of a scene see an image at a given PSNR.

    Parameters
    ----------
    scene : mitsuba.Scene
        Scene with all its cameras, and any bitmap or ``gaussian_texture`` in the place of the
        texture; only its position is used.
    texture : str, mitsuba.Texture, or a sequence of them
        Name of the texture among the parameters of the scene, such as
        ``"poster.bsdf.reflectance"``. Several are uses of the image.
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
        Image for the texture, float in [0, 1] or unsigned integers; row 0 at v = 0.
    target_psnr : float, optional
        Smallest PSNR of any camera in dB, above 0 and below 60. It compares means of the clamped
        texture over pixels, in even light and without noise: as 8-bit sRGB for colours, unchanged
        for data.
    space : {"linear", "radiance", "data"}, optional
        "linear" if the image is a colour, which is decoded to light; "radiance" if it is light that
        may exceed 1, which is compared as it is and divided by its maximum; or "data".
    max_gaussians : int, optional
        Largest number of Gaussians; by default the number of seen texels.
    iterations : int, optional
        Steps of refinement for each number of Gaussians.
    wrap_mode : {"repeat", "mirror", "clamp"}, or a sequence of them, optional
        See `eigengs_dr.scene.visibility.visibility`.
    encoding : {"srgb", "linear"}, optional
        What the pixels are, see `eigengs_dr.fit`.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        A function is called as ``progress(done, total, row)``; the ``stage`` of the row is "rays",
        "target" or "search". A search adds the last row of its trace. The function may raise
        `KeyboardInterrupt` to end the call.

    Returns
    -------
    SceneFit

    Raises
    ------
    ValueError
        If the image or an argument is unusable, the scene has no such texture, no pixel sees it, or
        the largest number of Gaussians does not suffice.
    Interrupted
        After Ctrl-C, SIGTERM, or a `KeyboardInterrupt` of `progress`; its ``result`` is the
        SceneFit of the best set so far, or None before the search.

    Examples
    --------
    A scene whose poster has any texture; `examples/fit_for_scene.py` is a complete example::

        room = mi.load_file("room.xml")
        result = eg.fit_for_scene(room, "poster.bsdf.reflectance", eg.load_image("poster.jpg"))
        poster = texture_of(result.gaussians)
    """
    check_scene("fit_for_scene", scene)
    if space not in COLORS:
        raise ValueError(f"space {space!r} is unknown; textures hold {' or '.join(COLORS)}")
    check_encoding(encoding)
    check_asked(target_psnr, iterations)
    goal = Goal(target_psnr, max_gaussians=max_gaussians)
    with stages(progress) as tell:
        try:
            tell(0, 1, {"stage": "rays"})
            seen = seen_image(scene, texture, image, space_of(space), wrap_mode, encoding)
            return fit_seen(seen, goal, iterations, tell)
        except Interrupted:
            raise
        except KeyboardInterrupt:
            raise Interrupted(None, "fit_for_scene was interrupted before its search") from None


def check_asked(target_psnr: float, iterations: int) -> None:
    """Raise ValueError if a PSNR or a number of steps is out of range."""
    if not 0 < target_psnr < 60:  # from 59 dB on, 8-bit values have no error
        raise ValueError(f"target_psnr is {target_psnr:g}; it must be above 0 and below 60 dB")
    if iterations < 0:
        raise ValueError(f"iterations is {iterations}; it must be at least 0")


@dataclass(frozen=True)
class SeenImage:
    """An image as the cameras of a scene see it.

    Attributes
    ----------
    space : Space
        That of the image and of its Gaussians.
    peak : float
        Largest light, at least 1, by which the texels were divided.
    native : Visibility
        Of the texels of the image.
    texels : ndarray of float32, shape (H, W, C)
        The seen part of the image, enlarged or halved, see `ENOUGH`.
    fine : Visibility
        Of these texels.
    corner : (int, int)
        First column and row of these texels in the whole image.
    size : (int, int)
        Width and height of the whole image in these texels.
    """

    space: Space
    peak: float
    native: Visibility
    texels: Image
    fine: Visibility
    corner: tuple[int, int]
    size: tuple[int, int]

    @property
    def kind(self) -> Space:
        """The space of the texels and of the fit."""
        return LINEAR if self.space.is_light else DATA

    @cached_property
    def views(self) -> list[NDArray[np.floating]]:
        """What each camera sees of the image."""
        return self._seen(self.texels)

    @cached_property
    def away(self) -> NDArray[np.floating]:
        """The distance of each texel from the nearest seen one."""
        return np.asarray(distance_transform_edt(~self.fine.seen))

    def _seen(self, candidate: Image) -> list[NDArray[np.floating]]:
        rows_of_cameras = self.fine.pixel_to_texel
        return [seen_by(candidate, rows, self.kind, self.peak) for rows in rows_of_cameras]

    def psnr(self, candidate: Image) -> tuple[float, ...]:
        """Return the PSNR in dB with which each camera takes texels for those of the image."""
        compared = "rgb" if self.kind.is_color else "data"
        pairs = zip(self._seen(candidate), self.views, strict=True)
        return tuple(psnr_of(a, b, compared) for a, b in pairs)

    def without_unseen(self, gaussians: Gaussians) -> Gaussians:
        """Scale a set to the texels, and keep what may reach a seen one; at least one Gaussian.

        The longer axes of the Gaussians tell.
        """
        height, width = self.fine.seen.shape
        scaled = gaussians.scaled(width, height)
        arrays = scaled.to_arrays()
        column, row = arrays["mean"].astype(int).clip(0, (width - 1, height - 1)).T
        far = self.away[row, column]
        reach = CUTOFF * max_deviation(*arrays["factor"].T)
        return scaled[np.flatnonzero(far <= np.maximum(reach, far.min()))]

    def whole(self, gaussians: Gaussians) -> Gaussians:
        """Return a set of the texels as one of the image."""
        kept, (width, height) = self.without_unseen(gaussians), self.size
        mean = kept.mean + type(kept.mean)(*self.corner)
        placed = replace(kept, mean=mean, width=width, height=height, space=self.space)
        rows, columns = self.native.seen.shape
        return restored(placed.scaled(columns, rows), [Affine(self.peak)] * placed.channels)


def seen_image(
    scene: mi.Scene,
    texture: str | Texture | Sequence[str | Texture],
    image: ArrayLike,
    space: Space,
    wrap_mode: str | Sequence[str],
    encoding: str | None,
) -> SeenImage:
    """Find out what the cameras of a scene see of an image; for arguments see `fit_for_scene`."""
    checked = displayed(image, space, encoding)
    low, high = float(checked.min()), float(checked.max())
    if not space.is_color and (low < -ROUNDING or high > 1 + ROUNDING):
        raise ValueError(
            f"image: data from {low:g} to {high:g}; cameras compare data from 0 to 1: scale it"
        )
    pixels = checked.clip(0, space.largest)
    height, width = pixels.shape[:2]
    values = space.values_of(pixels)
    peak = 1.0 if space.bounded else max(1.0, float(values.max()))
    values = values / np.float32(peak)
    native = visibility(scene, texture, width, height, wrap_mode)
    texels, box = float(native.footprint.min() / PIXEL), Box(0, 0, width, height)
    if texels < ENOUGH:  # enlarged where it is seen: 8k texels would become 7 GB
        box = _seen_box(native.seen, margin=1)
        values = zoom(box.of(values), (FINER, FINER, 1), order=1, mode="nearest", grid_mode=True)
        size = FINER * width, FINER * height
        box = Box(*(FINER * side for side in box))
    else:
        values = halved(values, native)
        size = values.shape[1], values.shape[0]
        box = Box(0, 0, *size)
    fine = native if size == (width, height) else visibility(scene, texture, *size, wrap_mode, box)
    values, fine, corner = _crop_to_seen(values, fine)
    place = box.left + corner.left, box.top + corner.top
    return SeenImage(space, peak, native, values, fine, place, size)


def fit_seen(
    image: SeenImage,
    goal: Goal,
    iterations: int,
    tell: Progress,
) -> SceneFit:
    """Find the fewest Gaussians with which the cameras see an image; see `fit_for_scene`."""

    def closeness(candidate: Image) -> float:
        tell(0, 1, {"stage": "target"})
        return min(image.psnr(candidate))

    target = smoothest_target(image.texels, image.fine, closeness, goal.psnr)
    weight = error_weights(image.fine, target, image.kind)
    native = image.native
    max_gaussians = min(goal.max_gaussians or int(native.seen.sum()), image.fine.seen.size)
    looks = np.minimum(PIXEL / native.footprint[native.seen], 1) ** 2  # pixels per texel, at most 1
    most = min(max(1, int(looks.sum()) // PIXELS), max_gaussians)

    def score(gaussians: Gaussians) -> list[Measured]:
        psnr = image.psnr(render(image.without_unseen(gaussians)).numpy())
        margin = min(*psnr, EXACT) - goal.psnr  # an even image may have no error
        return [Measured({"psnr": min(psnr), "psnr_of_cameras": psnr}, margin)]

    for count in (-(-most // fewer) for fewer in FEWER):
        objective = _objective(target, weight, image.fine.seen, count, image.kind)
        start = DEFAULT.place_and_solve(objective, count)
        [first] = score(start)
        if first.margin >= -GAIN:
            break
    descent = Descent(
        Objective(objective),
        DEFAULT,
        score,
        progress=lambda step, steps, row: tell(step, steps, row | {"stage": "search"}),
    )
    search = search_count(descent, start, max_gaussians, iterations)
    reached = search.row["psnr"]
    if search.stopped == "out of reach" and reached < goal.psnr:
        raise ValueError(
            f"{len(search.gaussians)} Gaussians reach {reached:.1f} dB, but the cameras shall see "
            f"{goal.psnr:g} dB; lower the PSNR, or allow more Gaussians or iterations"
        )
    tried = [(row["gaussians"], row["psnr"]) for row in search.trace]
    cameras = search.row["psnr_of_cameras"]
    found = SceneFit(image.whole(search.gaussians), cameras, native, tried)
    if search.stopped == "interrupted":
        raise Interrupted(found, "the search was interrupted; .result holds the best set so far")
    return found


def _objective(
    target: Image, weight: Image, seen: NDArray[np.bool_], count: int, space: Space
) -> Pixels:
    """Return the objective of a fit, at `DETAIL` texels per Gaussian; cameras judge all texels."""
    times = 2 ** max(0, int(math.log2(max(1.0, seen.sum() / (DETAIL * count))) / 2))
    target, weight = shrunk(target, times), shrunk(weight, times)
    types = types_in(select(backend_of(mi.variant())))
    return Pixels.of(target, space, types, weight, space.placement_image(target))


def halved(values: Image, view: Visibility) -> Image:
    """Halve an image while pixels are at least `ENOUGH` texels large."""
    texels = max(float(view.footprint.min() / PIXEL), ENOUGH)
    return shrunk(values, 2 ** int(np.log2(texels / ENOUGH)))


def shrunk(values: Image, times: int) -> Image:
    """Return means over blocks of so many texels along both sides."""
    if times == 1:
        return values
    small = tuple(-(-side // times) for side in values.shape[:2])
    return resize_local_mean(values, small, channel_axis=2)


def _seen_box(seen: NDArray[np.bool_], margin: int = 0) -> Box:
    """Return the bounding box of the seen texels, wider by a margin inside of the image."""
    spans = []
    for axis, side in ((0, seen.shape[1]), (1, seen.shape[0])):
        kept = np.flatnonzero(seen.any(axis=axis))
        spans.append((max(0, int(kept[0]) - margin), min(side, int(kept[-1]) + 1 + margin)))
    (left, right), (top, bottom) = spans
    return Box(left, top, right - left, bottom - top)


def _crop_to_seen(values: Image, view: Visibility) -> tuple[Image, Visibility, Box]:
    """Crop to the bounding box of the seen texels; also return it."""
    box = _seen_box(view.seen)
    texels = box.of(np.arange(view.seen.size).reshape(view.seen.shape)).ravel()
    lookups = [rows[:, texels] for rows in view.pixel_to_texel]
    cut = Visibility(box.of(view.footprint), lookups)
    return np.ascontiguousarray(box.of(values)), cut, box
