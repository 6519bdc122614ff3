"""The table that the field compares in: fits of the Kodak photos by numbers of Gaussians and steps.

A row has psnr_float, the PSNR in RGB of float pixels clamped to [0, 1], which is the metric of the
published figures; psnr_rgb, of 8-bit pixels; psnr_ycbcr, ms_ssim, and the seconds of the fit. The
seconds count where the job is "timed": nothing else ran on the machine.
"""

from collections.abc import Iterator, Sequence
from functools import cache, partial
from itertools import product

import numpy as np

from eigengs_bench.harness.datasets import images_of
from eigengs_bench.harness.store import Job, Row, Task
from eigengs_bench.harness.timing import Image, decibels
from eigengs_bench.names import SOLVE_STEPS
from eigengs_dr.fitting.fit import fit
from eigengs_dr.image.metrics import ms_ssim

FILE, SET = "kodak.jsonl", "kodak"

# The metric is of RGB. On 9 training photos (5 of scikit-image, 4 of cats) fits in RGB gain 0.06,
# 0.05, 0.13, 0.46 and 0.57 dB in it with 0.0127, 0.0254, 0.076, 0.127 and 0.178 Gaussians a pixel.
COLOR = "rgb"
WARM_UP = 200  # untimed steps on a small image: as many compile all programs of a fit
SMALL, FEW = 64, 100  # pixels of a side, Gaussians


def run(
    task: Task, counts: Sequence[int], steps: Sequence[int], solve_steps: int, timed: bool
) -> list[Row]:
    """Fit the photos by each number of Gaussians, with each number of steps."""
    return task.measure(FILE, list(_jobs(task, counts, steps, solve_steps, timed)), SET)


def _jobs(
    task: Task, counts: Sequence[int], steps: Sequence[int], solve_steps: int, timed: bool
) -> Iterator[Job]:
    """Name the fits: all of the first number of steps before the next, photo by photo."""
    photos = images_of(task, SET)

    @cache
    def compile_programs() -> None:
        for _, photo in photos[:1]:
            small = np.ascontiguousarray(photo[:SMALL, :SMALL])
            fit(small, FEW, WARM_UP, space=COLOR, seed=task.seed, backend=task.backend)

    def work(image: Image, count: int, iterations: int) -> Row:
        compile_programs()
        return _measure(task, image, count, iterations, solve_steps)

    shared: Row = {"set": SET, "space": COLOR, "seed": task.seed, "timed": timed}
    if solve_steps != SOLVE_STEPS:
        shared["solve_steps"] = solve_steps
    for iterations, (file, image), count in product(steps, photos, counts):
        name = {**shared, "image": file, "gaussians": count, "iterations": iterations}
        yield name, partial(work, image, count, iterations)


def _measure(task: Task, image: Image, count: int, iterations: int, solve_steps: int) -> Row:
    shared: Row = {"space": COLOR, "seed": task.seed, "backend": task.backend}
    found = fit(image, count, iterations, solve_steps=solve_steps, **shared)
    return {
        "psnr_float": decibels(np.clip(found.image, 0, 1), image, "data"),
        "psnr_rgb": decibels(found.image, image, "rgb"),
        "psnr_ycbcr": decibels(found.image, image, "ycbcr"),
        "ms_ssim": ms_ssim(found.image, image),
        "seconds": found.seconds,
        "taken": found.iterations,
    }
