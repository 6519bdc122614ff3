"""The function `fit`: from an image, or several maps, to Gaussians."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.doors import door
from ..backend.interrupts import defer_interrupts
from ..backend.notebook import to_html
from ..backend.progress import shows_progress
from ..gaussian.channels import channel_weights
from ..gaussian.file import FitFigures, write
from ..gaussian.gaussians import Gaussians, one_image, scale_channels
from ..image.pixels import check_weight
from ..image.space import DATA, YCBCR, space_of
from ..raster.render import picture_of
from .coarse import COARSE_TO_FINE
from .fewest import fewest
from .from_loss import Problem, Spaces, refine_loss, views_of_spaces
from .levels import place_levels, sort_levels
from .loop import FitProgress, Refinement, Score, refine, sets_of
from .loss import Loss, LossFunction, LossObjective, View
from .maps import Map, MapImage, balance, combine, read_maps, score_maps, views_of
from .measure import Row, psnrs
from .method import DEFAULT, Method
from .objective import Affine, Pixels, data_of, fitted, picture, restored
from .options import FitOptions, Goal, Start, named_options
from .pixels import Image, PixelsOrPath, check_channels, read_pixels
from .place import Adaptive
from .start import check_start, load_start, set_in, start_from, types_for
from .state import begin


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of `fit`.

    Attributes
    ----------
    gaussians : Gaussians
        The fitted set.
    trace : list of dict
        Rows with the keys iteration, gaussians, seconds, psnr_ycbcr and psnr_rgb, of steps 0, 10,
        20, 50, each 100 and the last. Maps add the key maps, with both PSNRs of each, and with
        goals the key margin: the decibels of the worst map above its goal. Row 0
        shows the set before refinement. Seconds count from the call of `fit`; they include
        placement, upload, the colour solve and the measurements.
        A descent may have more Gaussians than requested until two thirds of its steps are taken,
        see `eigengs_dr.fitting.control.Surplus`; the key gaussians says so, and such a set is never
        the result. With a weight, the squared errors of all PSNRs are weighted, by the mean over
        the channels.
        With a loss the key is loss, see `eigengs_dr.Loss.judge`; with an image there are PSNRs
        too. Without an image the first row shows the picture of the texels, without the key
        gaussians; rows with the same iteration follow for the numbers that were tried.
        With space "data", psnr_ycbcr is the PSNR of the data, with their range as the peak, or 1
        for codes between 0 and 1; psnr_rgb is that of codes after rounding to 8 bits, and NaN for
        other data, which have none. With space "normal" both have the peak 1. With space "radiance"
        or "log", psnr_ycbcr is in PU21, see `eigengs_dr.psnr`.
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
        RGB image to add to renderings of the set. The method of the paper EigenGS keeps the mean
        image of the model as pixels. The attribute `image` includes the mean image.
    psnr_ycbcr, psnr_rgb : float
        PSNR of the set in dB, from its row of the trace; for maps, the means over the maps; NaN
        without an image.
    loss : float
        The loss of the set, from the same row; NaN without a loss.
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
    loss: float = math.nan
    source: str = field(default="", repr=False)
    maps: dict[str, dict[str, float]] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        g, space = self.gaussians, "ycbcr" if self.maps else self.gaussians.space.figure
        maps = f"maps {', '.join(m.name for m in g.maps)}, " if g.maps else ""
        figures = f"psnr_{space}={self.psnr_ycbcr:.2f}, psnr_rgb={self.psnr_rgb:.2f}, "
        if math.isnan(self.psnr_ycbcr):
            figures = ""
        if not math.isnan(self.loss):
            figures = f"loss={self.loss:.4g}, {figures}"
        return (
            f"Fit({len(g)} Gaussians, "
            f"{g.width}x{g.height} pixels, {maps}{self.iterations} iterations, {figures}"
            f"seconds={self.seconds:.2f}, stopped={self.stopped!r})"
        )

    _repr_html_ = to_html  # what a notebook shows

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set with its PSNR, steps and source; see `eigengs_dr.Gaussians.save`."""
        figures = FitFigures(self.psnr_ycbcr, self.psnr_rgb, self.iterations, self.source)
        write(path, self.gaussians.data(), figures)


