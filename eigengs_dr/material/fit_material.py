"""The function `fit_material`, which fits all maps of a material by one set of shapes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.feedback import defer_interrupts, shows_progress, to_html
from ..backend.recording import exclusive
from ..fitting.fit import FitInterrupted
from ..fitting.levels import check_options, refine_levels
from ..fitting.options import FitOptions, Levels, named_options
from ..fitting.placement.adaptive import residual
from ..fitting.refine import FitProgress, Refinement, Score, refine
from ..fitting.search import search_count
from ..fitting.start import start_from_placement
from ..fitting.target import FitTarget
from ..gaussian.file import CUTOFF
from .maps import TextureMap
from .material import Material, scale_channels
from .target import MapImage, combine, maps_of, read_maps, score_maps

MIN_MSE = (1 / 255) ** 2 / 12
"""Mean squared error of rounding to 8 bits: maps below it do not get more weight."""


@dataclass(frozen=True, eq=False)
class MaterialFit:
    """Result of `fit_material`.

    Attributes
    ----------
    material : Material
    trace : list of dict
        Rows with the keys iteration, seconds, psnr_ycbcr and psnr_rgb (means over the maps), and
        maps: psnr_ycbcr and psnr_rgb of each map by its name. For the figures of one map see
        `eigengs_dr.Fit`. A search adds gaussians, and spare: the decibels above its goal of the map
        that is farthest from it.
    images : dict of str to ndarray of float32, shape (H, W, C)
        The rendering of each map, as `eigengs_dr.picture_of` shows it.
    seconds, seconds_init : float
        The whole time, and the time before refinement.
    iterations : int
        Number of refinement steps.
    stopped : str
        As for `eigengs_dr.Fit`.
    psnr_ycbcr, psnr_rgb : float
        Means over the maps in dB, from the row of the trace that measures the set.
    maps : dict of str to dict
        psnr_ycbcr and psnr_rgb of each map, from the same row.
    """

    material: Material
    trace: list[dict[str, Any]] = field(repr=False)
    images: dict[str, NDArray[np.float32]] = field(repr=False)
    seconds: float
    seconds_init: float = field(repr=False)
    iterations: int
    stopped: str
    psnr_ycbcr: float
    psnr_rgb: float
    maps: dict[str, dict[str, float]] = field(repr=False)

    _repr_html_ = to_html  # what a notebook shows

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the material; see `eigengs_dr.Material.save`."""
        self.material.save(path)


@named_options
@shows_progress
@exclusive()
def fit_material(
    images: Mapping[str, ArrayLike],
    gaussians: int | None = None,
    iterations: int = 1000,
    space: Mapping[str, str] | None = None,
    weights: Mapping[str, float] | None = None,
    target_psnr: float | Mapping[str, float] | None = None,
    target_space: str = "rgb",
    max_gaussians: int | None = None,
    levels: Levels | None = None,
    backend: str | None = None,
    progress: Any = None,
    cutoff: float = CUTOFF,
    encoding: str | None = None,
) -> MaterialFit:
    """Fit the maps of a material by Gaussians that share means and shapes.

    Parameters
    ----------
    images : mapping of str to array_like, shape (H, W, 3), (H, W, 1) or (H, W); or path-like or URL
        Images of one size by name, with at most 16 channels together. Data whose three channels are
        equal count as one channel.
    gaussians : int, optional
        Number of Gaussians, at most one per pixel. By default 5000.
    iterations : int, optional
        Largest number of refinement steps.
    space : mapping of str to str, optional
        Space of a map, see the colours of `eigengs_dr.fit`. By default "linear" for albedo, color
        and the like, "normal" for normals, and "data" for other names, see
        `eigengs_dr.material.maps.usual_space`.
    weights : mapping of str to float, optional
        Factors of the errors of maps, by default 1. They multiply the weights that the function
        finds: one over the root mean square error after a first colour solve, so that all maps gain
        alike in decibels; or with `target_psnr`, one over the error of the goal.
    target_psnr : float or mapping of str to float, optional
        PSNR in dB that each map shall reach, with as few Gaussians as possible; a mapping names
        every map. Excludes `gaussians`.
    target_space : {"rgb", "ycbcr"}, optional
        Whether `target_psnr` of a colour is a psnr_rgb or a psnr_ycbcr. Data and normals have one
        PSNR alone, see `eigengs_dr.image.metrics.float_space`.
    max_gaussians : int, optional
        Largest number of Gaussians for `target_psnr`; by default as many as have as many parameters
        as the maps have numbers.
    levels : int or sequence of int, optional
        Levels of detail, see `eigengs_dr.fit_levels`.
    backend : {"llvm", "cuda"}, optional
        By default "cuda" if there is a GPU.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        See `eigengs_dr.fit`.
    cutoff : float, optional
        Radius of a Gaussian in standard deviations, in (0, 12].
    encoding : {"srgb", "linear"}, optional
        What the pixels of colours are, see `eigengs_dr.fit`.

    Returns
    -------
    MaterialFit

    Raises
    ------
    ValueError
        If an image is unusable, the sizes differ, a name is invalid, or an argument is out of range
        or names a map that is not there.
    BackendError
        If the backend is not available.
    FitInterrupted
        After Ctrl-C or SIGTERM; its `result` is a `MaterialFit`.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> photo = eg.sample("coffee")[:32, :32]
    >>> result = eg.fit_material({"albedo": photo, "roughness": photo[..., 0]}, 100, iterations=10)
    >>> result.material
    Material(100 Gaussians, 32x32 pixels: albedo, roughness)
    """
    started = time.perf_counter()
    maps = read_maps(images, space or {}, encoding)
    goals = _goals(maps, target_psnr)
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        space="data",
        backend=backend,
        cutoff=cutoff,
        target_psnr=None if goals is None else max(goals),
        target_space=target_space,
        max_gaussians=max_gaussians,
    )
    factors = _factors(maps, weights or {})
    if levels is not None:
        options = check_options(options, levels)
    options.check_image(_shape_of(maps))
    with defer_interrupts() as interrupted:
        factors = [f * w for f, w in zip(factors, _balance(maps, goals, options), strict=True)]
        target = combine(maps, factors)
        score = partial(
            score_maps,
            images=maps,
            weights=factors,
            started=started,
            goals=goals,
            space=target_space,
        )
        found, seconds_init = _run(target, options, levels, score, progress, interrupted, started)
    return _finish(found, maps_of(maps, factors), started, seconds_init)


