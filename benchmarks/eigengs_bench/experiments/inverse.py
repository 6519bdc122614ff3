"""Recover a poster from photos: texels, Gaussians, and coefficients of an eigenbasis, compared."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_bench.experiments.inverse_scene import (
    CONDITIONS,
    METHODS,
    Condition,
    head_on,
    photograph,
    scene_of,
)
from eigengs_bench.harness.store import Progress, Row
from eigengs_bench.harness.timing import Image
from eigengs_dr.backend.selection import select
from eigengs_dr.eigenbasis.eigengs import SHIPPED, EigenGS
from eigengs_dr.image.metrics import psnr
from eigengs_dr.image.resize import center_crop
from eigengs_dr.plugins import register_plugins

SAMPLES = 4  # a pixel of a step's rendering
LAST_RATE = 0.05  # rates fall by a cosine to this share
GOAL = 25.0  # PSNR (YCbCr) up to which steps and seconds are counted

STRIP = (0, 3, 10, 30, 100)  # steps of which pictures are kept, beside the last


@dataclass
class Trace:
    """A method at the steps that are measured; seconds without compiling and measuring."""

    steps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    psnr_ycbcr: list[float] = field(default_factory=list)
    psnr_rgb: list[float] = field(default_factory=list)
    pictures: dict[int, Image] = field(default_factory=dict)


class Result(NamedTuple):
    """One condition: photos in linear light, the true poster in RGB, traces by method."""

    photos: Image
    truth: Image
    traces: dict[str, Trace]


def run(
    basis: str,
    image: Image,
    conditions: Sequence[str] = tuple(CONDITIONS),
    steps: int = 200,
    backend: str | None = None,
    progress: Progress = lambda *_: None,
) -> dict[str, Result]:
    """Recover the largest square of an image by every method, in at least 2 steps.

    Sets Mitsuba's variant. `basis` is a name of `eigengs_dr.eigenbasis.eigengs.SHIPPED` or a file.
    """
    module = select(backend)
    mi.set_variant("cuda_ad_rgb" if "cuda" in module.__name__ else "llvm_ad_rgb")
    register_plugins()
    model = EigenGS.load(basis, backend)
    file = SHIPPED.get(str(basis), basis)
    size = model.gaussians.width, model.gaussians.height
    square = center_crop(image, *2 * [min(image.shape[:2])])
    results = {}
    for name in conditions:
        photos, texture = photograph(CONDITIONS[name], square)
        truth = head_on(texture, *size)
        traces = {}
        for method, stages in METHODS.items():
            tell = partial(progress, f"{name}, {method}")
            # Once for the kernels, which are compiled and kept, and once for the figures.
            recover(CONDITIONS[name], photos, stages(model, file, 2), truth, 2)
            found = stages(model, file, steps)
            traces[method] = recover(CONDITIONS[name], photos, found, truth, steps, tell)
        results[name] = Result(photos.numpy(), truth, traces)
    return results


def recover(
    condition: Condition,
    photos: Any,
    stages: Iterable[tuple[Any, int]],
    truth: Image,
    steps: int,
    progress: Callable[..., None] = lambda *_: None,
) -> Trace:
    """Run the stages of a method: descent by Adam on squared errors of the rendering.

    A stage is a representation and the step at which it ends; the next one starts from it.
    """
    trace, step, measuring, started = Trace(), 0, 0.0, time.perf_counter()

    def measure(texture: Any) -> None:
        nonlocal measuring
        dr.sync_thread()
        now = time.perf_counter()
        picture = head_on(texture, truth.shape[1], truth.shape[0])
        trace.steps.append(step)
        trace.seconds.append(now - started - measuring)
        for space, values in (("ycbcr", trace.psnr_ycbcr), ("rgb", trace.psnr_rgb)):
            values.append(psnr(picture, truth, space))
        if step in (*STRIP, steps):
            trace.pictures[step] = picture
        measuring += time.perf_counter() - now

    for unknown, last in stages:
        first, scene = step, scene_of(condition, unknown.texture)
        parameters = mi.traverse(scene)
        begin = {key: parameters[key] for key in unknown.rates}
        values = mi.ad.Adam(unknown.rates, begin, **unknown.adam)
        unknown.put(values, parameters)
        parameters.update()
        if not step:
            measure(unknown.texture)
        while step < last:
            share = 0.5 + 0.5 * math.cos(math.pi * (step - first) / (last - first))
            falling = LAST_RATE + (1 - LAST_RATE) * share
            values.set_learning_rate({key: r * falling for key, r in unknown.rates.items()})
            shown = mi.render(scene, params=parameters, spp=SAMPLES, seed=step)
            error = dr.sum(dr.square(shown - photos), axis=None)
            dr.backward(error + unknown.prior(values, dr.width(photos)))
            values.step()
            unknown.bound(values)
            unknown.put(values, parameters)
            parameters.update()
            step += 1
            if step in marks(steps):
                measure(unknown.texture)
            progress(step, steps, {"psnr_rgb": trace.psnr_rgb[-1]})
    return trace


def marks(steps: int) -> set[int]:
    """Steps at which a method is measured: the first ones, then a tenth more each, and the last."""
    found, at = {0, steps, *STRIP}, 1.0
    while at < steps:
        found.add(round(at))
        at = max(at + 1, at * 1.1)
    return found


def figures_of(results: dict[str, Result]) -> list[Row]:
    """Summarize results: a row a condition and method.

    "goal_steps" and "goal_seconds" count up to `GOAL`, None for never; "visible" and "hidden" are
    the PSNR in YCbCr of the halves of a poster of which one is hidden, else None.
    """
    rows = []
    for name, (_, truth, traces) in results.items():
        middle = truth.shape[1] // 2
        for method, trace in traces.items():
            last = {key: getattr(trace, key)[-1] for key in ("psnr_ycbcr", "psnr_rgb", "seconds")}
            at = next((k for k, db in enumerate(trace.psnr_ycbcr) if db >= GOAL), None)
            for key in ("steps", "seconds"):
                last[f"goal_{key}"] = None if at is None else getattr(trace, key)[at]
            for half, columns in {"visible": np.s_[:middle], "hidden": np.s_[middle:]}.items():
                seen = trace.pictures[trace.steps[-1]][:, columns], truth[:, columns]
                last[half] = psnr(*seen, "ycbcr") if CONDITIONS[name].hidden else None
            rows.append({"condition": name, "method": method, **last})
    return rows


def traces_of(results: dict[str, Result]) -> Row:
    """Lists of steps, seconds and PSNRs, by condition and method."""

    def lists(trace: Trace) -> Row:
        return {name: values for name, values in vars(trace).items() if name != "pictures"}

    return {
        name: {method: lists(trace) for method, trace in result.traces.items()}
        for name, result in results.items()
    }
