"""Speed against accuracy: fits that differ from the default one in one setting at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.eigengs import EigenGS
from ..eigenbasis.registry import load_basis
from ..fitting.initializers import FitProblem, initialize
from ..fitting.options import DEFAULT_COUNT
from ..fitting.presets import PRESETS
from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import Gaussians
from ..image.resize import center_crop
from ..image.samples import sample
from ..raster.render import picture_of
from .rows import Job, Row
from .sets import SETS, model_for, test_images
from .trial import Moment, decibels, follow, judged, warm_up

Image = NDArray[np.float32]

SAMPLES, SAMPLE_NAMES, SAMPLE_SIDE = "samples", ("chelsea", "coffee", "astronaut"), 256
"""The set of photos that come with scikit-image, their middle, and its side in pixels."""

HORIZONS = (0, 10, 100, 300, 1000)
"""Steps of runs of a method whose rates fall: each number is a run of its own."""

MARKS = (0, 10, 20, 50, 100, 200, 500, 1000)
"""Steps after which the one run is looked at where rates stay: it stands for all shorter ones."""

DEFAULT_COMPONENTS, COMPONENTS = 300, (50, 100, 500)
"""Components a channel of the models that all fits start from, and of others."""

BITS, FLOATS = (8, 10, 12, 16), ("float16", "float32")
"""How finished sets are stored: each parameter in as many equal steps of its range, or as it is."""

WIDE = 6.0
"""Cutoff that stands for none in single precision: 1.5e-8 of an amplitude is left."""


class Collection(NamedTuple):
    """Images to fit, and what fits may start from.

    Attributes
    ----------
    name : str
    images : list of (str, ndarray of float32, shape (H, W, 3))
    gaussians : int
        Splats of the default fit.
    basis : EigenGS
        What "eigen" and the preset "eigengs" start from.
    others : dict of int to EigenGS
        Models of other numbers of components; none where none are trained.
    """

    name: str
    images: list[tuple[str, Image]]
    gaussians: int
    basis: EigenGS
    others: dict[int, EigenGS]


class Variant(NamedTuple):
    """A fit with one setting, the knob, at another value; the other fields are those of `fit`.

    The default fit is the value "default" of the knob "preset".
    """

    knob: str
    value: str | float
    gaussians: int | None = None
    preset: str = "default"
    init: str = "auto"
    basis: EigenGS | str = "natural"
    solve_steps: int = 10
    cutoff: float = CUTOFF


def collected(
    data: Path | None,
    name: str,
    count: int,
    models: Path,
    backend: str | None = None,
    progress: Callable[[str, int, int], None] = lambda label, done, total: None,
) -> Collection:
    """Load the first images of a set, and its models, which are trained where they are missing.

    Sets without images to train on use the basis that ships. Parameters are those of
    `eigengs_dr.bench.sets.model_for`; `name` may be `SAMPLES`, which needs no data.

    Raises
    ------
    ValueError
        If the set is not there.
    """
    shipped = load_basis("natural", backend)
    if name == SAMPLES:
        side = SAMPLE_SIDE
        images = [(photo, center_crop(sample(photo), side, side)) for photo in SAMPLE_NAMES[:count]]
        return Collection(name, images, DEFAULT_COUNT, shipped, {})
    if data is None:
        raise ValueError(f"set {name!r} needs DATA, the folder that holds it")
    images, chosen = test_images(data, name, count), SETS[name]
    if not (data / chosen.folder / "train").is_dir():
        return Collection(name, images, chosen.gaussians, shipped, {})
    trained = {
        k: model_for(data, name, name, k, models, progress=progress, backend=backend)
        for k in (DEFAULT_COMPONENTS, *COMPONENTS)
    }
    basis = trained.pop(DEFAULT_COMPONENTS)
    return Collection(name, images, chosen.gaussians, basis, trained)


def variants(collection: Collection) -> list[Variant]:
    """List the fits that are compared on a set, the default one first."""
    count, basis = collection.gaussians, collection.basis
    return [
        Variant("preset", "default", count),
        Variant("preset", "gaussianimage", count, "gaussianimage"),
        Variant("preset", "eigengs", None, "eigengs", basis=basis),
        Variant("init", "grid", count, init="grid"),
        Variant("init", "random", count, init="random"),
        Variant("init", "eigen", None, init="eigen", basis=basis),
        *(Variant("solve steps", k, count, solve_steps=k) for k in (0, 2, 5, 30)),
        *(Variant("cutoff", k, count, cutoff=k) for k in (2.5, 3.5, 4.0, 5.0)),
        *(Variant("gaussians", round(k * count), round(k * count)) for k in (0.25, 0.5, 2, 4)),
        *(
            Variant("components", k, None, "eigengs", basis=model)
            for k, model in collection.others.items()
        ),
    ]


def jobs(
    collection: Collection, iterations: int, seed: int = 0, backend: str | None = None
) -> Iterator[Job]:
    """Name the measurements on a set: for each image all variants, then how its set is stored.

    The row of a variant has "gaussians", their number, and "trace", a list of what
    `eigengs_dr.bench.trial.judged` tells of each number of steps, with "psnr_wide", the PSNR in
    YCbCr of the same splats at the cutoff `WIDE`. The last row of an image has "stored", a list of
    the figures of `stored`.
    """
    for name, image in collection.images:
        about = {"set": collection.name, "image": name, "iterations": iterations, "seed": seed}
        fits = variants(collection)
        for fit in fits:
            label = {**about, "knob": fit.knob, "value": fit.value}
            yield label, partial(_fitted, fit, image, iterations, seed, backend)
        label = {**about, "knob": "precision", "value": "all"}
        yield label, partial(_stored, fits[0], image, iterations, seed, backend)


def _fitted(fit: Variant, image: Image, iterations: int, seed: int, backend: str | None) -> Row:
    """Run a variant once untimed, then once for every number of steps it is judged at."""
    schedule = PRESETS[fit.preset].schedule
    warm_up(_start(fit, image, seed, backend), schedule, iterations, fit.cutoff)
    falls = schedule.decay < 1
    marks = sorted({n for n in (HORIZONS if falls else MARKS) if n < iterations} | {iterations})
    runs = [(n, (n,)) for n in marks] if falls else [(iterations, tuple(marks))]
    trace, count = [], 0
    for steps, shown in runs:
        for moment in _moments(fit, image, steps, shown, seed, backend):
            count = len(moment.gaussians)
            # The mean image may be in the picture, and not among the splats.
            tails = picture_of(moment.gaussians, cutoff=WIDE) - picture_of(
                moment.gaussians, cutoff=fit.cutoff
            )
            wide = decibels(moment.picture + tails, image, "ycbcr")
            trace.append({**judged(moment, image), "psnr_wide": wide})
    return {"gaussians": count, "trace": trace}


def _moments(
    fit: Variant, image: Image, steps: int, marks: Sequence[int], seed: int, backend: str | None
) -> Iterator[Moment]:
    start, schedule = _start(fit, image, seed, backend), PRESETS[fit.preset].schedule
    return follow(start, schedule, steps, marks, fit.cutoff)


def _start(fit: Variant, image: Image, seed: int, backend: str | None) -> Callable[[], FitProblem]:
    method = PRESETS[fit.preset]
    start = partial(
        initialize, image, fit.gaussians, fit.init, fit.basis, method, fit.solve_steps, seed=seed
    )
    return partial(start, cutoff=fit.cutoff, backend=backend)


def _last(fit: Variant, image: Image, steps: int, seed: int, backend: str | None) -> Gaussians:
    (moment,) = _moments(fit, image, steps, (steps,), seed, backend)
    return moment.gaussians


def _stored(fit: Variant, image: Image, iterations: int, seed: int, backend: str | None) -> Row:
    return {"stored": stored(_last(fit, image, iterations, seed, backend), image, backend)}


def stored(gaussians: Gaussians, image: Image, backend: str | None = None) -> list[Row]:
    """Store a set in fewer bits and look at what comes back.

    Returns
    -------
    list of dict
        "precision" ("8 bits" to "float32"), "bytes" (parameters, and the two ends of the range of
        each where it is cut into steps; the background stays float32), psnr_ycbcr and psnr_rgb.
    """
    arrays, rows = gaussians.to_arrays(), []
    background, size = arrays.pop("background"), (gaussians.width, gaussians.height)
    splats = {name: values.astype(np.float64) for name, values in arrays.items()}
    parameters = sum(values.shape[1] for values in splats.values())
    numbers = len(gaussians) * parameters
    forms: dict[str, tuple[float, Callable[[Any], Any]]] = {
        **{
            f"{b} bits": (numbers * b / 8 + 8 * parameters, partial(quantised, bits=b))
            for b in BITS
        },
        **{f: (numbers * np.dtype(f).itemsize, partial(np.asarray, dtype=f)) for f in FLOATS},
    }
    for name, (weight, form) in forms.items():
        kept = {key: form(values) for key, values in splats.items()}
        again = Gaussians.from_arrays(
            **kept, background=background, size=size, space=gaussians.space, backend=backend
        )
        picture, total = picture_of(again), math.ceil(weight) + background.nbytes
        found = {f"psnr_{space}": decibels(picture, image, space) for space in ("ycbcr", "rgb")}
        rows.append({"precision": name, "bytes": total, **found})
    return rows


def quantised(values: NDArray[np.float64], bits: int) -> NDArray[np.float64]:
    """Round every column to the nearest of ``2^bits`` equal steps from its least to its largest."""
    low, high = values.min(axis=0), values.max(axis=0)
    step = np.where(high > low, high - low, 1) / (2**bits - 1)
    return low + step * np.rint((values - low) / step)


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Find the Pareto front: points of which none is as fast and better, or faster and as good.

    Parameters
    ----------
    points : sequence of (float, float)
        Seconds and PSNR; those with NaN are on no front.

    Returns
    -------
    list of (float, float)
        From the fastest to the best; of equal points one.
    """
    best, kept = -math.inf, []
    known = [point for point in points if not any(map(math.isnan, point))]
    for seconds, reached in sorted(known, key=lambda point: (point[0], -point[1])):
        if reached > best:
            best = reached
            kept.append((seconds, reached))
    return kept
