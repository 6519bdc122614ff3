"""Hard cases times presets: which stay finite, and end no worse than they were."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.cases import Case, chosen_cases
from eigengs_bench.clock import Image, Moment, decibels, follow
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.refine import trace_steps
from eigengs_dr.fitting.solve import solve
from eigengs_dr.fitting.start import initialize, mean_picture
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.metrics import MAX_PSNR

BASIS = "natural"  # where presets that need a basis start


def run(task: Task, cases: Sequence[str], presets: Sequence[str]) -> list[Row]:
    """Measure every cell of the matrix, case by case."""
    return task.measure("stability", _jobs(task, chosen_cases(cases, task.iterations), presets))


def _jobs(task: Task, cases: Iterable[Case], presets: Sequence[str]) -> Iterator[Job]:
    for case, name in product(cases, presets):
        job = {"case": case.name, "preset": name, "iterations": case.iterations}
        yield job, partial(measure_cell, case, name, task.backend)


def measure_cell(case: Case, preset: str, backend: str | None) -> Row:
    """Run a case by a preset and score it: one cell.

    "needs", alone, says what a preset lacks. Else "finite" is true if all parameters and pixels are
    finite at all marks of `trace_steps`; start and end are PSNRs of the first and of the last
    moment.
    """
    image = case.image()
    most = image.shape[0] * image.shape[1]
    encodes = PRESETS[preset].mean == "dense" and case.place is None
    if encodes and len(eg.EigenGS.load(BASIS, backend).gaussians) > most:
        return {"needs": f"a basis with at most {most} Gaussians"}
    followed = moments(case, image, preset, backend)
    finite = [np.isfinite(moment.picture).all() for moment in followed]
    for moment in followed:
        finite += [np.isfinite(values).all() for values in moment.gaussians.to_arrays().values()]
    return {
        "finite": all(finite),
        "gaussians": len(followed[0].gaussians),
        "seconds": followed[-1].seconds,
        "start_ycbcr": decibels(followed[0].picture, image, "ycbcr"),
        "end_ycbcr": decibels(followed[-1].picture, image, "ycbcr"),
    }


def moments(case: Case, image: Image, preset: str, backend: str | None = None) -> list[Moment]:
    """Follow the descent of a preset on the image of a case, at the marks of `trace_steps`.

    It starts as the preset does, or in its way from the shapes of the case.
    """
    method, marks = PRESETS[preset], trace_steps(case.iterations)
    rates = {name: case.rates * rate for name, rate in method.schedule.rates.items()}
    schedule = replace(method.schedule, rates=rates)
    if case.place is not None:
        start = partial(_start, case, image, method.solves, backend)
        return list(follow(start, schedule, case.iterations, marks))
    encodes = method.mean == "dense"
    model, count = (eg.EigenGS.load(BASIS, backend), None) if encodes else (None, case.gaussians)
    options = FitOptions(gaussians=count, start=model, preset=preset, backend=backend)
    mean_image = mean_picture(options, image.shape[1], image.shape[0])
    begin = partial(initialize, image, options)
    return list(follow(begin, schedule, case.iterations, marks, mean_image))


def _start(case: Case, image: Image, solves: bool, backend: str | None) -> FitProblem:
    assert case.place is not None
    target, generator = rgb_to_ycbcr(image), np.random.default_rng(0)
    mean, factor = case.place(image, case.gaussians, generator)
    size, shape = (image.shape[1], image.shape[0]), (case.gaussians, 3)
    colors = np.zeros(shape) if solves else generator.uniform(0, 1, shape)
    start = eg.Gaussians.from_arrays(mean, factor, colors, size=size, backend=backend).bounded()
    return FitProblem(solve(start, target) if solves else start, target)


# ---------------------------------------------------------------------------------------------
#  Tables: cases down, presets across, one table a figure
# ---------------------------------------------------------------------------------------------


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out two matrices of cases and presets: PSNRs, and seconds."""
    steps = " or ".join(f"{n:,}" for n in sorted({row["job"]["iterations"] for row in rows}))
    ends = f"PSNR in dB, YCbCr, at the end, from the start; {steps} steps"
    costs = _matrix("Seconds", lambda row: fr.number(row.get("seconds")), rows, "costs")
    return fr.Section([_matrix(ends, _ends, rows, "ends"), costs])


def _matrix(caption: str, cell: Callable[[Row], str], rows: Sequence[Row], name: str) -> fr.Table:
    """Put a figure of every case and preset into a matrix; of equal ones the last is shown."""
    cells = pd.DataFrame([{**row["job"], "cell": cell(row)} for row in rows])
    cells = cells.drop_duplicates(["case", "preset"], keep="last")
    matrix = cells.pivot(index="case", columns="preset", values="cell").fillna(fr.MISSING)
    matrix = matrix.loc[cells.case.unique(), cells.preset.unique()].reset_index()
    return fr.Table(caption, matrix, name)


def _ends(row: Row) -> str:
    if "needs" in row:
        return f"needs {row['needs']}"
    ends = f"{_decibels(row['end_ycbcr'])} from {_decibels(row['start_ycbcr'])}"
    return ends if row["finite"] else "not finite"


def _decibels(value: float | None) -> str:
    return "exact" if value == MAX_PSNR else fr.number(value)
