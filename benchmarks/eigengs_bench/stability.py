"""Hard cases times presets: which stay finite, and end no worse than they or shorter runs were."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.cases import Case, chosen_cases
from eigengs_bench.clock import Image, Moment, decibels, follow
from eigengs_bench.rows import Job, Row, Task, alone, code_name, peak_gib
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import PRESETS, FitOptions
from eigengs_dr.fitting.refine import trace_steps
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.fitting.start import initialize, mean_picture
from eigengs_dr.gaussian.covariance import max_deviation
from eigengs_dr.image.color import RGB_TO_YCBCR, rgb_to_ycbcr
from eigengs_dr.image.metrics import MAX_PSNR

BASIS = "natural"  # where presets that need a basis start
TOLERANCE = 0.01  # decibels that an end may lie below its start


def run(task: Task, cases: Sequence[str], presets: Sequence[str]) -> list[Row]:
    """Measure every cell of the matrix, case by case."""
    return task.measure("stability", _jobs(task, chosen_cases(cases, task.iterations), presets))


def _jobs(task: Task, cases: Iterable[Case], presets: Sequence[str]) -> Iterator[Job]:
    for case, name in product(cases, presets):
        work = partial(measure_cell, case, name, task.backend)
        job = {"case": case.name, "preset": name, "iterations": case.iterations}
        yield job, alone(f"case {case.name!r}", work) if case.alone else work


def measure_cell(case: Case, preset: str, backend: str | None) -> Row:
    """Run a case by a preset and score it: one cell.

    "needs", alone, says what a preset lacks. Else "finite" is true if all parameters and pixels are
    finite at all marks of `trace_steps`; start and end are PSNRs of the first and of the last
    moment, drop is the loss from the best moment to the last;
    "condition" is the highest of a covariance, "peak_gib" the memory of a case in its own process,
    "shorter_ycbcr" the PSNR at the end of a run of the shorter number of steps of the case.
    """
    image = case.image()
    most = image.shape[0] * image.shape[1]
    encodes = PRESETS[preset].mean == "dense" and case.place is None
    if encodes and len(eg.EigenGS.load(BASIS, backend).gaussians) > most:
        return {"needs": f"a basis with at most {most} Gaussians"}
    followed = moments(case, image, preset, backend)
    memory = {"peak_gib": peak_gib()} if case.alone else {}  # before the judgement takes its own
    row = {**_score(followed, image), **memory}
    if case.shorter:
        shorter = moments(case._replace(iterations=case.shorter), image, preset, backend)
        row["shorter_ycbcr"] = decibels(shorter[-1].picture, image, "ycbcr")
    return row


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
    return FitProblem(solve(start, target).gaussians if solves else start, target)


def _score(followed: list[Moment], image: Image) -> Row:
    first, last = followed[0], followed[-1]
    arrays = [moment.gaussians.to_arrays() for moment in followed]
    finite = [np.isfinite(moment.picture).all() for moment in followed]
    finite += [np.isfinite(values).all() for kept in arrays for values in kept.values()]
    row: Row = {
        "finite": all(finite),
        "condition": max(_condition(*kept["factor"].T) for kept in arrays),
        "tiling": tiling(last.picture, image),
        "gaussians": len(first.gaussians),
        "seconds": last.seconds,
    }
    for space in ("ycbcr", "rgb"):
        # Above EXACT there is rounding only: no drop. NaN stays.
        seen = [decibels(m.picture, image, space) for m in followed]
        row[f"start_{space}"], row[f"end_{space}"] = float(seen[0]), float(seen[-1])
        row[f"drop_{space}"] = float(np.max(seen) - seen[-1])
    return row


def _condition(a: Image, b: Image, c: Image) -> float:
    """Return the largest condition number of covariances with the factors a, b, c."""
    # The determinant of a covariance, the product of its eigenvalues, is 1 / (a c)^2.
    deviation = max_deviation(*(entries.astype(np.float64) for entries in (a, b, c)))
    return float(np.square(np.square(deviation) * a * c).max())


# ---------------------------------------------------------------------------------------------
#  Penny-round tiles: Gaussians that show where an image is smooth
# ---------------------------------------------------------------------------------------------

# Weights of R, G and B in the luma of ITU-R BT.601, where 1 is white.
LUMA = RGB_TO_YCBCR[0] / RGB_TO_YCBCR[0].sum()
# Standard deviation in pixels of the blur that takes tiles away: it leaves 0.2 % of a wave of 7
# pixels, the distance of 5,000 Gaussians on 512x512, and 93 % of one of 64.
BLUR = 4.0
# Where an image differs by more from its own blur, in 8-bit levels, it has content that hides
# tiles, and errors beside edges are none. Rounding to 8 bits stays below.
DETAIL = 2.0


def tiling(picture: Image, image: Image) -> float:
    """Measure fine errors in the smooth regions of an image, in 8-bit levels.

    With ``r`` the luma of ``picture - image``, G a Gaussian blur of `BLUR` pixels and S the pixels
    around which nothing differs by `DETAIL` from its blur, it is ``255 sqrt(mean over S of
    (r - G r)^2)``: linear in the error, blind to slow errors such as a wrong shade, 0 for equal
    pictures, NaN where nothing is smooth.

    Examples
    --------
    >>> image = np.full((32, 32, 3), 0.5)
    >>> round(tiling(image + 0.01 * (np.indices((32, 32)).sum(0) % 2)[..., None], image), 1)
    1.3
    """
    reach = 2 * round(2 * BLUR) + 1  # the blur carries errors of content as far
    smooth = maximum_filter(255 * np.abs(_fine(image @ LUMA)), reach, mode="nearest") <= DETAIL
    if not smooth.any():
        return float("nan")
    return 255 * float(np.sqrt(np.mean(np.square(_fine((picture - image) @ LUMA)[smooth]))))


def _fine(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    plane = plane.astype(np.float64)
    return plane - gaussian_filter(plane, BLUR)


# ---------------------------------------------------------------------------------------------
#  Tables: cases down, presets across, one table a figure
# ---------------------------------------------------------------------------------------------


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay the matrix out, and list what is wrong with default; see `defects`."""
    steps = " or ".join(f"{n:,}" for n in sorted({row["job"]["iterations"] for row in rows}))
    matrix = [
        _matrix(f"{caption}; {steps} steps", cell, rows, name)
        for name, (caption, cell) in FIGURES.items()
    ]
    found, codes = [(line,) for line in defects(rows)], [code_name(row["run"]) for row in rows]
    caption = "Cells of default that are not finite, or end below their start or a shorter run"
    return fr.Section([*matrix, fr.table(caption, ("cell",), found, codes)])