class FitInterrupted(KeyboardInterrupt):
    """The error of a fit that Ctrl-C, SIGTERM or a `KeyboardInterrupt` of a loss interrupted.

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
@door
def fit(
    image: ArrayLike | os.PathLike[str] | Mapping[str, ArrayLike | Map] | None = None,
    gaussians: int | Sequence[int] | None = None,
    iterations: int = 1000,
    target_psnr: float | Goal | None = None,
    start: Start | None = None,
    space: str | Mapping[str, str] | None = None,
    weight: ArrayLike | None = None,
    method: Method | None = None,
    seed: int = 0,
    backend: str | None = None,
    progress: Any = None,
    encoding: str | None = None,
    loss: Loss | LossFunction | None = None,
    size: tuple[int, int] | None = None,
) -> Fit:
    """Fit an image, or a loss of your own, with a number of Gaussians or as few as a target needs.

    Several maps of one size, such as those of a material, share the means and shapes of one set:
    ``result.gaussians["albedo"]`` is the set of one map.

    Parameters
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W); or path-like or URL; or a mapping
        A file, see `eigengs_dr.load_image`, or pixels, see `eigengs_dr.image.io.check_image`. A
        mapping holds the images of maps by name, with at most 16 channels together; a `Map` says
        the space, the weight and the goal of one. Data whose three channels are equal count as one
        channel. Without an image, give a loss and the size of its picture.
    gaussians : int or sequence of int, optional
        Number of Gaussians, at most one per pixel. By default 5000, or one per pixel for smaller
        images; with a start, the number of its Gaussians; without an image, one for 16 pixels, or
        as many as the judge of the loss finds best, see `eigengs_dr.Loss`. Several rising numbers
        such as ``[5000, 7000, 9000]`` are levels of detail, see `level_counts`: the first Gaussians
        form the image too, and ``result.gaussians[:n]`` is a level. Inside a level, Gaussians with
        a larger removal cost come first, so that every prefix forms an image.
    iterations : int, optional
        Largest number of refinement steps; 0 keeps the colours of the solve.
    target_psnr : float or Goal, optional
        PSNR in dB to reach with as few Gaussians as possible, instead of their number. Each map
        must reach it, unless it has its own goal. A `Goal` also sets the space of the PSNR and the
        largest number of Gaussians. The search takes up to about twice `iterations` steps, see
        `eigengs_dr.fitting.fewest`.
    start : Gaussians, Fit, path-like or EigenGS, optional
        Instead of a placement, Gaussians to start from, scaled to the size of the image: the set of
        the previous frame of a video, a file, ``model.encode(image)``. A model stands for the set
        that it makes of the image, on shapes that suit many images. The set gets the cutoff of the
        method. Gaussians that fit the image stay, the others are placed anew: all of them where a
        placement would end higher. Those of a model, and without steps, all stay.
    space : {"ycbcr", "rgb", "linear", "radiance", "log", "normal", "data"} or mapping, optional
        Space of the colours and of the squared error, by default that of the start, or "ycbcr".
        "linear" decodes sRGB: the Gaussians sum to linear light, as textures need it, and errors
        weigh more in the dark. "data" uses one to three channels unchanged (roughness, heights).
        "normal" uses the codes ``(n + 1) / 2`` of a normal map; renderings have normals of length
        1. "radiance" is "linear" without an upper bound. "log" suits light above 1 best: the
        Gaussians sum to logarithms of light, see `eigengs_dr.image.color.to_log`. For an image of
        light above 1, "linear" becomes "radiance", and "ycbcr" and "rgb" become "log": a texture
        would clamp their sums. For a loss without an image, a mapping such as ``{"albedo":
        "linear", "roughness": "data"}`` makes maps; data then have one channel.
    weight : array_like, shape (H, W) or (H, W, C), optional
        Factors of the squared errors of pixels, or of their channels in the space of the colours,
        for maps of pixels alone; finite and at least 0. A pixel of weight 0 does not count; it may
        be NaN. Without an image, how much a pixel matters to the loss: it places the Gaussians.
    method : Method, optional
        How to fit, by default `DEFAULT`, or `COARSE_TO_FINE` without an image; `eigengs_dr.paper`
        has those of the papers.
    seed : int, optional
        Seed of all random numbers: of the noise by which means and shapes are perturbed, and of
        where Gaussians are placed. Seeds that are equal modulo 2^32 are equal.
    backend : {"llvm", "cuda"}, optional
        By default "cuda" if there is a GPU.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        A callable is called every 10 steps as ``progress(iteration, iterations, row)`` with the
        last row of the trace, or a row of a set with more Gaussians than requested. It may raise
        `KeyboardInterrupt` to end the fit.
    encoding : {"srgb", "linear"}, optional
        What the pixels of the image are: sRGB codes, or light as in renderings. By default as the
        image declares (a file of floats holds light, a ``mitsuba.Bitmap`` has a flag), else "srgb".
        Data are used as they are.
    loss : callable or Loss, optional
        What to minimise instead of the squared error: ``loss(picture, step) -> number``, any
        function of the rendered picture (or the dict of maps) that Dr.Jit differentiates. With an
        image, the image places the Gaussians and gives PSNRs.
    size : (int, int), optional
        Width and height of the picture of a loss without an image, in pixels.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If the image is unusable or an argument is out of range; if maps differ in size, or
        arguments contradict each other.
    BackendError
        If the backend is not available.
    FitInterrupted
        After Ctrl-C, SIGTERM, or a `KeyboardInterrupt` of the loss, its judge or `progress`: a
        `KeyboardInterrupt` that holds the best set so far.

    Notes
    -----
    On one machine and backend, equal seeds give bit-identical results, unless the derivative of a
    loss has other bits at each call: with several threads, Dr.Jit adds in any order those of values
    that the loss broadcasts, as in ``color * alpha`` of one channel, and those of texels that the
    samples of a rendering share, as in `eigengs_dr.plugins.photo_loss`.

    The factors of the errors of maps that the function finds are one over the root mean square
    error after a first colour solve, so that all maps gain alike in decibels; or with goals, one
    over the error of the goal. The weights of maps multiply them.

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
    spaces, space = space, None if isinstance(space, Mapping) else space
    if image is None:
        _check_loss(loss, size, target_psnr, gaussians)
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        target_psnr=target_psnr,
        start=start,
        space=None if space is None else space_of(space),
        method=method or (COARSE_TO_FINE if image is None else DEFAULT),
        seed=seed,
        backend=backend,
        encoding=encoding,
        loss=loss if loss is None or isinstance(loss, Loss) else Loss(loss),
    )
    factors = check_weight(weight)
    if image is None:
        return fit_loss(size, spaces, options, factors, started, progress)
    if size is not None:
        raise ValueError("size is for a loss without an image; leave it or the image out")
    if isinstance(image, Mapping):
        if start is not None or spaces is not None:
            raise ValueError(
                "maps take no start and no space; a Map says the space of one: "
                "Map(image, space='data')"
            )
        maps = read_maps(image, options.goal, factors, encoding)
        if options.goal is None and maps[0].goal is not None:
            if gaussians is not None:
                raise ValueError("gaussians and goals of maps exclude each other; give one of them")
            options = replace(options, target_psnr=maps[0].goal)
        return fit_maps(maps, options, factors, started, progress)
    source = os.path.basename(image) if isinstance(image, (str, os.PathLike)) else ""
    try:
        [result] = fit_images([image], options, factors, progress)
    except FitInterrupted as stop:
        raise FitInterrupted(replace(stop.result, source=source)) from None
    return replace(result, source=source)


