"""Rows as data frames, tables and charts, and the sources of their figures."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eigengs_bench.rows import Row, code_name
from eigengs_dr.storage.atomic import atomic_write

TAG = re.compile(rb"<[^>]+>")  # of an SVG file
MISSING = ""  # cell of a missing figure

# Colours that readers who confuse red and green can tell apart (Okabe and Ito, 2008).
BLUE, RED, GREEN, ORANGE = "#0072b2", "#d55e00", "#009e73", "#e69f00"
SKY, PINK, GREY, INK = "#56b4e9", "#cc79a7", "#888888", "#222222"
COLORS = {"default": BLUE, "gaussianimage": RED, "eigengs": GREEN}


class Table(NamedTuple):
    """Cells under headings; the caption says what they are, and what they were measured on.

    Pages of the manual refer to a table by name. It shows `rows`, or all rows of its section.
    """

    caption: str
    frame: pd.DataFrame
    name: str = ""
    rows: Sequence[Row] | None = None


class Section(NamedTuple):
    """Tables of rows, charts by the stem of their file, and figures in sentences by their name."""

    tables: Sequence[Table] = ()
    charts: Mapping[str, Figure] = {}
    figures: Mapping[str, str] = {}


def sources_of(rows: Sequence[Row]) -> list[str]:
    """Describe how rows were measured: each command with its day and commit, and the machine."""
    lines = []
    for run in (row["run"] for row in rows):
        lines.append(f"`{run['command']}`, {run['date'][:10]}, {code_name(run)}")
    for run in (row["run"] for row in rows):
        known = {k: v for k, v in run["versions"].items() if v and not k.endswith("_path")}
        named = ", ".join(f"{name} {version}" for name, version in known.items())
        lines.append(f"{machine_of(run)}; {named}")
    return list(dict.fromkeys(lines))


def machine_of(run: Row) -> str:
    """Name the machine of a run."""
    return f"{run['cpu']}, {run['threads']} threads, backend {run['backend']}"


# ---------------------------------------------------------------------------------------------
#  Tables
# ---------------------------------------------------------------------------------------------


def frame_of(rows: Iterable[Row], key: str = "") -> pd.DataFrame:
    """Lay out rows: a line per row, or per entry of the list `key` of the rows that have it.

    Columns are the fields of the jobs, and the figures. Figures of failed fits, null in the file,
    are NaN.
    """
    lines = []
    for row in rows:
        figures = {k: v for k, v in row.items() if k not in ("bench", "job", "run", key)}
        shared = {**row["job"], **figures}
        lines += [{**shared, **entry} for entry in (row.get(key, []) if key else [{}])]
    return pd.DataFrame([{k: math.nan if v is None else v for k, v in ln.items()} for ln in lines])


def table(
    caption: str, columns: Iterable[str], lines: Iterable[Sequence[Any]], name: str = ""
) -> Table:
    """Make a table from lines of text."""
    return Table(caption, pd.DataFrame(list(lines), columns=list(columns)), name)


def grouped(caption: str, frame: pd.DataFrame, by: list[str], columns: Mapping[str, Any]) -> Table:
    """Make a table with a line per group; a cell is (column, function that formats its values)."""
    if frame.empty:
        return Table(caption, frame)
    cells = frame.groupby(by, sort=False).agg(**columns).reset_index()
    return Table(caption, cells)


def as_text(table: Table, style: str = "simple") -> str:
    """Lay out a table for a terminal, or for Markdown with the style "pipe"."""
    if table.frame.empty:
        return f"{table.caption}: none"
    others = table.frame.columns[1:]
    sides = ["left", *("right" if is_numeric(table.frame[name]) else "left" for name in others)]
    options: Any = {"tablefmt": style, "colalign": sides, "disable_numparse": True}
    return f"{table.caption}\n\n{table.frame.to_markdown(index=False, **options)}"


def is_numeric(cells: pd.Series) -> bool:
    """Return whether the cells of a column begin like numbers, or are empty."""
    return bool(cells.astype(str).str.fullmatch(r"[-+\d].*|").all())


def number(value: float | None, decimals: int = 1) -> str:
    """Write a figure; `MISSING` for None and NaN, "inf" for infinity."""
    return MISSING if value is None or math.isnan(value) else f"{value:,.{decimals}f}"


def mean(values: pd.Series, decimals: int = 1) -> str:
    """Write the mean of figures. NaN stands for failed fits: "46.3 (2 failed)"."""
    failed = int(values.isna().sum())
    return number(values.mean(), decimals) + (f" ({failed} failed)" if failed else "")


def median(values: pd.Series, decimals: int = 2) -> str:
    """Write the median of figures."""
    return number(values.median(), decimals)


def extent(values: pd.Series, decimals: int = 2) -> str:
    """Write the least and the greatest of some values: "12 to 55"."""
    ends = f"{number(values.min(), decimals)} to {number(values.max(), decimals)}"
    return ends if values.count() else MISSING


def counted(images: pd.Series) -> str:
    """Write the number of different images: "1 image", "3 images"."""
    return f"{images.nunique()} image" + "s" * (images.nunique() != 1)


def best(points: pd.DataFrame, size: str) -> pd.DataFrame:
    """Keep the points whose `psnr_rgb` no smaller one reaches, by the column of their size."""
    line = points.sort_values(size)
    return line[line.psnr_rgb > line.psnr_rgb.cummax().shift(fill_value=-math.inf)]


def smallest(curve: Mapping[Any, float], target: float) -> float:
    """Interpolate the size at a PSNR, which is assumed linear in the logarithm of the size.

    It lies between the first two neighbours, by size (Gaussians, or bits), with the PSNR between
    them; NaN if there are none.
    """
    for (few, low), (many, high) in pairwise(sorted(curve.items())):
        if low <= target <= high:
            share = (target - low) / (high - low) if high > low else 0.0
            return float(few * (many / few) ** share)
    return math.nan


# ---------------------------------------------------------------------------------------------
#  Charts: two runs write files alike
# ---------------------------------------------------------------------------------------------


def new_figure(width: float, height: float, title: str = "") -> Figure:
    """Make an empty figure, sides in inches, that arranges its own parts."""
    figure = Figure(figsize=(width, height), layout="constrained")  # not pyplot: no screen
    figure.suptitle(title)
    return figure


# Without a salt, ids in an SVG file are random. Verdana is as wide as DejaVu Sans.
STYLE: Any = {
    "svg.hashsalt": "eigengs_dr",
    "svg.fonttype": "none",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "sans-serif"],
}


def chart_file(figure: Figure, kind: str = "svg") -> bytes:
    """Return the file of a chart, "svg", "png" or "pdf"; text in an SVG file stays text."""
    undated: Any = {"Date": None} if kind == "svg" else None
    with rc_context(STYLE), BytesIO() as file:
        figure.savefig(file, format=kind, dpi=90, metadata=undated)
        content = file.getvalue()
    return TAG.sub(_short, content) if kind == "svg" else content


def _short(tag: re.Match[bytes]) -> bytes:
    """Round the numbers of a tag to hundredths, join its lines, and drop rotations by 0."""
    short = re.sub(rb"(\d\.\d\d)\d+", rb"\1", tag[0])
    return b" ".join(re.sub(rb' transform="rotate\(-0 [^"]*"', b"", short).split())


def save_figure(path: Path, figure: Figure) -> None:
    """Write a chart as .svg, .png or .pdf, whole or not at all."""
    content = chart_file(figure, path.suffix[1:])
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def label_axes(
    axis: Axes, x: str, y: str, logarithmic: str = "x", legend: bool = True, **rest: Any
) -> None:
    """Label the axes, give some of them logarithmic scales with plain numbers, add a legend."""
    labels = {"x": x, "y": y}
    for side in logarithmic:
        getattr(axis, f"set_{side}scale")("log", subs=(2, 5))
        getattr(axis, f"{side}axis").set_major_formatter("{x:,g}")
        getattr(axis, f"{side}axis").set_minor_formatter("{x:,g}")
        labels[side] += " (log)"
    axis.set(xlabel=labels["x"], ylabel=labels["y"], **rest)
    axis.grid(alpha=0.3)
    if legend:
        axis.legend(fontsize=8, framealpha=0.6)


def legend_beside(figure: Figure, axis: Axes) -> None:
    """Draw the legend of an axis once, to the right of all axes of a figure."""
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center", fontsize=8)


def legend_below(figure: Figure, axis: Axes, columns: int) -> None:
    """Draw the legend of an axis once, below all axes of a figure."""
    named = axis.get_legend_handles_labels()
    figure.legend(*named, loc="outside lower center", fontsize=8, ncols=columns)