def defects(rows: Iterable[Row]) -> list[str]:
    """Name the cells of default that are not finite, or end too low: one line each.

    Too low is below their start, or below the end of a run that was asked for fewer steps.
    """
    found = []
    for row in (row for row in rows if row["job"]["preset"] == "default" and "needs" not in row):
        if not row["finite"]:
            found.append(f"{row['job']['case']}: not finite")
        elif (lost := row["start_ycbcr"] - row["end_ycbcr"]) > TOLERANCE:
            found.append(f"{row['job']['case']}: ends {lost:.2f} dB below its start")
        elif (lost := row.get("shorter_ycbcr", -math.inf) - row["end_ycbcr"]) > TOLERANCE:
            found.append(f"{row['job']['case']}: ends {lost:.2f} dB below a run of fewer steps")
    return found


def _matrix(caption: str, cell: Callable[[Row], str], rows: Sequence[Row], name: str) -> fr.Table:
    """Put a figure of every case and preset into a matrix; of equal ones the last is shown."""
    cells = pd.DataFrame([{**row["job"], "cell": cell(row)} for row in rows])
    cells = cells.drop_duplicates(["case", "preset"], keep="last")
    matrix = cells.pivot(index="case", columns="preset", values="cell").fillna(fr.MISSING)
    matrix = matrix.loc[cells.case.unique(), cells.preset.unique()].reset_index()
    codes = [code_name(row["run"]) for row in rows]
    return fr.table(caption, matrix, matrix.to_numpy(), codes, name)


def _ends(row: Row) -> str:
    if "needs" in row:
        return f"needs {row['needs']}"
    ends = f"{_decibels(row['end_ycbcr'])} from {_decibels(row['start_ycbcr'])}"
    return ends if row["finite"] else "not finite"


def _decibels(value: float | None) -> str:
    return "exact" if value == MAX_PSNR else fr.number(value)


def _ratio(row: Row) -> str:
    value = row.get("condition")
    return fr.number(value, 0) if value is None or value < 1e5 else f"{value:.1e}"


def _cost(row: Row) -> str:
    memory = row.get("peak_gib")
    return fr.number(row.get("seconds"), 1) + (f" ({memory:.1f} GiB)" if memory else "")


# Names and captions of the tables, and what writes a cell of each.
FIGURES: dict[str, tuple[str, Callable[[Row], str]]] = {
    "ends": ("PSNR in dB, YCbCr, at the end, from the start", _ends),
    "drops": (
        "dB from the best moment to the last, YCbCr",
        lambda row: fr.number(row.get("drop_ycbcr"), 2),
    ),
    "conditions": ("Highest condition number of a covariance", _ratio),
    "tiling": ("Tiling, 8-bit levels", lambda row: fr.number(row.get("tiling"), 2)),
    "costs": ("Seconds, and the peak of memory", _cost),
}
