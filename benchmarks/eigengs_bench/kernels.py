"""How fast the renderer is, against the machine."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import numpy as np

import eigengs_dr as eg
from eigengs_bench.clock import interleaved
from eigengs_bench.report import Section, number, table
from eigengs_bench.rows import Row, Task
from eigengs_dr.backend.arrays import ArrayTypes, types_in, types_of, upload
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.lists import TileLists
from eigengs_dr.raster.parameters import NUM_SHAPE_PARAMS, KernelParameters
from eigengs_dr.raster.render import bin_gaussians, decode_parameters, rasterize

# The scene: Gaussians of equal size, spread evenly at random over a square picture.
SIDE, COUNT, SIGMA, CUTOFF = 512, 20_000, 2.0, 3.0
WARM_UP, ROUNDS = 3, 15  # rounds that compile and settle, and rounds that are measured
PEAK_LANES, PEAK_LOOPS, PEAK_UNROLL = 1 << 16, 100, 8  # size of the program that measures the peak


def run(task: Task) -> list[Row]:
    """Time the kernels in one run, in turn; every figure is a median.

    `step_ms` is forward and reverse together, with lists given and programs frozen.
    `peak_evals_per_ns` counts `exp`, `select` and 3 `fma` without memory; the fractions are
    evaluations inside the cutoff ellipses over that peak.
    """
    job: Row = {"side": SIDE, "gaussians": COUNT, "at": time.time()}  # each call measures anew
    return task.measure("kernels", [(job, partial(measure, task))])


def summarize(rows: Sequence[Row]) -> Section:
    """Lay out the figures of the last row."""
    lines = [(name, f"{value:.4g}") for name, value in rows[-1].items() if isinstance(value, float)]
    figures = {"peak": number(rows[-1]["peak_evals_per_ns"])}
    return Section([table("Kernels", ("figure", "value"), lines, "all")], figures=figures)


def measure(task: Task) -> Row:
    """Time the renderer, the lists and the peak on a scene."""
    types = types_in(select(task.backend))
    scene = random_scene(types)
    forward, step = programs(scene)
    seeds = dr.linspace(types.Float, 0, 1, PEAK_LANES)
    dr.eval(seeds)
    timed: dict[str, Callable[[], Any]] = {
        "step_ms": step,
        "forward_ms": forward,
        "lists_ms": lambda: bin_gaussians(replace(scene, cutoff=CUTOFF)),
        "peak_ms": lambda: _peak(seeds),
    }
    ms = interleaved(timed, WARM_UP, ROUNDS, partial(task.progress, "kernels"))
    for program in (forward, step):
        program.func.clear()  # left to the garbage collector, it may go while another is traced
    useful = pixels_inside(scene)
    peak = PEAK_LANES * PEAK_LOOPS * PEAK_UNROLL / (ms.pop("peak_ms") * 1e6)
    return {
        **ms,
        "peak_evals_per_ns": peak,
        "forward_peak_fraction": useful / (ms["forward_ms"] * 1e6) / peak,
        "step_peak_fraction": 2 * useful / (ms["step_ms"] * 1e6) / peak,
    }


def random_scene(types: ArrayTypes) -> eg.Gaussians:
    """Make the scene that is timed."""
    generator = np.random.default_rng(0)
    return eg.Gaussians.from_arrays(
        generator.uniform(0, SIDE, (COUNT, 2)),
        np.tile([1 / SIGMA, 0, 1 / SIGMA], (COUNT, 1)),
        generator.uniform(0, 1, (COUNT, 3)),
        size=(SIDE, SIDE),
        space="rgb",
        backend=types.backend,
    )


def programs(scene: eg.Gaussians) -> tuple[Any, Any]:
    """Make frozen programs that draw a scene: forward, and forward with reverse.

    ``program.func.clear()`` frees a program.
    """
    parameters, lists = decode_parameters(scene), bin_gaussians(replace(scene, cutoff=CUTOFF))
    background, values = parameters.background, [*parameters.shape, *parameters.color]
    dr.eval(values)
    size = scene.height * scene.width * scene.channels
    delta = upload(type(values[0]), np.random.default_rng(1).normal(size=size))

    @dr.freeze
    def forward(values: list, background: list, lists: TileLists) -> Any:
        return draw(values, background, lists)

    @dr.freeze
    def step(values: list, background: list, lists: TileLists, delta: Any) -> list:
        dr.enable_grad(values)
        dr.backward(dr.dot(draw(values, background, lists), delta))
        return dr.grad(values)

    frozen = partial(step, values, background, lists, delta)
    return partial(forward, values, background, lists), frozen


def draw(values: list, background: list, lists: TileLists) -> Any:
    """Draw a picture."""
    shape, color = values[:NUM_SHAPE_PARAMS], values[NUM_SHAPE_PARAMS:]
    return rasterize(KernelParameters(shape, color, background), lists, CUTOFF)


def _peak(q: Any) -> Any:
    types = types_of(q)

    def body(i: Any, q: Any, sums: list) -> tuple:
        for _ in range(PEAK_UNROLL):
            w = dr.select(q < 4.5, dr.exp(-q), 0)
            sums = [dr.fma(w, q, s) for s in sums]
            q = q + 1e-3
        return i + 1, q, sums

    start = (types.UInt(0), types.Float(q), [types.Float(0) for _ in range(3)])
    sums = dr.while_loop(start, lambda i, *_: i < PEAK_LOOPS, body, label="peak")[-1]
    return sum(sums)


def pixels_inside(scene: eg.Gaussians) -> int:
    """Count pairs of a Gaussian and a pixel of the picture inside its cutoff ellipse."""
    mean = scene.to_arrays()["mean"].astype(np.float64)
    reach = int(CUTOFF * SIGMA) + 1
    near = np.arange(-reach, reach + 1)
    x, y = (np.floor(mean[:, k])[:, None] + near + 0.5 for k in (0, 1))
    dx2, dy2 = (x - mean[:, :1]) ** 2, (y - mean[:, 1:]) ** 2
    dx2[(x < 0) | (x > SIDE)] = np.inf
    dy2[(y < 0) | (y > SIDE)] = np.inf
    return int((dx2[:, :, None] + dy2[:, None, :] <= (CUTOFF * SIGMA) ** 2).sum())
