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
import numpy as np
from numpy.typing import NDArray

from ..backend.selection import select
from ..eigenbasis.registry import SHIPPED, load_basis
from ..image.metrics import psnr
from ..image.resize import center_crop
from ..plugins import register_plugins
from .poster import CONDITIONS, Condition, head_on, photograph, scene_of
from .unknowns import METHODS

SAMPLES = 4
"""Samples a pixel of a step's rendering."""

LAST_RATE = 0.05
"""Rates fall by a cosine to this share."""

GOAL = 25.0
"""PSNR (YCbCr) up to which steps and seconds are counted."""

STRIP = (0, 3, 10, 30, 100)
"""Steps of which pictures are kept, beside the last."""

Image = NDArray[np.float32]
Progress = Callable[[str, int, int, dict[str, Any]], None]


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
    progress: Progress = lambda label, done, total, row: None,
) -> dict[str, Result]:
    """Recover an image on a poster by every method, in as many steps, under some conditions.

    Sets Mitsuba's variant.

    Parameters
    ----------
    basis : str or path-like
        A name of `eigengs_dr.eigenbasis.registry.SHIPPED` or a file.
    image : ndarray of float32, shape (H, W, 3)
        RGB; its largest square is hung up.
    conditions : sequence of str, optional
        Keys of `eigengs_dr.bench.poster.CONDITIONS`; all by default.
    steps : int, optional
        For each method, at least 2.
    backend : {"llvm", "cuda"}, optional
    progress : callable, optional
        ``progress(label, done, total, row)`` after every step; row may hold ``psnr_rgb``.

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
    square = center_crop(image, *2 * [min(image.shape[:2])])
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


def figures_of(results: dict[str, Result]) -> dict[str, Any]:
    """Boil results down to figures with stable names.

    Returns
    -------
    dict
        For every condition C and method M ``C_M_psnr_ycbcr``, ``C_M_psnr_rgb`` and ``C_M_seconds``
        after all steps; ``C_M_goal_steps`` and ``C_M_goal_seconds`` up to `GOAL`, None for never;
        where half of the poster is hidden ``C_M_psnr_ycbcr_visible`` and ``_hidden``.
    """
    figures: dict[str, Any] = {}
    for name, result in results.items():
        for method, trace in result.traces.items():
            key = f"{name}_{method}"
            figures[f"{key}_psnr_ycbcr"] = trace.psnr_ycbcr[-1]
            figures[f"{key}_psnr_rgb"] = trace.psnr_rgb[-1]
            figures[f"{key}_seconds"] = trace.seconds[-1]
            reached = [k for k, value in enumerate(trace.psnr_ycbcr) if value >= GOAL]
            figures[f"{key}_goal_steps"] = trace.steps[reached[0]] if reached else None
            figures[f"{key}_goal_seconds"] = trace.seconds[reached[0]] if reached else None
            if CONDITIONS[name].hidden:
                picture, middle = trace.pictures[trace.steps[-1]], result.truth.shape[1] // 2
                for half, columns in (("visible", slice(middle)), ("hidden", slice(middle, None))):
                    seen = picture[:, columns], result.truth[:, columns]
                    figures[f"{key}_psnr_ycbcr_{half}"] = psnr(*seen, "ycbcr")
    return figures


def traces_of(results: dict[str, Result]) -> dict[str, Any]:
    """Lists of steps, seconds and PSNRs, by condition and method."""
    names = ("steps", "seconds", "psnr_ycbcr", "psnr_rgb")
    return {
        condition: {
            method: {name: getattr(trace, name) for name in names}
            for method, trace in result.traces.items()
        }
        for condition, result in results.items()
    }


def table(results: dict[str, Result]) -> str:
    """Lay the figures out in lines of text."""
    figures = figures_of(results)
    lines = [f"{'':24} ycbcr    rgb  seconds  steps, seconds to {GOAL:g} dB"]
    for name, result in results.items():
        for method in result.traces:
            ycbcr, rgb, seconds, steps, until = (
                figures[f"{name}_{method}_{key}"]
                for key in ("psnr_ycbcr", "psnr_rgb", "seconds", "goal_steps", "goal_seconds")
            )
            goal = "never" if steps is None else f"{steps}, {until:.1f}"
            halves = [
                f"{half} {figures[f'{name}_{method}_psnr_ycbcr_{half}']:.1f}"
                for half in ("visible", "hidden")
                if CONDITIONS[name].hidden
            ]
            row = f"{f'{name} {method}':24} {ycbcr:5.1f}  {rgb:5.1f}  {seconds:7.1f}  {goal}"
            lines.append(" ".join([row, *halves]))
    return "\n".join(lines)
