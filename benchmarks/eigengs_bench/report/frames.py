"""Rows as data frames, figures as cells, and tables that name the code of their rows."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from eigengs_bench.harness.store import Row, code_name

MISSING = "-"  # cell of a figure that is not there


class Table(NamedTuple):
    """Texts under headings; the caption says what they are, and what they were measured on."""

    caption: str
    frame: pd.DataFrame


class Section(NamedTuple):
    """Tables of rows, and charts with their captions, by the stem of a file."""

    tables: Sequence[Table] = ()
    charts: Mapping[str, tuple[str, Figure]] = {}


def frame_of(rows: Iterable[Row], key: str = "") -> pd.DataFrame:
    """Lay rows out: a line a row, or a line an entry of the list `key` of the rows that have it.

    Columns are the fields of the jobs, the figures, and "code", the name of the code. Figures of
    fits that have failed, null in the file, are NaN.
    """
    lines = []
    for row in rows:
        figures = {k: v for k, v in row.items() if k not in ("job", "run", key)}
        shared = {**row["job"], **figures, "code": code_name(row["run"])}
        lines += [{**shared, **entry} for entry in (row.get(key, []) if key else [{}])]
    return pd.DataFrame([{k: math.nan if v is None else v for k, v in ln.items()} for ln in lines])


def table(
    caption: str, columns: Iterable[str], lines: Iterable[Sequence[Any]], codes: Iterable[str] = ()
) -> Table:
    """Make a table of lines of texts; `codes` names the code of all rows behind it."""
    return Table(caption + remark(codes), pd.DataFrame(list(lines), columns=list(columns)))


def grouped(caption: str, frame: pd.DataFrame, by: list[str], columns: Mapping[str, Any]) -> Table:
    """Make a table with a line a group: a cell is (column, function that writes its values)."""
    if frame.empty:
        return Table(caption, frame)
    cells = frame.groupby(by, sort=False).agg(**columns).reset_index()
    return Table(caption + remark(frame.code), cells)


def remark(codes: Iterable[str]) -> str:
    """Say that rows are of several commits, or of a tree that was not clean; else ""."""
    known = list(dict.fromkeys(codes))
    if len(known) > 1 or any("uncommitted" in code for code in known):
        kind = "different code" if len(known) > 1 else "code that is in no commit"
        return f" [rows of {kind}: {'; '.join(known)}]"
    return ""


def as_text(table: Table, style: str = "simple") -> str:
    """Lay a table out for a terminal, or for Markdown with the style "pipe"."""
    if table.frame.empty:
        return f"{table.caption}: none"
    sides = ["left", *["right"] * (len(table.frame.columns) - 1)]
    options: Any = {"tablefmt": style, "colalign": sides, "disable_numparse": True}
    return f"{table.caption}\n\n{table.frame.to_markdown(index=False, **options)}"


def number(value: float | None, decimals: int = 1) -> str:
    """Write a figure; `MISSING` for None and NaN, "inf" for infinity."""
    return MISSING if value is None or math.isnan(value) else f"{value:,.{decimals}f}"


def mean(values: pd.Series, decimals: int = 1) -> str:
    """Write the mean of figures. NaN is of fits that have failed: "46.3 (2 failed)"."""
    failed = int(values.isna().sum())
    return number(values.mean(), decimals) + (f" ({failed} failed)" if failed else "")


def spread(values: pd.Series, decimals: int = 1) -> str:
    """Write mean and standard deviation (of a sample) of figures, "46.3 ± 2.1"; see `mean`."""
    first, *failed = mean(values, decimals).split(" ", 1)
    deviation = [f"± {number(values.std(), decimals)}"] if values.count() > 1 else []
    return " ".join([first, *deviation, *failed])


def quartiles(values: pd.Series, decimals: int = 2) -> str:
    """Write the median of times and the range of the middle half: "2.80 (2.71-2.95)"."""
    low, middle, high = (number(values.quantile(q), decimals) for q in (0.25, 0.5, 0.75))
    return middle if values.count() < 2 else f"{middle} ({low}-{high})"


def extent(values: pd.Series, decimals: int = 2) -> str:
    """Write the least and the greatest of some values: "12 to 55"."""
    ends = f"{number(values.min(), decimals)} to {number(values.max(), decimals)}"
    return ends if values.count() else MISSING


def counted(images: pd.Series) -> str:
    """Write how many different images there are: "1 image", "3 images"."""
    return f"{images.nunique()} image" + "s" * (images.nunique() != 1)


def smallest(curve: Mapping[Any, float], target: float) -> float:
    """Interpolate the size at a PSNR, which is taken as linear in the logarithm of the size.

    Between the first two neighbours, by their sizes (Gaussians, or bits), that have the PSNR
    between them; NaN where there are none.
    """
    for (few, low), (many, high) in pairwise(sorted(curve.items())):
        if low <= target <= high:
            share = (target - low) / (high - low) if high > low else 0.0
            return float(few * (many / few) ** share)
    return math.nan
