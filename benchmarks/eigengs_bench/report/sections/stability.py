"""The rows of `stability` as tables: cases down, presets across, one table a figure."""

import math
from collections.abc import Callable, Iterable, Sequence

import pandas as pd

from eigengs_bench.harness.store import Row, code_name
from eigengs_bench.report.frames import MISSING, Section, Table, number, table
from eigengs_dr.image.metrics import MAX_PSNR

TOLERANCE = 0.01  # decibels that an end may lie below its start


def summarize(rows: Sequence[Row]) -> Section:
    """Lay the matrix out, and list what is wrong with default; see `defects`."""
    steps = " or ".join(f"{n:,}" for n in sorted({row["job"]["iterations"] for row in rows}))
    matrix = [_matrix(f"{caption}; {steps} steps", cell, rows) for caption, cell in FIGURES]
    found = [(line,) for line in defects(rows)]
    caption = "Cells of default that are not finite, or end below their start or a shorter run"
    return Section([*matrix, table(caption, ("cell",), found, _codes(rows))])


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


def _codes(rows: Sequence[Row]) -> list[str]:
    return [code_name(row["run"]) for row in rows]


def _matrix(caption: str, cell: Callable[[Row], str], rows: Sequence[Row]) -> Table:
    """Put a figure of every case and preset into a matrix; of equal ones the last is shown."""
    cells = pd.DataFrame([{**row["job"], "cell": cell(row)} for row in rows])
    cells = cells.drop_duplicates(["case", "preset"], keep="last")
    matrix = cells.pivot(index="case", columns="preset", values="cell").fillna(MISSING)
    matrix = matrix.loc[cells.case.unique(), cells.preset.unique()].reset_index()
    return table(caption, matrix, matrix.to_numpy(), _codes(rows))


def _ends(row: Row) -> str:
    if "needs" in row:
        return f"needs {row['needs']}"
    ends = f"{_decibels(row['end_ycbcr'])} from {_decibels(row['start_ycbcr'])}"
    return ends if row["finite"] else "not finite"


def _decibels(value: float | None) -> str:
    return "exact" if value == MAX_PSNR else number(value)


def _ratio(row: Row) -> str:
    value = row.get("condition")
    return number(value, 0) if value is None or value < 1e5 else f"{value:.1e}"


def _half(row: Row) -> str:
    if row.get("half_rgb") is None:
        return MISSING
    return number(round(row["end_rgb"] - row["half_rgb"], 2) + 0.0, 2)  # no "-0.00"


def _cost(row: Row) -> str:
    memory = row.get("peak_gib")
    return number(row.get("seconds"), 1) + (f" ({memory:.1f} GiB)" if memory else "")


# Captions of the tables, and what writes a cell of each.
FIGURES: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("PSNR in dB, YCbCr, at the end, from the start", _ends),
    ("PSNR in dB, 8-bit RGB, at the end", lambda row: _decibels(row.get("end_rgb"))),
    ("dB from the best moment to the last, YCbCr", lambda row: number(row.get("drop_ycbcr"), 2)),
    ("dB that half precision takes, 8-bit RGB", _half),
    ("Highest condition number of a covariance", _ratio),
    ("Tiling, 8-bit levels", lambda row: number(row.get("tiling"), 2)),
    ("Seconds, and the peak of memory", _cost),
)
