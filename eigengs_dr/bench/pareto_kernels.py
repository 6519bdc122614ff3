"""Speed against accuracy of the renderer: what a cutoff saves, and what it leaves out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..arrays import types_in, upload
from ..backend import select
from ..gaussians import Gaussians
from ..reference import render_plain
from ..rendering import lists_for, render, splat, splat_values, to_tensor
from ..splat import SHAPE, UNIT
from ..tiles import Grid, TileLists, build_lists
from . import kernels
from .rows import Job, Row

CUTOFFS = (2.5, 3.0, 3.5, 4.0, 5.0)

EXACT = 8.0
"""Cutoff that stands for none in double precision: 1.3e-14 of an amplitude is left."""


def kernel_job(backend: str | None = None) -> Job:
    """Name the measurement of the renderer: its time, and what its cutoff leaves out.

    The scene is that of `eigengs_dr.bench.kernels`. The row has "kernels", a list of dicts with
    "renderer" ("fast" or "plain"), "cutoff", "forward_ms" and "step_ms" (forward and reverse),
    lists given, programs frozen, medians of rounds in which all take turns, and "largest_error" and
    "rms_error" over the values of all pixels, against a rendering in float64 at the cutoff `EXACT`.
    """
    name = {"set": "kernels", "side": kernels.SIDE, "gaussians": kernels.COUNT}
    return name, partial(_kernels, backend)


def _kernels(backend: str | None) -> Row:
    module = select(backend)
    scene = kernels._scene(types_in(module))
    double = replace(
        scene,
        mean=module.Array2f64(scene.mean),
        factor=module.Array3f64(scene.factor),
        color=module.ArrayXf64(scene.color),
        background=module.ArrayXf64(scene.background),
    )
    exact = render(double, cutoff=EXACT).numpy()
    rows, programs = list[Row](), dict[str, Any]()
    for cutoff, renderer in product(CUTOFFS, ("fast", "plain")):
        forward, step, shown = _programs(scene, cutoff, renderer == "plain")
        programs |= {f"forward {len(rows)}": forward, f"step {len(rows)}": step}
        error = shown() - exact
        errors = {"largest_error": np.abs(error).max(), "rms_error": np.sqrt(np.mean(error**2))}
        rows.append({"renderer": renderer, "cutoff": cutoff, **errors})
    ms = kernels._interleaved(programs, None)
    for program in programs.values():
        program.func.clear()  # left to the garbage collector, they may go while another is traced
    times = [
        {f"{what}_ms": ms[f"{what} {k}"] for what in ("forward", "step")} for k in range(len(rows))
    ]
    return {"kernels": [row | time for row, time in zip(rows, times, strict=True)]}


def _programs(
    scene: Gaussians, cutoff: float, plain: bool
) -> tuple[Any, Any, Callable[[], NDArray[Any]]]:
    """Frozen programs that draw the scene, forward and with reverse, and what shows it."""
    values, background = splat_values(scene)
    dr.eval(values)
    if plain:
        grid, draw = Grid(scene.width, scene.height, kernels.PLAIN_TILE), render_plain
        lists = build_lists(values[:SHAPE], UNIT * cutoff, grid)
        values = [*values[:2], *scene.factor, *values[SHAPE:]]  # not in `UNIT`
    else:
        draw, lists = splat, lists_for(scene, cutoff)
    shape = (scene.height, scene.width, scene.channels)
    delta = upload(type(values[0]), np.random.default_rng(1).normal(size=math.prod(shape)))

    @dr.freeze
    def forward(values: list, background: list, lists: TileLists) -> Any:
        return draw(values, background, lists, cutoff)

    @dr.freeze
    def step(values: list, background: list, lists: TileLists, delta: Any) -> list:
        dr.enable_grad(values)
        dr.backward(dr.dot(draw(values, background, lists, cutoff), delta))
        return dr.grad(values)

    def shown() -> NDArray[Any]:
        image = draw(values, background, lists, cutoff)
        return (
            image.numpy().reshape(shape)
            if plain
            else to_tensor(image, lists.grid, shape[2]).numpy()
        )

    frozen = partial(step, values, background, lists, delta)
    return partial(forward, values, background, lists), frozen, shown
