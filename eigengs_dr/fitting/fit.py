"""The function `fit`: from an image, or several maps, to Gaussians."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.entry_points import checks_types, entry_point, shows_progress
from ..backend.interrupts import Interrupted, defer_interrupts
from ..backend.types import ArrayLike
from ..gaussian.file import FitFigures, write_set
from ..gaussian.gaussians import Gaussians, notebook_html
from ..image.pixels import check_weight
from ..image.space import space_of
from ..raster.render import picture_of
from .channels import Row
from .coarse import COARSE_TO_FINE
from .exchange import sort_levels
from .from_loss import fit_loss
from .loop import Descent, FitProgress, Refinement, refine, sets_of
from .loss import Loss, LossFunction
from .method import DEFAULT, Method, Model
from .objective import Objective, Pixels
from .options import FitOptions, Goal, Start, named_options
from .place import Adaptive
from .problem import Map, PixelsOrPath, Problem, problem_of, problem_of_images
from .search import search_count
from .start import keep_fitting, place_levels, set_in
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
    kept : int or None
        How many Gaussians of the start were kept, before the first step; the others were placed
        anew. None without a start.
    psnr_ycbcr, psnr_rgb : float
        PSNR of the set in dB, from its row of the trace; for maps, the means over the maps; NaN
        without an image.
    loss : float
        The loss of the set, from the same row; NaN without a loss.
    source : str
        Name of the image, if it was a file.
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
    kept: int | None = field(default=None, repr=False)
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

    _repr_html_ = notebook_html  # what a notebook shows

    @checks_types
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set with its PSNR, steps and source; see `eigengs_dr.Gaussians.save`."""
        figures = FitFigures(self.psnr_ycbcr, self.psnr_rgb, self.iterations, self.source)
        write_set(path, self.gaussians.data(), figures)