def _run(
    target: FitTarget,
    options: FitOptions,
    levels: Levels | None,
    score: Score,
    progress: FitProgress | None,
    interrupted: Callable[[], bool],
    started: float,
) -> tuple[Refinement, float]:
    """Fit a target in the way that the options say; return seconds before refinement too."""
    if levels is not None:
        return refine_levels(target, options, levels, score, progress, interrupted)
    schedule, iterations = options.method.schedule, options.iterations
    start = start_from_placement(target, options.first_try(target.values))
    seconds_init = time.perf_counter() - started
    if options.target_psnr is None:
        kwargs: dict[str, Any] = {"progress": progress, "interrupted": interrupted}
        refined = refine(start, target.pixels, schedule, iterations, score=score, **kwargs)
        return refined, seconds_init
    most = options.most_for(target.values)
    found = search_count(
        start, score, "spare", 0.0, most, schedule, iterations, progress, interrupted
    )
    return found, seconds_init


def _balance(
    images: Sequence[MapImage], goals: Sequence[float] | None, options: FitOptions
) -> list[float]:
    """Return the weights of the maps, with the geometric mean 1.

    At its goal each map has the same weighted error. Without goals, the sum of the logarithms of
    the errors counts: its derivative weighs squared errors by one over their mean.
    """
    if goals is not None:
        logs = np.array(goals) / 20 * np.log(10)
    else:
        errors = _first_errors(images, options)
        logs = -0.5 * np.log(np.maximum(errors, MIN_MSE))
    weights: list[float] = np.exp(logs - logs.mean()).tolist()
    return weights


def _first_errors(images: Sequence[MapImage], options: FitOptions) -> list[float]:
    """Return the mean squared error of each map after a first colour solve."""
    if len(images) == 1:
        return [1.0]
    target = combine(images, [1.0] * len(images))
    start = start_from_placement(target, options).gaussians
    missed = residual(start, target.values)
    if target.weight is not None:
        missed *= target.weight
    squares = np.square(missed).mean(axis=(0, 1), dtype=np.float64)
    ends = np.cumsum([image.pixels.shape[2] for image in images])
    return [float(part.mean()) for part in np.split(squares, ends[:-1])]


def _goals(
    images: Sequence[MapImage], target: float | Mapping[str, float] | None
) -> list[float] | None:
    """Return the goal of each map in dB; check their names."""
    if target is None:
        return None
    if not isinstance(target, Mapping):
        return [float(target)] * len(images)
    names = [image.name for image in images]
    if sorted(target) != sorted(names):
        raise ValueError(
            f"target_psnr names {', '.join(target)}; give one number, or one for each of "
            f"{', '.join(names)}"
        )
    return [float(target[name]) for name in names]


def _factors(images: Sequence[MapImage], weights: Mapping[str, float]) -> list[float]:
    """Return the factor of the errors of each map; check the names."""
    names = [image.name for image in images]
    for name, weight in weights.items():
        if name not in names:
            raise ValueError(f"weights names {name!r}, which is no map; maps are {names}")
        if not (np.isfinite(weight) and weight > 0):
            raise ValueError(f"weights: {name!r} has {weight}; it must be above 0")
    return [float(weights.get(name, 1.0)) for name in names]


def _shape_of(images: Sequence[MapImage]) -> NDArray[np.float32]:
    """Return an image without memory that has the shape of all maps."""
    channels = sum(image.pixels.shape[2] for image in images)
    return np.broadcast_to(np.float32(0), (*images[0].pixels.shape[:2], channels))


def _finish(
    found: Refinement, maps: tuple[TextureMap, ...], started: float, seconds_init: float
) -> MaterialFit:
    """Return the result in the units of the maps; raise `FitInterrupted` after Ctrl-C."""
    factors = [1 / m.weight for m in maps for _ in range(m.channels)]
    material = Material(scale_channels(found.gaussians, factors), maps)
    result = MaterialFit(
        material=material,
        trace=found.trace,
        images=material.pictures(),
        seconds=time.perf_counter() - started,
        seconds_init=seconds_init,
        iterations=found.iterations,
        stopped=found.stopped,
        **{name: found.row[name] for name in ("psnr_ycbcr", "psnr_rgb", "maps")},
    )
    if found.stopped == "interrupted":
        raise FitInterrupted(result)
    return result
