"""Speed against accuracy of the renderer: what a cutoff saves, and what it leaves out."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from ..backend.arrays import types_in
from ..backend.selection import select
from ..raster.render import render
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
        forward, step, shown = kernels.programs(scene, cutoff, renderer == "plain")
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
