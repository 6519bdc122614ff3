"""Recover a poster from photos: texels, Gaussians, and coefficients of an eigenbasis, compared."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from eigengs_bench.experiments.inverse_representations import METHODS
from eigengs_bench.experiments.inverse_scene import (
    CONDITIONS,
    Condition,
    head_on,
    photograph,
    scene_of,
)
from eigengs_bench.harness.store import Row
from eigengs_bench.harness.task import Progress, no_progress
from eigengs_bench.harness.timing import Image
from eigengs_dr.backend import select
from eigengs_dr.bases import SHIPPED, load_basis
from eigengs_dr.metrics import psnr
from eigengs_dr.plugins import register_plugins
from eigengs_dr.resampling import cropped

SAMPLES = 4
"""Samples a pixel of a step's rendering."""

LAST_RATE = 0.05
"""Rates fall by a cosine to this share."""

GOAL = 25.0
"""PSNR (YCbCr) up to which steps and seconds are counted."""

STRIP = (0, 3, 10, 30, 100)
"""Steps of which pictures are kept, beside the last."""


@dataclass
class Trace:
    """How one method went on.

    Attributes
    ----------
    steps, seconds, psnr_ycbcr, psnr_rgb : list
        At the steps that are measured; seconds without compiling and measuring.
    pictures : dict of int to ndarray
        The poster as recovered, by step.
    """

    steps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    psnr_ycbcr: list[float] = field(default_factory=list)
    psnr_rgb: list[float] = field(default_factory=list)
    pictures: dict[int, Image] = field(default_factory=dict)


class Result(NamedTuple):
    """One condition.

    Attributes
    ----------
    photos : ndarray of float32, shape (side, cameras x side, 3)
        Linear light.
    truth : ndarray of float32, shape (height, width, 3)
        The poster from the front, RGB.
    traces : dict of str to Trace
        By method.
    """

    photos: Image
    truth: Image
    traces: dict[str, Trace]


def run(
    basis: str | os.PathLike[str],
    image: Image,
    conditions: Sequence[str] = tuple(CONDITIONS),
    steps: int = 200,
    backend: str | None = None,
    progress: Progress = no_progress,
) -> dict[str, Result]:
    """Recover an image on a poster by every method, in as many steps, under some conditions.

    Sets Mitsuba's variant.

    Parameters
    ----------
    basis : str or path-like
        A name of `eigengs_dr.bases.SHIPPED` or a file.
    image : ndarray of float32, shape (H, W, 3)
        RGB; its largest square is hung up.
    conditions : sequence of str, optional
        Keys of `CONDITIONS`; all by default.
    steps : int, optional
        For each method, at least 2.
    backend : {"llvm", "cuda"}, optional
    progress : Progress, optional
        Called after every step.

    Raises
    ------
    ValueError
        If there is no such basis.
    BackendError
        If the backend is not there.
    """
    module = select(backend)
    mi.set_variant("cuda_ad_rgb" if "cuda" in module.__name__ else "llvm_ad_rgb")
    register_plugins()
    model = load_basis(basis, backend)
    file = SHIPPED.get(str(basis), basis)
    size = model.gaussians.width, model.gaussians.height
    square = cropped(image, *2 * [min(image.shape[:2])])
    results = {}
    for name in conditions:
        condition = CONDITIONS[name]
        photos, texture = photograph(condition, square)
        truth = head_on(texture, *size)
        traces = {}
        for method, stages in METHODS.items():

            def told(step: int, trace: Trace, label: str = f"{name}, {method}") -> None:
                progress(label, step, steps, {"psnr_rgb": trace.psnr_rgb[-1]})

            # Once for the kernels, which are compiled and kept, and once for the figures.
            recover(condition, photos, stages(model, file, 2), truth, 2)
            traces[method] = recover(
                condition, photos, stages(model, file, steps), truth, steps, told
            )
        results[name] = Result(photos.numpy(), truth, traces)
    return results


def recover(
    condition: Condition,
    photos: Any,
    stages: Iterable[tuple[Any, int]],
    truth: Image,
    steps: int,
    told: Callable[[int, Trace], None] = lambda step, trace: None,
) -> Trace:
    """Run the stages of a method: descent by Adam on squared errors of the rendering.

    Parameters
    ----------
    condition : Condition
    photos : TensorXf
    stages : iterable of (unknown, int)
        What is optimised, and the step at which that ends. The next stage is asked for then, so
        that it can go on from there.
    truth : ndarray of float32, shape (height, width, 3)
        What the recovered poster is compared with.
    steps : int
        Where the last stage ends.
    told : callable, optional
        ``told(step, trace)`` after every step.
    """
    trace, step, measuring, started = Trace(), 0, 0.0, time.perf_counter()

    def measure(texture: Any) -> None:
        nonlocal measuring
        dr.sync_thread()
        now = time.perf_counter()
        picture = head_on(texture, truth.shape[1], truth.shape[0])
        trace.steps.append(step)
        trace.seconds.append(now - started - measuring)
        trace.psnr_ycbcr.append(psnr(picture, truth, "ycbcr"))
        trace.psnr_rgb.append(psnr(picture, truth, "rgb"))
        if step in (*STRIP, steps):
            trace.pictures[step] = picture
        measuring += time.perf_counter() - now

    for unknown, last in stages:
        first, scene = step, scene_of(condition, unknown.texture)
        parameters = mi.traverse(scene)
        values = mi.ad.Adam(unknown.rates, unknown.begin(parameters), **unknown.adam)
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
            told(step, trace)
    return trace


def marks(steps: int) -> set[int]:
    """Steps at which a method is measured: the first ones, then a tenth more each, and the last."""
    found, at = {0, steps, *STRIP}, 1.0
    while at < steps:
        found.add(round(at))
        at = max(at + 1, at * 1.1)
    return found


def figures_of(results: dict[str, Result]) -> list[Row]:
    """Boil results down to a row a condition and method.

    Returns
    -------
    list of dict
        "condition", "method", "psnr_ycbcr", "psnr_rgb" and "seconds" after all steps; "goal_steps"
        and "goal_seconds" up to `GOAL`, None for never; "visible" and "hidden", the PSNR in YCbCr
        of the halves of a poster of which one is hidden, else None.
    """
    rows = []
    for name, result in results.items():
        for method, trace in result.traces.items():
            at = next((k for k, db in enumerate(trace.psnr_ycbcr) if db >= GOAL), None)
            picture, middle = trace.pictures[trace.steps[-1]], result.truth.shape[1] // 2
            halves: Row = {"visible": None, "hidden": None}
            if CONDITIONS[name].hidden:
                for half, columns in (("visible", slice(middle)), ("hidden", slice(middle, None))):
                    halves[half] = psnr(picture[:, columns], result.truth[:, columns], "ycbcr")
            rows.append(
                {
                    "condition": name,
                    "method": method,
                    "psnr_ycbcr": trace.psnr_ycbcr[-1],
                    "psnr_rgb": trace.psnr_rgb[-1],
                    "seconds": trace.seconds[-1],
                    "goal_steps": None if at is None else trace.steps[at],
                    "goal_seconds": None if at is None else trace.seconds[at],
                    **halves,
                }
            )
    return rows


def traces_of(results: dict[str, Result]) -> Row:
    """Lists of steps, seconds and PSNRs, by condition and method."""
    names = ("steps", "seconds", "psnr_ycbcr", "psnr_rgb")
    return {
        condition: {
            method: {name: getattr(trace, name) for name in names}
            for method, trace in result.traces.items()
        }
        for condition, result in results.items()
    }