@named_options
@shows_progress
@entry_point
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
    levels: int | None = None,
) -> Fit:
    """Fit an image or minimise a loss, with so many Gaussians or the fewest that reach a target.

    Several maps of one size, such as those of a material, share the means and shapes of one set:
    ``result.gaussians["albedo"]`` is the set of one map.

    Parameters
    ----------
    image : array_like, shape (H, W, 3), (H, W, 1) or (H, W); or path-like; or a mapping
        A file, see `eigengs_dr.load_image`, or pixels, see `eigengs_dr.image.io.check_image`. A
        mapping holds the images of maps by name, with at most 16 channels together; a `Map` says
        the space, the weight and the goal of one. Data whose three channels are equal count as one
        channel. Without an image, give a loss and the size of its picture.
    gaussians : int or sequence of int, optional
        Number of Gaussians, at most one per pixel. By default 5000, or one per pixel for smaller
        images; with a start, the number of its Gaussians; without an image, one for 4 pixels.
        Several rising numbers such as ``[5000, 7000, 9000]`` are levels of detail, see
        `level_counts`: the first Gaussians form the image too, and ``result.gaussians[:n]`` is a
        level. Inside a level, Gaussians with a larger removal cost come first, so that every prefix
        forms an image.
    iterations : int, optional
        Largest number of refinement steps; 0 keeps the colours of the solve.
    target_psnr : float or Goal, optional
        PSNR in dB to reach with as few Gaussians as possible, instead of their number. Each map
        must reach it, unless it has its own goal. A `Goal` also sets the space of the PSNR and the
        largest number of Gaussians. The search takes up to about twice `iterations` steps, see
        `eigengs_dr.fitting.search`.
    start : Gaussians, Fit, path-like or EigenGS, optional
        Instead of a placement, Gaussians to start from, scaled to the size of the image: the set of
        the previous frame of a video, a file, ``model.encode(image)``. A model stands for the set
        that it makes of the image, on shapes that suit many images. The set gets the cutoff of the
        method. Gaussians are kept where the image is fitted much better than by a placement; the
        others are placed anew: all of them if the whole is not much better. All Gaussians of a
        model, without steps or without an image, are kept; so are all for a method that places
        none anew, ``eigengs_dr.DEFAULT.without("redistribute")``. ``result.kept`` says how many.
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
        where Gaussians are placed.
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
    levels : int, optional
        Number of levels of detail, each with four times as many Gaussians as the one before.

    Returns
    -------
    Fit

    Raises
    ------
    TypeError
        If an argument has another type.
    ValueError
        If the image is unusable or an argument is out of range; if maps differ in size, or
        arguments contradict each other.
    BackendError
        If the backend is not available.
    Interrupted
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
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        target_psnr=target_psnr,
        start=start,
        space=None if space is None else space_of(space),
        method=(COARSE_TO_FINE if image is None else DEFAULT) if method is None else method,
        seed=seed,
        backend=backend,
        encoding=encoding,
        loss=loss if loss is None or isinstance(loss, Loss) else Loss(loss),
        levels=levels,
    )
    problem = problem_of(image, options, check_weight(weight), size, spaces)
    [result] = fit_problem(problem, started, progress)
    source = os.path.basename(image) if isinstance(image, (str, os.PathLike)) else ""
    return ended(replace(result, source=source))


def ended(result: Fit) -> Fit:
    """Return a result, or raise `Interrupted` with it if it was interrupted."""
    if result.stopped == "interrupted":
        raise Interrupted(result, "the fit was interrupted; .result holds the best set so far")
    return result


def fit_images(images: Sequence[PixelsOrPath], options: FitOptions) -> list[Fit]:
    """Fit an image, or several of one size together; see `fit` for results and errors.

    On llvm, the results of a batch are bit-identical to single fits: sums run in the same order,
    and no image changes the arithmetic of another. The seconds are an equal share of the whole
    time.
    """
    started = time.perf_counter()
    results = fit_problem(problem_of_images(images, options), started)
    return [ended(result) for result in results]


def fit_problem(problem: Problem, started: float, progress: FitProgress | None = None) -> list[Fit]:
    """Fit what the problem asks for; one result for each image of a batch.

    Parameters
    ----------
    problem : Problem
    started : float
        Seconds of `time.perf_counter` at the call.
    progress : callable, optional
        See `fit`.
    """
    mean_image = None
    with defer_interrupts() as interrupted:
        if not problem.channels[0].targets:
            refinement, seconds_init = fit_loss(problem, started, progress, interrupted)
            refinements = [refinement]
            kept = None if problem.start is None else len(set_in(problem.start))
        else:
            problem = problem.balanced(problem.first_count)
            pixels, begun, kept = begin_fit(problem)
            if pixels.pictures[0].base is not None:
                mean_image = pixels.picture(pixels.pictures[0].base).numpy()
            # The score must not refer to the descent that holds it: only the collector would free
            # the arrays of such a circle, and in a frozen function of the user Dr.Jit then hangs.
            objective = Objective(pixels, problem.picture_loss())
            descent = Descent(
                objective,
                problem.options.method,
                lambda g: problem.measure(g, objective, started),
                problem.options.seed,
                progress,
                interrupted,
            )
            refinements, seconds_init = _refined(problem, descent, begun, bool(kept), started)
    return _finished(problem, refinements, mean_image, kept, started, seconds_init)


def begin_fit(problem: Problem) -> tuple[Pixels, Gaussians | None, int | None]:
    """Return the squared error, the set to start from, and how many of the user's it holds.

    Gaussians of a set stay where they fit the image, see `keep_fitting`. All stay without steps, of
    a model, whose shapes the user chose, and for a method that places nothing anew. A method that
    starts from a model may change the squared error.
    """
    start, image, options = problem.start, problem.pixels(), problem.options
    method, iterations = options.method, options.iterations
    if start is None:
        return image, None, None
    if not isinstance(start, Gaussians):
        pixels = problem.channels[0].targets[0].pixels
        image, gaussians = method.start_from_model(image, start, pixels)
        # Steps need means inside of the image.
        return image, gaussians.bounded() if iterations else gaussians, len(gaussians)
    gaussians = problem.fitted(start).scaled(*image.size)
    gaussians = replace(gaussians, cutoff=float(method.cutoff))
    gaussians = method.start_from(image, gaussians.bounded() if iterations else gaussians)
    if not iterations or method.place.has_colors or not method.in_phase("redistribute"):
        return image, gaussians, len(gaussians)
    return image, *keep_fitting(gaussians, image, method, iterations, options.seed)


def _refined(
    problem: Problem, descent: Descent, begun: Gaussians | None, chosen: bool, started: float
) -> tuple[list[Refinement], float]:
    """Fit a given number of Gaussians, levels, or the fewest; and the seconds before refinement."""
    options, counts = problem.options, problem.levels
    objective, method = descent.objective, descent.method
    given = isinstance(problem.start, Model)
    if counts or given or method.place != Adaptive():  # a choice of the user is not undone
        method = method.without("densify", "redistribute")
    if counts:
        begun = place_levels(replace(descent, method=method), counts, options.iterations)
        objective = replace(objective, image=replace(objective.image, levels=counts[:-1]))
    elif begun is None:
        begun = method.place_and_solve(objective.image, problem.first_count, options.seed)
    dr.sync_thread()  # the colour solve runs asynchronously
    seconds_init = (time.perf_counter() - started) / problem.images
    descent = replace(descent, objective=objective, method=method)
    if options.searches:
        refined = [search_count(descent, begun, problem.max_count, options.iterations)]
    else:
        refined = refine(descent, begin(begun, problem.images, chosen), options.iterations)
    if objective.loss is not None and refined[0].stopped != "interrupted":
        objective.loss.calls.check_use()
    if counts:
        sets = [sort_levels(one.gaussians, objective.image, counts) for one in refined]
        refined = [replace(one, gaussians=g) for one, g in zip(refined, sets, strict=True)]
    return refined, seconds_init


def _finished(
    problem: Problem,
    refinements: Sequence[Refinement],
    mean_image: NDArray[np.float32] | None,
    kept: int | None,
    started: float,
    seconds_init: float,
) -> list[Fit]:
    """Render the results of refinements in the units of their images."""
    results = []
    for image, (one, gaussians) in enumerate(zip(refinements, sets_of(refinements), strict=True)):
        whole = problem.restored(gaussians, image)
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
                kept=kept,
                psnr_ycbcr=one.row.get("psnr_ycbcr", math.nan),
                psnr_rgb=one.row.get("psnr_rgb", math.nan),
                loss=one.row.get("loss", math.nan),
                maps=one.row.get("maps", {}),
            )
        )
    seconds = (time.perf_counter() - started) / len(refinements)
    return [replace(result, seconds=seconds) for result in results]
