"""Every method on every hard case: which fits stay finite, and end no worse than they began.

Every cell is a call of `eigengs_dr.fit`, as a user makes it.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.cases import Case, chosen_cases
from eigengs_bench.clock import METHODS, Image
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.image.metrics import MAX_PSNR

BASIS = "natural"  # where methods that need a basis start


def run(task: Task, cases: Sequence[str], presets: Sequence[str]) -> list[Row]:
    """Measure every cell of the matrix, case by case, by the named methods."""
    return task.measure("stability", _jobs(task, chosen_cases(cases, task.iterations), presets))


def _jobs(task: Task, cases: Iterable[Case], presets: Sequence[str]) -> Iterator[Job]:
    for case, name in product(cases, presets):
        job = {"case": case.name, "preset": name, "iterations": case.iterations}
        for seed in case.seeds:
            seeded = {"seed": seed} if len(case.seeds) > 1 else {}
            yield {**job, **seeded}, partial(measure_cell, case, name, task.backend, seed)


def measure_cell(case: Case, name: str, backend: str | None, seed: int = 0) -> Row:
    """Fit a case by the method of a name and score it: one cell.

    A row with "needs" alone says what a method lacks. Otherwise "finite" is true if all PSNRs of
    the trace are numbers, and all parameters and pixels of the result are finite; start and end are
    PSNRs of the first and of the last row of the trace.
    """
    image = case.image()
    if needs := _needs(case, image, name, backend):
        return {"needs": needs}
    result = fit_case(case, image, name, backend, seed)
    reached = [row["psnr_ycbcr"] for row in result.trace]
    values = [result.image, *result.gaussians.to_arrays().values()]
    return {
        "finite": not np.isnan(reached).any() and all(np.isfinite(v).all() for v in values),
        "gaussians": len(result.gaussians),
        "seconds": result.seconds,
        "start_ycbcr": min(reached[0], MAX_PSNR),
        "end_ycbcr": min(reached[-1], MAX_PSNR),
    }


def _needs(case: Case, image: Image, name: str, backend: str | None) -> str:
    """Return what a method lacks for a case, or "" if nothing."""
    if not METHODS[name].needs_model:
        return ""
    if case.place is not None or case.space is not None:
        return "a basis of the case"
    pixels = image.shape[0] * image.shape[1]
    fits = len(eg.EigenGS.load(BASIS, backend).gaussians) <= pixels
    return "" if fits else f"a basis with at most {pixels} Gaussians"


def fit_case(
    case: Case, image: Image, name: str, backend: str | None = None, seed: int = 0
) -> eg.Fit:
    """Fit the image of a case by the method of a name, from the start of the case if it has one."""
    method = METHODS[name]
    begun: dict[str, Any] = {"gaussians": case.gaussians}
    if method.needs_model:
        begun = {"start": eg.EigenGS.load(BASIS, backend)}
    elif case.place is not None:  # all of it is kept, so that the descent itself is measured
        begun = {"start": _start(case, image, backend)}
        method = method.without("redistribute")
    return eg.fit(
        image,
        iterations=case.iterations,
        **begun,
        space=case.space,
        method=method.at_rates(case.rates),
        seed=seed,
        backend=backend,
        progress=False,
    )


def _start(case: Case, image: Image, backend: str | None) -> eg.Gaussians:
    assert case.place is not None
    generator = np.random.default_rng(0)
    mean, factor = case.place(image, case.gaussians, generator)
    size, color = (image.shape[1], image.shape[0]), generator.uniform(0, 1, (case.gaussians, 3))
    return eg.Gaussians.from_arrays(mean, factor, color, size=size, backend=backend)


# ---------------------------------------------------------------------------------------------
#  Tables: cases down, methods across, one table a figure
# ---------------------------------------------------------------------------------------------


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out a matrix of cases and methods: PSNRs.

    With several seeds, a cell has the mean, and the range of the ends.
    """
    steps = " or ".join(f"{n:,}" for n in sorted({row["job"]["iterations"] for row in rows}))
    ends = f"PSNR in dB, YCbCr, at the end, from the start; {steps} steps"
    figures = {
        row["job"]["case"]: f"{_decibels(row['end_ycbcr'])} dB"
        for row in rows
        if row["job"]["preset"] == "default" and "end_ycbcr" in row
    }
    charts = {"stability": _heat_map(rows)}
    return fr.Section([_matrix(ends, rows)], charts, figures)


def _heat_map(rows: Sequence[Row]) -> Figure:
    """Draw the PSNR at the end as the colour of a cell: cases down, methods across."""
    lines = [(row["job"]["case"], row["job"]["preset"], row.get("end_ycbcr")) for row in rows]
    ends = pd.DataFrame(lines, columns=["case", "preset", "end"]).astype({"end": float})
    means = ends.groupby(["case", "preset"], sort=False).end.mean().unstack(sort=False)
    figure = fr.new_figure(6.4, 1.4 + 0.27 * len(means), "PSNR in YCbCr at the end / dB")
    axis = figure.subplots()
    mesh = axis.pcolormesh(means, cmap="cividis", vmin=5, vmax=60, edgecolors="white")
    for (y, x), value in np.ndenumerate(means.to_numpy()):
        text = "needs a basis" if np.isnan(value) else _decibels(value)
        dark = value < 30  # of the colours, on which white letters are legible
        axis.text(x + 0.5, y + 0.5, text, ha="center", va="center", color="w" if dark else "k")
    axis.set_xticks(np.arange(means.shape[1]) + 0.5, means.columns)
    axis.set_yticks(np.arange(len(means)) + 0.5, means.index)
    axis.tick_params(length=0, top=True, labeltop=True)
    axis.set(xlabel="method", ylabel="case")
    axis.invert_yaxis()
    figure.colorbar(mesh, extend="max", aspect=40, label="dB")
    return figure


def _matrix(caption: str, rows: Sequence[Row]) -> fr.Table:
    """Arrange the rows in a matrix of cases and methods; the last of equal rows is shown.

    A cell holds the rows of all seeds.
    """
    groups: dict[tuple[str, str], dict[int, Row]] = {}
    for row in rows:
        job = row["job"]
        groups.setdefault((job["case"], job["preset"]), {})[job.get("seed", 0)] = row
    cells = pd.DataFrame(
        [(case, preset, _ends(list(group.values()))) for (case, preset), group in groups.items()],
        columns=["case", "preset", "cell"],
    )
    matrix = cells.pivot(index="case", columns="preset", values="cell").fillna(fr.MISSING)
    matrix = matrix.loc[cells.case.unique(), cells.preset.unique()].reset_index()
    return fr.Table(caption, matrix, "ends")


def _ends(rows: list[Row]) -> str:
    """Write the end and the start; for several seeds the mean, with the range of the ends."""
    if "needs" in rows[0]:
        return f"needs {rows[0]['needs']}"
    if not all(row["finite"] for row in rows):
        return "not finite"
    ends, starts = ([row[f"{when}_ycbcr"] for row in rows] for when in ("end", "start"))
    end = _decibels(float(np.mean(ends)))
    if len(rows) > 1:
        end += f" ({fr.number(min(ends), 2)} to {fr.number(max(ends), 2)})"
    return f"{end} from {_decibels(float(np.mean(starts)))}"


def _decibels(value: float) -> str:
    return "exact" if value == MAX_PSNR else fr.number(value)
