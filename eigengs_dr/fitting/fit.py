"""The function `fit`: from an image, or several maps, to Gaussians."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.arguments import takes_numbers
from ..backend.interrupts import defer_interrupts
from ..backend.notebook import to_html
from ..backend.progress import shows_progress
from ..backend.recording import exclusive
from ..gaussian.channels import channel_weights
from ..gaussian.file import CUTOFF, FitFigures, write
from ..gaussian.gaussians import Gaussians, scale_channels
from ..image.metrics import float_space, target_key
from ..raster.render import picture_of
from .levels import refine_levels
from .maps import MapImage, balance, combine, read_maps, score_maps, shape_of
from .measure import Row, measure
from .options import FitOptions, Levels, Start, named_options
from .refine import FitProgress, Refinement, Score, refine
from .search import search_count
from .start import load_start, mean_picture, start_for
from .target import FitTarget, PixelsOrPath, in_unit, make_target, read_pixels, unit_of


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of `fit`.

    Attributes
    ----------
    gaussians : Gaussians
        The fitted set.
    trace : list of dict
        Rows with the keys iteration, seconds, psnr_ycbcr and psnr_rgb. A search for the number of
        Gaussians adds the key gaussians. Maps add the key maps, with both PSNR of each, and with
        goals the key margin: the decibels above its goal of the map that is farthest from it. Row 0
        shows the set before refinement. Seconds count from the call of `fit`; they include
        placement, upload, the colour solve and the measurements.
        A descent has more Gaussians than asked for in its first two thirds, see
        `eigengs_dr.fitting.schedule.surplus_for`; those sets have no rows.
        With space "data" or "normal", psnr_rgb is the PSNR of the data after clamping and rounding
        to 8 bits, and psnr_ycbcr the PSNR of the unchanged data; for values above 1.5, the largest
        of them is the peak. With space "radiance" or "log", psnr_ycbcr is in PU21, see
        `eigengs_dr.psnr`.
    image : ndarray of float32, shape (H, W, 3), or (H, W, 1) for data of one channel; or dict
        The rendering of the set: RGB without clamping; for light, sRGB clamped at 0; or the data.
        For maps, the rendering of each by its name.
    seconds, seconds_init : float
        The whole time, and the time before refinement.
    iterations : int
        Number of refinement steps.
    stopped : str
        Why the fit ended: "iterations", "exact" or "interrupted"; a search for the number of
        Gaussians ends with "met", "out of reach" or "interrupted".
    mean_image : ndarray of float32, shape (H, W, 3), or None
        RGB image to add to renderings of the set. The preset "eigengs" keeps the mean image of the
        model as pixels. The attribute `image` includes the mean image.
    psnr_ycbcr, psnr_rgb : float
        PSNR of the set in dB, from its row of the trace; for maps, the means over the maps.
    source : str
        Name of the image, if it was a file or a URL.
    maps : dict of str to dict
        For maps, psnr_ycbcr and psnr_rgb of each, from the same row.
    """

    gaussians: Gaussians
    trace: list[Row] = field(repr=False)
    image: Any = field(repr=False)
    seconds: float
    seconds_init: float = field(repr=False)
    iterations: int
    stopped: str
    mean_image: NDArray[np.float32] | None = field(default=None, repr=False)
    psnr_ycbcr: float = math.nan
    psnr_rgb: float = math.nan
    source: str = field(default="", repr=False)
    maps: dict[str, dict[str, float]] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        g, space = self.gaussians, "ycbcr" if self.maps else float_space(self.gaussians.space)
        maps = f"maps {', '.join(self.maps)}, " if self.maps else ""
        return (
            f"Fit({len(g)} Gaussians, "
            f"{g.width}x{g.height} pixels, {maps}{self.iterations} iterations, "
            f"psnr_{space}={self.psnr_ycbcr:.2f}, psnr_rgb={self.psnr_rgb:.2f}, "
            f"seconds={self.seconds:.2f}, stopped={self.stopped!r})"
        )

    _repr_html_ = to_html  # what a notebook shows

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set with its PSNR, steps and source; see `eigengs_dr.Gaussians.save`."""
        figures = FitFigures(self.psnr_ycbcr, self.psnr_rgb, self.iterations, self.source)
        write(path, self.gaussians.data(), figures)


class FitInterrupted(KeyboardInterrupt):
    """The error of a fit that Ctrl-C or SIGTERM interrupted.

    Attributes
    ----------
    result : Fit
        The best set so far.
    """

    def __init__(self, result: Fit) -> None:
        super().__init__("the fit was interrupted; .result holds the best set so far")
        self.result = result


@named_options
@shows_progress
@takes_numbers
def fit(
    image: ArrayLike | os.PathLike[str] | Mapping[str, ArrayLike],
    gaussians: int | None = None,
    iterations: int = 1000,
    init: str = "auto",
    start: Start | None = None,
    preset: str = "default",
    solve_steps: int = 10,
    space: str | Mapping[str, str] | None = None,
    seed: int = 0,
    backend: str | None = None,
    progress: Any = None,
    target_psnr: float | Mapping[str, float] | None = None,
    target_space: str = "rgb",
    max_gaussians: int | None = None,
    levels: Levels | None = None,
    weights: Mapping[str, float] | None = None,
    cutoff: float = CUTOFF,
    encoding: str | None = None,
) -> Fit:
    """Fit an image by a given number of Gaussians, or by as few as a target PSNR needs.

    Several maps of one size, such as those of a material, share the means and shapes of one set:
    ``result.gaussians["albedo"]`` is the set of one map.

    Parameters
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W); or path-like or URL; or a mapping
        A file, see `eigengs_dr.load_image`, or pixels, see `eigengs_dr.image.io.check_image`. A
        mapping holds the images of maps by name, with at most 16 channels together. Data whose
        three channels are equal count as one channel.
    gaussians : int, optional
        Number of Gaussians, at most one per pixel. By default 5000, or one per pixel for smaller
        images; with a start, the number of its Gaussians.
    iterations : int, optional
        Largest number of refinement steps; 0 keeps the colours of the solve.
    init : {"auto", "adaptive", "grid", "random"}, optional
        Placement by the image alone. "auto" is that of the preset: "adaptive" for "default".
    start : Gaussians, Fit, path-like or EigenGS, optional
        Instead of a placement, Gaussians to start from, scaled to the size of the image: the set of
        the frame before of a film, a file, ``model.encode(image)``. A model stands for the set that
        it makes of the image, which suits many images.
    preset : {"default", "gaussianimage", "eigengs"}, optional
        The method, see `eigengs_dr.fitting.options`; "eigengs" needs a model as the start.
    solve_steps : int, optional
        Steps of conjugate gradients in the colour solve. With a start they go on from its colours;
        those of a model need none, unless the image and the model differ in size.
    space : {"ycbcr", "rgb", "linear", "radiance", "log", "normal", "data"}, or mapping; optional
        Space of the colours and of the squared error, by default "ycbcr". For maps, the space of a
        map by its name; by default "linear" for albedo, color and the like, "normal" for normals,
        and "data" for other names, see `eigengs_dr.gaussian.channels.usual_space`.
        "linear" decodes sRGB: the Gaussians sum to linear light, as textures need it, and errors
        weigh more in the dark. "data" uses one or three channels unchanged (roughness, heights).
        "normal" uses the codes ``(n + 1) / 2`` of a normal map; renderings have normals of length
        1. "radiance" is "linear" without an upper bound. "log" suits light above 1 best: the
        Gaussians sum to logarithms of light, see `eigengs_dr.image.color.to_log`. For an image of
        light above 1, "linear" becomes "radiance", and "ycbcr" and "rgb" become "log": a texture
        would clamp their sums.
    seed : int, optional
        Seed of the random numbers. Only the placement "random" and presets without a colour
        solve use random numbers; the preset "default" gives one result for all seeds.
    backend : {"llvm", "cuda"}, optional
        By default "cuda" if there is a GPU.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        Called every 10 steps as ``progress(iteration, iterations, row)`` with the last row of the
        trace, or a row of a set with more Gaussians than asked for.
    target_psnr : float or mapping, optional
        PSNR in dB to reach with as few Gaussians as possible; excludes `gaussians`. Each map shall
        reach it, or its own, if a mapping names every map. The search takes up to about twice
        `iterations` steps, see `eigengs_dr.fitting.search`.
    target_space : {"rgb", "ycbcr"}, optional
        Whether `target_psnr` is a psnr_rgb or a psnr_ycbcr of an image. Data, normals and light
        above 1 have one PSNR alone, see `eigengs_dr.image.metrics.float_space`.
    max_gaussians : int, optional
        Largest number of Gaussians for `target_psnr`. By default the Gaussians have at most as
        many parameters as the image has numbers: 3 Gaussians for 8 pixels in colour.
    levels : int or sequence of int, optional
        Levels of detail: the first Gaussians form the image too. Either the number of Gaussians up
        to each level, such as ``[5000, 7000, 9000]``; or the number of levels, of which each has 4
        times as many Gaussians as the one before, see `level_counts`. ``result.gaussians[:n]`` is a
        level. Inside a level, Gaussians with a larger removal cost come first, so that every prefix
        forms an image.
    weights : mapping of str to float, optional
        For maps, factors of their errors, by default 1. They multiply the weights that the function
        finds: one over the root mean square error after a first colour solve, so that all maps gain
        alike in decibels; or with `target_psnr`, one over the error of the goal.
    cutoff : float, optional
        Radius of a Gaussian in standard deviations, in (0, 12]; the set keeps it.
    encoding : {"srgb", "linear"}, optional
        What the pixels of the image are: sRGB codes, or light as in renderings. By default what the
        image says (a file of floats holds light, a ``mitsuba.Bitmap`` has a flag), else "srgb".
        Data are used as they are.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If the image is unusable or an argument is out of range; if maps differ in size, or an
        argument names a map that is not there.
    BackendError
        If the backend is not available.
    FitInterrupted
        After Ctrl-C or SIGTERM: a `KeyboardInterrupt` that holds the best set so far.

    Notes
    -----
    On one machine and backend, one seed gives the same result bit for bit.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> result = eg.fit(eg.sample("coffee")[:64, :64], gaussians=300, iterations=20)
    >>> len(result.gaussians), result.image.shape
    (300, (64, 64, 3))
    >>> photo = eg.sample("coffee")[:32, :32]
    >>> result = eg.fit({"albedo": photo, "roughness": photo[..., 0]}, 100, iterations=10)
    >>> result.gaussians
    Gaussians(100, 32x32 pixels, maps albedo, roughness, cutoff=3)
    """
    started = time.perf_counter()
    maps: list[MapImage] = []
    if isinstance(image, Mapping):
        maps = _maps_alone(image, space, start, preset, encoding, weights, target_psnr)
        space, target_psnr = "data", max((m.goal for m in maps if m.goal is not None), default=None)
    elif weights is not None or isinstance(space, Mapping) or isinstance(target_psnr, Mapping):
        raise ValueError("weights, and a space or target_psnr by name, are for a mapping of images")
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        init=init,
        start=start,
        preset=preset,
        solve_steps=solve_steps,
        space=space or "ycbcr",
        seed=seed,
        backend=backend,
        cutoff=cutoff,
        target_psnr=target_psnr,
        target_space=target_space,
        max_gaussians=max_gaussians,
        levels=levels,
        encoding=encoding,
    )
    if maps:
        return fit_maps(maps, options, started, progress)
    source = os.path.basename(image) if isinstance(image, (str, os.PathLike)) else ""
    try:
        return replace(fit_image(image, options, progress), source=source)
    except FitInterrupted as stop:
        raise FitInterrupted(replace(stop.result, source=source)) from None


def _maps_alone(
    images: Mapping[str, ArrayLike],
    space: str | Mapping[str, str] | None,
    start: Start | None,
    preset: str,
    encoding: str | None,
    weights: Mapping[str, float] | None,
    target_psnr: float | Mapping[str, float] | None,
) -> list[MapImage]:
    """Read maps; refuse what they do not take."""
    if start is not None or preset != "default":
        raise ValueError("maps need preset 'default' and no start; leave them out")
    if isinstance(space, str):
        raise ValueError(f"space is {space!r}; for maps give the space of each by its name")
    return read_maps(images, space, encoding, weights, target_psnr)


@exclusive()
def fit_image(image: PixelsOrPath, options: FitOptions, progress: FitProgress | None = None) -> Fit:
    """Fit an image with the options of one record; see `fit` for results and errors."""
    started = time.perf_counter()
    pixels, options = read_pixels(image, options)
    options.check_image(pixels)
    unit = unit_of(pixels, options.space)
    if unit != 1:
        pixels = pixels / np.float32(unit)
    if options.start is not None:
        start = load_start(options.start, options.backend)
        whole = in_unit(start, 1 / unit) if isinstance(start, Gaussians) else start
        options = replace(options, start=whole)
    mean_image = mean_picture(options, pixels.shape[1], pixels.shape[0])
    score = partial(measure, image=pixels, started=started, base_image=mean_image)
    goal = target_key(options.space, options.target_space), options.target_psnr or 0.0
    with defer_interrupts() as interrupted:
        target = make_target(pixels, options.space)
        found, seconds_init = _refine(target, options, score, goal, started, progress, interrupted)
    return finish(found, in_unit(found.gaussians, unit), mean_image, started, seconds_init)


@exclusive()
def fit_maps(
    images: list[MapImage],
    options: FitOptions,
    started: float,
    progress: FitProgress | None = None,
) -> Fit:
    """Fit maps from `read_maps` by one set; see `fit` for results and errors."""
    options.check_image(shape_of(images))
    with defer_interrupts() as interrupted:
        weights = balance(images, options)
        score = partial(
            score_maps,
            images=images,
            weights=weights,
            started=started,
            space=options.target_space,
        )
        target, goal = combine(images, weights), ("margin", 0.0)
        found, seconds_init = _refine(target, options, score, goal, started, progress, interrupted)
    maps = tuple(image.map(weight) for image, weight in zip(images, weights, strict=True))
    whole = scale_channels(found.gaussians, [1 / w for w in channel_weights(maps)])
    return finish(found, replace(whole, maps=maps), None, started, seconds_init)


def _refine(
    target: FitTarget,
    options: FitOptions,
    score: Score,
    goal: tuple[str, float],
    started: float,
    progress: FitProgress | None,
    interrupted: Callable[[], bool],
) -> tuple[Refinement, float]:
    """Fit a target as the options say: in levels, by a given number, or by the fewest for a goal.

    `goal` is a key of the rows of `score` and the least value in dB. Return the seconds before
    refinement too.
    """
    if options.levels is not None:
        return refine_levels(target, options, score, started, progress, interrupted)
    schedule, iterations = options.method.schedule, options.iterations
    problem = start_for(target, options.first_try(target.values))
    seconds_init = time.perf_counter() - started
    if options.target_psnr is None:
        found = refine(
            problem,
            target.pixels,
            schedule,
            iterations,
            progress=progress,
            interrupted=interrupted,
            score=score,
        )
    else:
        most = options.most_for(target.values)
        found = search_count(
            problem, score, *goal, most, schedule, iterations, progress, interrupted
        )
    return found, seconds_init


def finish(
    found: Refinement,
    gaussians: Gaussians,
    base_image: NDArray[np.float32] | None,
    started: float,
    seconds_init: float,
) -> Fit:
    """Render the result of a refinement and return it as a `Fit`.

    Raises
    ------
    FitInterrupted
        If the refinement was interrupted.
    """
    rendered = picture_of(gaussians)
    result = Fit(
        gaussians=gaussians,
        trace=found.trace,
        image=rendered if base_image is None else rendered + base_image,
        seconds=time.perf_counter() - started,
        seconds_init=seconds_init,
        iterations=found.iterations,
        stopped=found.stopped,
        mean_image=base_image,
        psnr_ycbcr=found.row["psnr_ycbcr"],
        psnr_rgb=found.row["psnr_rgb"],
        maps=found.row.get("maps", {}),
    )
    if found.stopped == "interrupted":
        raise FitInterrupted(result)
    return result
