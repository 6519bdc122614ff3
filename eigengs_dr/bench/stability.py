"""Hard cases times presets: what stays finite, and what ends no worse than it started."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.registry import load_basis
from ..fitting.initializers import FitProblem, initialize
from ..fitting.presets import PRESETS, Preset
from ..fitting.refine import trace_steps
from ..fitting.solvers.conjugate_gradient import solve
from ..gaussian.gaussians import Gaussians
from ..image.color import rgb_to_ycbcr
from ..image.metrics import MAX_PSNR
from ..raster.render import picture_of
from .cases import Case
from .rows import Job, Row
from .table import MISSING, Table, number
from .tiling import tiling
from .trial import Moment, decibels, follow

Image = NDArray[np.float32]

BASIS = "natural"
"""What presets that need a basis start from."""

TOLERANCE = 0.01
"""Decibels that an end may lie below its start."""

NOT_FINITE = "not finite"


# ---------------------------------------------------------------------------------------------
#  Measuring
# ---------------------------------------------------------------------------------------------


def jobs(
    cases: Iterable[Case], presets: Sequence[str], seed: int = 0, backend: str | None = None
) -> list[Job]:
    """Name the cells of the matrix, for `eigengs_dr.bench.rows.measure`.

    Parameters
    ----------
    cases : iterable of Case
    presets : sequence of str
        Names of `PRESETS`.
    seed : int, optional
    backend : {"llvm", "cuda"}, optional

    Returns
    -------
    list of Job
        Case by case; what they return is told by `measured`.
    """
    return [
        (
            {"case": case.name, "preset": name, "seed": seed, "iterations": case.iterations},
            partial(_alone if case.alone else measured, case, name, seed, backend),
        )
        for case in cases
        for name in presets
    ]


def measured(case: Case, preset: str, seed: int, backend: str | None) -> Row:
    """Run a case by a preset and judge it: one cell.

    Returns
    -------
    dict
        ``needs``, what is missing, alone where the preset cannot run. Else ``finite``, whether all
        parameters and pixels were at all marks of `trace_steps`; ``start_S``, ``end_S`` and
        ``half_S``, the PSNR in dB of the first and of the last moment and of the last set in half
        precision, with S one of ycbcr and rgb, at most `MAX_PSNR`; ``drop_S``, from the best moment
        to the last; ``condition``, the highest of a covariance at a mark; ``tiling``, see that
        module; ``gaussians``, how many; ``seconds``, without what the judgement takes; and, of a
        case that is alone, ``peak_gib``, the most memory that the process had, pictures to judge
        included.
    """
    image = case.image()
    most = image.shape[0] * image.shape[1]
    if _encodes(case, PRESETS[preset]) and len(load_basis(BASIS, backend).gaussians) > most:
        return {"needs": f"a basis with at most {most} splats"}
    followed = moments(case, image, preset, seed, backend)
    memory = {"peak_gib": _peak()} if case.alone else {}  # before the judgement takes its own
    return {**_judged(followed, image), **memory}


def moments(
    case: Case, image: Image, preset: str, seed: int, backend: str | None = None
) -> list[Moment]:
    """Follow the descent of a preset on the image of a case, at the marks of `trace_steps`."""
    method = PRESETS[preset]
    rates = {name: case.rates * rate for name, rate in method.schedule.rates.items()}
    schedule = replace(method.schedule, rates=rates)
    start = partial(_start, case, image, method, seed, backend)
    return list(follow(start, schedule, case.iterations, trace_steps(case.iterations)))


def condition(factor: NDArray[np.floating]) -> float:
    """Return the highest condition number of covariances ``(F^T F)^-1``, ``F = [[a, b], [0, c]]``.

    With t the trace and ``d = (a c)^2`` the determinant of ``F^T F``, its larger eigenvalue is
    ``l = (t + sqrt(t^2 - 4 d)) / 2``, and the ratio of both is ``l^2 / d``.

    Parameters
    ----------
    factor : ndarray, shape (N, 3)
        a, b, c.
    """
    a, b, c = factor.astype(np.float64).T
    t = a * a + b * b + c * c
    # t^2 - 4 d without cancellation: 1 for round splats, not NaN.
    root = np.sqrt(((a - c) ** 2 + b * b) * ((a + c) ** 2 + b * b))
    return float(np.max(((t + root) / (2 * a * c)) ** 2))


def _encodes(case: Case, method: Preset) -> bool:
    return method.init == "eigen" and case.place is None


def _start(case: Case, image: Image, method: Preset, seed: int, backend: str | None) -> FitProblem:
    """Start as the preset does, or in its way from the shapes of the case."""
    if case.place is None:
        count = None if _encodes(case, method) else case.gaussians
        return initialize(image, count, "auto", BASIS, method, seed=seed, backend=backend)
    target, generator = rgb_to_ycbcr(image), np.random.default_rng(seed)
    mean, factor = case.place(image, case.gaussians, generator)
    size, shape = (image.shape[1], image.shape[0]), (case.gaussians, 3)
    colors = np.zeros(shape) if method.solves else generator.uniform(0, 1, shape)
    start = Gaussians.from_arrays(mean, factor, colors, size=size, backend=backend).bounded()
    return FitProblem(solve(start, target).gaussians if method.solves else start, target)


def _judged(followed: list[Moment], image: Image) -> Row:
    first, last = followed[0], followed[-1]
    arrays = [moment.gaussians.to_arrays() for moment in followed]
    finite = [np.isfinite(moment.picture).all() for moment in followed]
    finite += [np.isfinite(values).all() for kept in arrays for values in kept.values()]
    # What a descent adds to its set, the dense mean, is not stored with it.
    added = last.picture - picture_of(last.gaussians)
    half = picture_of(_halved(last.gaussians)) + added
    row: Row = {
        "finite": all(finite),
        "condition": max(condition(kept["factor"]) for kept in arrays),
        "tiling": tiling(last.picture, image),
        "gaussians": len(first.gaussians),
        "seconds": last.seconds,
    }
    for space in ("ycbcr", "rgb"):
        # Above EXACT there is rounding only: no drop. NaN stays.
        seen = [decibels(m.picture, image, space) for m in followed]
        row[f"start_{space}"], row[f"end_{space}"] = float(seen[0]), float(seen[-1])
        row[f"drop_{space}"] = float(np.max(seen) - seen[-1])
        row[f"half_{space}"] = decibels(half, image, space)
    return row


def _halved(gaussians: Gaussians) -> Gaussians:
    """Round all parameters to half precision."""

    def half(values: Any) -> Any:
        return type(values)(dr.float16_array_t(type(values))(values))

    return replace(
        gaussians,
        mean=half(gaussians.mean),
        factor=half(gaussians.factor),
        color=half(gaussians.color),
        background=half(gaussians.background),
    )


def _alone(case: Case, preset: str, seed: int, backend: str | None) -> Row:
    """Measure a cell in a new process, whose peak of memory is then that of the cell."""
    try:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            return pool.submit(measured, case, preset, seed, backend).result()
    except BrokenProcessPool:
        raise ValueError(
            f"case {case.name!r}: its process was ended, as it is where memory runs out; "
            "free some, or leave the case out"
        ) from None


def _peak() -> float | None:
    """Most memory that this process has had, in GiB; None on Windows, which does not tell."""
    if sys.platform == "win32":
        return None
    import resource

    unit = 1 if sys.platform == "darwin" else 1 << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / (1 << 30)


# ---------------------------------------------------------------------------------------------
#  Telling
# ---------------------------------------------------------------------------------------------


def defects(rows: Iterable[Row], preset: str = "default") -> list[str]:
    """Name the cells of a preset that are not finite, or end below their start: one line each.

    An end counts as below if its psnr_ycbcr is by more than `TOLERANCE`, both at most `MAX_PSNR`.

    Parameters
    ----------
    rows : iterable of dict
        As `eigengs_dr.bench.rows.measure` returns them for `jobs`.
    preset : str, optional
    """
    found = []
    for row in rows:
        if row["job"]["preset"] != preset or "needs" in row:
            continue
        if not row["finite"]:
            found.append(f"{row['job']['case']}: {NOT_FINITE}")
        elif (lost := row["start_ycbcr"] - row["end_ycbcr"]) > TOLERANCE:
            found.append(f"{row['job']['case']}: ends {lost:.2f} dB below its start")
    return found


def tables(rows: Sequence[Row]) -> list[Table]:
    """Lay the matrix out: cases down, presets across, one table a figure.

    Parameters
    ----------
    rows : sequence of dict
        As for `defects`.
    """
    counts = sorted({row["job"]["iterations"] for row in rows})
    steps = " or ".join(f"{count:,}" for count in counts)
    return [_table(f"{caption}; {steps} steps", cell, rows) for caption, cell in FIGURES]


def _table(caption: str, cell: Callable[[Row], str], rows: Sequence[Row]) -> Table:
    cells = {(row["job"]["case"], row["job"]["preset"]): cell(row) for row in rows}
    cases, presets = (tuple(dict.fromkeys(names)) for names in zip(*cells, strict=True))
    lines = [(case, *(cells.get((case, name), MISSING) for name in presets)) for case in cases]
    return Table(caption, ("case", *presets), lines)


def _ends(row: Row) -> str:
    if "needs" in row:
        return f"needs {row['needs']}"
    if not row["finite"]:
        return NOT_FINITE
    return f"{_decibels(row['end_ycbcr'])} from {_decibels(row['start_ycbcr'])}"


def _decibels(value: float | None) -> str:
    return "exact" if value == MAX_PSNR else number(value)


def _ratio(value: float | None) -> str:
    return number(value, 0) if value is None or value < 1e5 else f"{value:.1e}"


def _of(key: str, write: Callable[[float | None], str]) -> Callable[[Row], str]:
    """Make the writer of a figure that may be missing."""
    return lambda row: write(row.get(key))


def _stored(row: Row) -> str:
    """Decibels that half precision takes from the end."""
    if row.get("half_rgb") is None:
        return MISSING
    return number(round(row["end_rgb"] - row["half_rgb"], 2) + 0.0, 2)  # no "-0.00"


def _cost(row: Row) -> str:
    memory = row.get("peak_gib")
    return number(row.get("seconds"), 1) + (f" ({memory:.1f} GiB)" if memory else "")


FIGURES: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("PSNR in dB, YCbCr, at the end, from the start", _ends),
    ("PSNR in dB, 8-bit RGB, at the end", _of("end_rgb", _decibels)),
    ("dB from the best moment to the last, YCbCr", _of("drop_ycbcr", partial(number, decimals=2))),
    ("dB that half precision takes, 8-bit RGB", _stored),
    ("Highest condition number of a covariance", _of("condition", _ratio)),
    ("Tiling, 8-bit levels", _of("tiling", partial(number, decimals=2))),
    ("Seconds, and the peak of memory", _cost),
)
"""Captions of the tables, and what writes a cell of each."""