def fit_images(
    images: Sequence[PixelsOrPath],
    options: FitOptions,
    weight: Image | None = None,
    progress: FitProgress | None = None,
) -> list[Fit]:
    """Fit an image, or several of one size together; see `fit` for results and errors.

    On llvm, the results of a batch are bit-identical to single fits: sums run in the same order,
    and no image changes the arithmetic of another. The seconds are an equal share of the whole
    time.
    """
    started, source = time.perf_counter(), options.start
    start = None if source is None else load_start(source, options.backend)
    if isinstance(start, Gaussians):
        one_image(start)
    requested = options.space or (set_in(start).space if start is not None else YCBCR)
    read = [read_pixels(image, requested, weight, options.encoding) for image in images]
    pixels, space = [p for p, _ in read], read[0][1]
    height, width, channels = pixels[0].shape
    options.check_image(width, height, channels)
    check_channels(weight, channels)
    if start is not None:
        check_start(set_in(start), (width, height), channels, space, options)
    types, mean_image = types_for(start, options.backend), None
    with defer_interrupts() as interrupted:
        data = [data_of(p, space, weight) for p in pixels]
        display = picture(types, space, pixels, data, weight)
        objective = replace(Pixels.of(data, space, types), pictures=(display,))
        begun, chosen = None, False
        if start is not None:
            if isinstance(start, Gaussians):
                start = fitted(start, data[0].affine)
            objective, begun, chosen = start_from(
                start, objective, options.method, pixels[0], options.iterations, options.seed
            )
            base = objective.pictures[0].base
            if base is not None:
                mean_image = objective.picture(base).numpy()
        if options.loss is not None:
            view = View("", space, range(channels), *data[0].affine)
            objective = LossObjective.of_loss(options.loss, [view], objective)

        def score(gaussians: Gaussians) -> list[Row]:
            seconds = (time.perf_counter() - started) / len(images)
            [figures] = psnrs(gaussians, objective.pictures).transpose(0, 2, 1)
            return [
                {
                    "seconds": seconds,
                    **objective.judged(gaussians),
                    "psnr_ycbcr": ycbcr,
                    "psnr_rgb": rgb,
                }
                for ycbcr, rgb in figures.tolist()
            ]

        figure = options.goal.key(space) if options.goal else "margin"
        refinements, seconds_init = _refined(
            objective, options, begun, chosen, score, figure, started, progress, interrupted
        )
    affines = [d.affine for d in data]
    return _finished(refinements, affines, mean_image, started, seconds_init)


