"""Speed against accuracy: fits that differ from the default one in one setting at a time.

The row of a variant has "gaussians", their number, and "trace", a list of `score` at each number of
steps, with "psnr_wide", the PSNR in YCbCr of the same set at the cutoff `WIDE`. The row of the
knob "precision" has "stored", see `stored`; the last row has "kernels", see `_kernels`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eigengs_bench.experiments import kernels
from eigengs_bench.harness.datasets import images_of, is_trained, model_for, usual_count
from eigengs_bench.harness.store import Job, Row, Task
from eigengs_bench.harness.timing import Image, decibels, follow, interleaved, score, warm_up
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.start import initialize, mean_picture
from eigengs_dr.gaussian.file import CUTOFF
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.raster.render import picture_of, render

FILE = "pareto.jsonl"

# Steps of runs of a method whose rates fall: each number is a run of its own.
HORIZONS = (0, 10, 100, 300, 1000)
# Steps after which the one run is looked at where rates stay: it stands for all shorter ones.
MARKS = (0, 10, 20, 50, 100, 200, 500, 1000)
# Components a channel of the models that all fits start from, and of others.
DEFAULT_COMPONENTS, COMPONENTS = 300, (50, 100, 500)
# How finished sets are stored: each parameter in as many equal steps of its range, or as it is.
BITS, FLOATS = (8, 10, 12, 16), ("float16", "float32")
# Cutoffs that stand for none in single precision (1.5e-8 of an amplitude is left), and in double
# precision (1.3e-14).
WIDE, WIDEST = 6.0, 8.0
CUTOFFS = (2.5, 3.0, 3.5, 4.0, 5.0)  # of the renderer


class Variant(NamedTuple):
    """A fit with one setting, the knob, at another value; the other fields are arguments of `fit`.

    The default fit is the value "default" of the knob "preset".
    """

    knob: str
    value: str | float
    gaussians: int | None = None
    preset: str = "default"
    init: str = "auto"
    start: EigenGS | None = None
    solve_steps: int = 10
    cutoff: float = CUTOFF


def run(task: Task, names: Sequence[str]) -> list[Row]:
    """Measure all variants on sets of images, and the renderer."""
    jobs = [job for name in names for job in _jobs(task, name, variants(task, name))]
    scene = {"set": "kernels", "side": kernels.SIDE, "gaussians": kernels.COUNT}
    jobs.append((scene, partial(_kernels, task)))
    return task.measure(FILE, jobs, "pareto")


def variants(task: Task, name: str) -> list[Variant]:
    """List the fits that are compared on a set, the default one first.

    Their models are trained where they are missing; sets without images to train on use the basis
    that ships, in one size.
    """
    count, models = usual_count(name), dict[int, EigenGS]()
    if is_trained(task.data, name):
        models = {k: model_for(task, name, name, k) for k in (DEFAULT_COMPONENTS, *COMPONENTS)}
    basis = models.pop(DEFAULT_COMPONENTS, None) or EigenGS.load("natural", task.backend)
    return [
        Variant("preset", "default", count),
        Variant("preset", "gaussianimage", count, "gaussianimage"),
        Variant("preset", "eigengs", None, "eigengs", start=basis),
        Variant("init", "grid", count, init="grid"),
        Variant("init", "random", count, init="random"),
        Variant("init", "eigen", None, start=basis),
        *(Variant("solve steps", k, count, solve_steps=k) for k in (0, 2, 5, 30)),
        *(Variant("cutoff", k, count, cutoff=k) for k in (2.5, 3.5, 4.0, 5.0)),
        *(Variant("gaussians", round(k * count), round(k * count)) for k in (0.25, 0.5, 2, 4)),
        *(Variant("components", k, None, "eigengs", start=model) for k, model in models.items()),
    ]


def _jobs(task: Task, name: str, fits: Sequence[Variant]) -> Iterator[Job]:
    for file, image in images_of(task, name):
        about = {"set": name, "image": file, "iterations": task.iterations, "seed": task.seed}
        for fit in fits:
            yield {**about, "knob": fit.knob, "value": fit.value}, partial(trace, task, fit, image)
        label = {**about, "knob": "precision", "value": "all"}
        yield label, partial(_stored, task, fits[0], image)


def trace(task: Task, fit: Variant, image: Image) -> Row:
    """Run a variant once untimed, then once for every number of steps it is judged at."""
    schedule, iterations = PRESETS[fit.preset].schedule, task.iterations
    warm_up(_start(task, fit, image), schedule, iterations)
    falls = schedule.decay < 1
    marks = sorted({n for n in (HORIZONS if falls else MARKS) if n < iterations} | {iterations})
    runs = [(n, (n,)) for n in marks] if falls else [(iterations, tuple(marks))]
    mean_image = mean_picture(_options(task, fit), image.shape[1], image.shape[0])
    found, count = [], 0
    for steps, shown in runs:
        for moment in follow(_start(task, fit, image), schedule, steps, shown, mean_image):
            count = len(moment.gaussians)
            # The mean image may be in the picture, and not among the Gaussians.
            wide, cut = (picture_of(moment.gaussians, cutoff=k) for k in (WIDE, fit.cutoff))
            reached = decibels(moment.picture + (wide - cut), image, "ycbcr")
            found.append({**score(moment, image), "psnr_wide": reached})
    return {"gaussians": count, "trace": found}


def _start(task: Task, fit: Variant, image: Image) -> Callable[[], FitProblem]:
    return partial(initialize, image, _options(task, fit))


def _options(task: Task, fit: Variant) -> FitOptions:
    settings = {key: value for key, value in fit._asdict().items() if key not in ("knob", "value")}
    return FitOptions(seed=task.seed, backend=task.backend, **settings)


def _stored(task: Task, fit: Variant, image: Image) -> Row:
    schedule, steps = PRESETS[fit.preset].schedule, task.iterations
    (last,) = follow(_start(task, fit, image), schedule, steps, (steps,))
    return {"stored": stored(last.gaussians, image, task.backend)}


def stored(gaussians: Gaussians, image: Image, backend: str | None = None) -> list[Row]:
    """Store a set in fewer bits and judge the set that is read back.

    "bytes" counts the parameters, and the two ends of each range that is cut into steps; the
    background stays float32.
    """
    arrays, rows = gaussians.to_arrays(), []
    background, size = arrays.pop("background"), (gaussians.width, gaussians.height)
    splats = {name: values.astype(np.float64) for name, values in arrays.items()}
    parameters = sum(values.shape[1] for values in splats.values())
    numbers = len(gaussians) * parameters
    forms: dict[str, tuple[float, Callable[[Any], Any]]] = {
        f"{b} bits": (numbers * b / 8 + 8 * parameters, partial(quantized, bits=b)) for b in BITS
    }
    forms |= {k: (numbers * np.dtype(k).itemsize, partial(np.asarray, dtype=k)) for k in FLOATS}
    for name, (weight, form) in forms.items():
        kept = {key: form(values) for key, values in splats.items()}
        again = Gaussians.from_arrays(
            **kept, background=background, size=size, space=gaussians.space, backend=backend
        )
        picture, total = picture_of(again), math.ceil(weight) + background.nbytes
        found = {f"psnr_{space}": decibels(picture, image, space) for space in ("ycbcr", "rgb")}
        rows.append({"precision": name, "bytes": total, **found})
    return rows


def quantized(values: NDArray[np.float64], bits: int) -> NDArray[np.float64]:
    """Round every column to the nearest of ``2^bits`` equal steps from its least to its largest."""
    low, high = values.min(axis=0), values.max(axis=0)
    step = np.where(high > low, high - low, 1) / (2**bits - 1)
    return low + step * np.rint((values - low) / step)


def _kernels(task: Task) -> Row:
    """Time the renderer, and measure what its cutoff leaves out.

    Milliseconds are of frozen programs with lists given, forward and with reverse ("step"); errors
    are of all pixels, against a rendering in float64 at the cutoff `WIDEST`.
    """
    module = select(task.backend)
    scene = kernels.random_scene(types_in(module))
    colors = {key: module.ArrayXf64(getattr(scene, key)) for key in ("color", "background")}
    shapes = {"mean": module.Array2f64(scene.mean), "factor": module.Array3f64(scene.factor)}
    exact = render(replace(scene, **shapes, **colors), cutoff=WIDEST).numpy()
    rows, timed = list[Row](), dict[str, Any]()
    for cutoff, renderer in product(CUTOFFS, ("fast", "plain")):
        forward, step, shown = kernels.programs(scene, cutoff, renderer == "plain")
        timed |= {f"forward {len(rows)}": forward, f"step {len(rows)}": step}
        error = shown() - exact
        errors = {"largest_error": np.abs(error).max(), "rms_error": np.sqrt(np.mean(error**2))}
        rows.append({"renderer": renderer, "cutoff": cutoff, **errors})
    ms = interleaved(timed, kernels.WARM_UP, kernels.ROUNDS)
    for program in timed.values():
        program.func.clear()  # left to the garbage collector, they may go while another is traced
    for k, row in enumerate(rows):
        row |= {f"{what}_ms": ms[f"{what} {k}"] for what in ("forward", "step")}
    return {"kernels": rows}
