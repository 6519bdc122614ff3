"""Tables of results: one form for the terminal, for Markdown and for a web page."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..storage.atomic import atomic_write

MISSING = "-"
"""Cell of a figure that is not there."""


class Table(NamedTuple):
    """Cells as they are read.

    Attributes
    ----------
    caption : str
        What the cells are, with their unit, and what they were measured on.
    columns : tuple of str
        Headings.
    rows : sequence of tuple of str
        One cell a column. A cell that is a figure begins with it: "46.3 ± 2.1".
    """

    caption: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def number(value: float | None, decimals: int = 1) -> str:
    """Write a figure; `MISSING` for None and NaN, "inf" for what is not finite."""
    if value is None or math.isnan(value):
        return MISSING
    return f"{value:,.{decimals}f}"


def mean(values: Sequence[float | None], decimals: int = 1) -> str:
    """Write the mean of figures.

    None and what is not finite are of fits that have failed: the cell tells how many, "46.3 (2
    failed)".
    """
    known, failed = _known(values)
    return (number(float(np.mean(known)), decimals) if known else MISSING) + failed


def spread(values: Sequence[float | None], decimals: int = 1) -> str:
    """Write mean and standard deviation (of a sample) of figures, "46.3 ± 2.1"; see `mean`."""
    known, failed = _known(values)
    if len(known) < 2:
        return mean(values, decimals)
    deviation = number(float(np.std(known, ddof=1)), decimals)
    return f"{number(float(np.mean(known)), decimals)} ± {deviation}{failed}"


def _known(values: Sequence[float | None]) -> tuple[list[float], str]:
    """Figures that are there, and how many are not."""
    known = [value for value in values if value is not None and math.isfinite(value)]
    return known, f" ({len(values) - len(known)} failed)" if len(known) < len(values) else ""


def median(values: Sequence[float], decimals: int = 2) -> str:
    """Write the median of times and the range of the middle half: "2.80 (2.71-2.95)"."""
    if not values:
        return MISSING
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    if len(values) == 1:
        return number(middle, decimals)
    return f"{number(middle, decimals)} ({number(low, decimals)}-{number(high, decimals)})"


def as_text(table: Table) -> str:
    """Lay a table out for a terminal, columns under their headings."""
    lines = [table.columns, *table.rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    laid = [
        "  ".join(
            cell.rjust(width) if k else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
    ruler = "-" * max(map(len, laid))
    return "\n".join([table.caption, "", laid[0], ruler, *laid[1:]])


def save_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a file of comma-separated values, all or nothing.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(columns)
        lines.writerows(rows)