def _check_loss(loss: Any, size: Any, target_psnr: Any, gaussians: Any) -> None:
    """Raise ValueError unless there is a loss with a size, and nothing that needs an image."""
    if loss is None or size is None:
        raise ValueError(
            "fit needs an image, or a loss and the size of its picture: "
            "fit(loss=f, size=(width, height))"
        )
    if np.shape(size) != (2,) or np.asarray(size).dtype.kind not in "iu":
        raise ValueError(f"size is {size!r}; give (width, height) in whole pixels")
    if target_psnr is not None or np.ndim(gaussians) > 0:
        raise ValueError(
            "without an image there is no PSNR and there are no levels; give the loss a target"
        )


def fit_loss(
    size: tuple[int, int] | None,
    spaces: Spaces,
    options: FitOptions,
    weight: Image | None,
    started: float,
    progress: FitProgress | None = None,
) -> Fit:
    """Fit a loss without an image; see `fit` for results and errors."""
    assert options.loss is not None and size is not None
    start = None if options.start is None else load_start(options.start, options.backend)
    if start is not None and not isinstance(start, Gaussians):
        raise ValueError("a model needs an image to start from; give a set")
    if start is not None and spaces is None:
        spaces = {m.name: m.space for m in start.maps} or start.space
    spaces = spaces or options.loss.space
    views, maps = views_of_spaces(spaces)
    channels, (width, height) = sum(len(view.channels) for view in views), size
    options.check_image(width, height, channels)
    if weight is not None and weight.shape[:2] != (height, width):
        shape = f"{weight.shape[1]}x{weight.shape[0]}"
        raise ValueError(f"weight is for {shape} pixels, but size is {width}x{height}")
    check_channels(weight, 1 if maps else channels)
    if start is not None:
        space = DATA if maps else views[0].space
        check_start(start, size, channels, space, options)
        cutoff = float(options.method.cutoff)
        start = replace(start.scaled(width, height), cutoff=cutoff, maps=()).bounded()
    with defer_interrupts() as interrupted:
        problem = Problem(options.loss, size, views, types_for(start, options.backend), weight)
        refinement, seconds_init = refine_loss(
            problem, options, start, started, progress, interrupted
        )
    refinement = replace(refinement, gaussians=replace(refinement.gaussians, maps=maps))
    [result] = _finished([refinement], [Affine()], None, started, seconds_init)
    return result


def fit_maps(
    images: list[MapImage],
    options: FitOptions,
    weight: Image | None,
    started: float,
    progress: FitProgress | None = None,
) -> Fit:
    """Fit maps from `read_maps` with one set; see `fit` for results and errors."""
    height, width = images[0].pixels.shape[:2]
    channels, types = sum(i.pixels.shape[2] for i in images), types_for(None, options.backend)
    options.check_image(width, height, channels)
    check_channels(weight, 1)
    goal = options.goal
    with defer_interrupts() as interrupted:
        first = options.count_for(width * height)
        if options.searches:
            first = options.first_try(width * height, channels)
        factors = balance(images, options, first, types, weight)
        objective = combine(images, factors, types, weight)
        if options.loss is not None:
            views = views_of(images, factors)
            objective = LossObjective.of_loss(options.loss, views, objective)

        def score(gaussians: Gaussians) -> list[Row]:
            row = score_maps(gaussians, objective, images, goal)
            seconds = time.perf_counter() - started
            return [{"seconds": seconds, **objective.judged(gaussians), **row}]

        [refinement], seconds_init = _refined(
            objective, options, None, False, score, "margin", started, progress, interrupted
        )
    maps = tuple(image.map(factor) for image, factor in zip(images, factors, strict=True))
    whole = scale_channels(refinement.gaussians, [1 / w for w in channel_weights(maps)])
    offsets = [i.data.affine.offset for i in images for _ in range(i.pixels.shape[2])]
    background = type(whole.background)(
        [row + float(b) for row, b in zip(whole.background, offsets, strict=True)]
    )
    named = replace(whole, background=background, maps=maps)
    [result] = _finished(
        [replace(refinement, gaussians=named)], [Affine()], None, started, seconds_init
    )
    return result


def _refined(
    objective: Pixels,
    options: FitOptions,
    begun: Gaussians | None,
    chosen: bool,
    score: Score,
    figure: str,
    started: float,
    progress: FitProgress | None,
    interrupted: Callable[[], bool],
) -> tuple[list[Refinement], float]:
    """Fit an objective as the options say: with a given number, in levels, or with the fewest.

    `begun` is the set to start from, if there is one, and `chosen` whether it holds Gaussians of
    the user. `figure` is the key in the rows of `score` to which a goal refers. Also return the
    seconds before refinement.
    """
    method, iterations, key = options.method, options.iterations, options.seed
    (width, height), channels = objective.size, objective.channels
    counts = options.levels
    if counts or method.place != Adaptive():  # the choice of a placement is not undone
        method = method.without("grows", "places")
    if counts:
        begun = place_levels(objective, method, counts, iterations, key, interrupted)
        objective = replace(objective, levels=counts[:-1])
    elif begun is None:
        count = options.count_for(width * height)
        if options.searches:
            count = options.first_try(width * height, channels)
        begun = method.place_and_solve(objective, count, key)
    seconds_init = (time.perf_counter() - started) / objective.grid.images
    if options.searches:
        max_count = options.max_count_for(width * height, channels)
        goal = options.goal.psnr if options.goal and figure != "margin" else 0.0
        refinement = fewest(
            objective,
            method,
            begun,
            score,
            (figure, goal),
            max_count,
            iterations,
            key,
            progress,
            interrupted,
        )
        refined = [refinement]
    else:
        state = begin(begun, objective.grid.images, chosen)
        refined = refine(objective, method, state, iterations, score, key, progress, interrupted)
    if isinstance(objective, LossObjective) and refined[0].stopped != "interrupted":
        objective.calls.check_use()
    if counts:
        sets = [sort_levels(one.gaussians, objective, counts) for one in refined]
        refined = [replace(one, gaussians=g) for one, g in zip(refined, sets, strict=True)]
    return refined, seconds_init


def _finished(
    refinements: Sequence[Refinement],
    affines: Sequence[Affine],
    mean_image: NDArray[np.float32] | None,
    started: float,
    seconds_init: float,
) -> list[Fit]:
    """Render the results of refinements in the units of their images.

    Raises
    ------
    FitInterrupted
        If the refinement of a single image was interrupted.
    """
    results = []
    for one, gaussians, affine in zip(refinements, sets_of(refinements), affines, strict=True):
        whole = restored(gaussians, affine)
        rendered = picture_of(whole)
        results.append(
            Fit(
                gaussians=whole,
                trace=one.trace,
                image=rendered if mean_image is None else rendered + mean_image,
                seconds=0.0,
                seconds_init=seconds_init,
                iterations=one.iterations,
                stopped=one.stopped,
                mean_image=mean_image,
                psnr_ycbcr=one.row.get("psnr_ycbcr", math.nan),
                psnr_rgb=one.row.get("psnr_rgb", math.nan),
                loss=one.row.get("loss", math.nan),
                maps=one.row.get("maps", {}),
            )
        )
    seconds = (time.perf_counter() - started) / len(refinements)
    results = [replace(result, seconds=seconds) for result in results]
    if refinements[0].stopped == "interrupted":
        raise FitInterrupted(results[0])
    return results
