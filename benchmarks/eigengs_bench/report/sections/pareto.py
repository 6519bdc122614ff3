"""Points and tables of speed against accuracy, from the rows that `pareto` measured."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import pandas as pd

from eigengs_bench.experiments.pareto import WIDE
from eigengs_bench.harness.store import Row
from eigengs_bench.report.frames import (
    MISSING,
    Chart,
    Table,
    Told,
    counted,
    frame_of,
    number,
    quartiles,
    remark,
    spread,
    table,
)
from eigengs_bench.report.sections.pareto_charts import kernels_chart, set_chart, storage_chart

POINT = ["knob", "value", "iteration", "gaussians"]
"""Columns that name a point: a variant after some steps."""

UNCUT = f"YCbCr at {WIDE:g} sigma"
"""Column of the PSNR of splats that are shown as if they were not cut off."""


def tell(rows: Sequence[Row]) -> Told:
    """Lay out what was measured: a table and a chart a set, of storage, and of the renderer.

    Parameters
    ----------
    rows : sequence of dict
        Of `eigengs_bench.experiments.pareto.run`.
    """
    fits, stored = frame_of(rows, "trace"), frame_of(rows, "stored")
    kernels = frame_of(rows, "kernels")
    tables, charts, drawn = [], list[Chart](), {}
    for name, part in fits.groupby("set", sort=False) if len(fits) else ():
        points = points_of(part)
        drawn[f"pareto-{name}"] = points
        tables.append(_variants_table(str(name), part, points))
        caption = "All fits of a set, and the same by setting. The grey band is the front of all, "
        caption += f"the dashed line that of fits with as many Gaussians.{remark(part.code)}"
        charts.append(Chart(f"pareto-{name}", caption, set_chart(points, str(name))))
    if len(stored):
        tables.append(_storage_table(stored))
        caption = f"The default fits, stored in fewer bits a parameter.{remark(stored.code)}"
        charts.append(Chart("pareto-storage", caption, storage_chart(stored)))
    if len(kernels):
        tables.append(_kernels_table(kernels))
        caption = f"The renderer: error over time, by cutoff.{remark(kernels.code)}"
        charts.append(Chart("pareto-kernels", caption, kernels_chart(kernels)))
    return Told(tables, charts, drawn)


def points_of(fits: pd.DataFrame) -> pd.DataFrame:
    """Gather the images of a set, and find the fronts.

    Parameters
    ----------
    fits : DataFrame
        Of one set, a line a fit and number of steps.

    Returns
    -------
    DataFrame
        A line a point: `POINT`, the median of "seconds", the means of the PSNRs (NaN where a fit
        has failed), the number of "images", and as 0 or 1 whether it is on the "front" of all
        points, and on "front_same", that of those with as many Gaussians as the default fit.
    """
    mean = ("psnr_ycbcr", "psnr_rgb", "psnr_wide")
    found = fits.groupby(POINT, sort=False).agg(
        seconds=("seconds", "median"),
        **{key: (key, lambda values: values.mean(skipna=False)) for key in mean},
        images=("seconds", "size"),
    )
    found = found.reset_index()
    same = found.gaussians.isin(found.gaussians[found.value == "default"])
    found["front"] = _on_front(found).astype(int)
    found["front_same"] = 0
    found.loc[same, "front_same"] = _on_front(found[same]).astype(int)
    return found


def _on_front(points: pd.DataFrame) -> pd.Series:
    places = list(zip(points.seconds, points.psnr_ycbcr, strict=True))
    best = set(front(places))
    return pd.Series([place in best for place in places], points.index)


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Find the Pareto front: points of which none is as fast and better, or faster and as good.

    Parameters
    ----------
    points : sequence of (float, float)
        Seconds and PSNR; those with NaN are on no front.

    Returns
    -------
    list of (float, float)
        From the fastest to the best; of equal points one.
    """
    best, kept = -math.inf, []
    known = [point for point in points if not any(map(math.isnan, point))]
    for seconds, reached in sorted(known, key=lambda point: (point[0], -point[1])):
        if reached > best:
            best = reached
            kept.append((seconds, reached))
    return kept


def text_of(value: str | float) -> str:
    """Write a value of a knob."""
    return value if isinstance(value, str) else f"{value:,g}" if value % 1 else f"{value:,.0f}"


def _variants_table(name: str, fits: pd.DataFrame, points: pd.DataFrame) -> Table:
    def lines() -> Iterator[tuple[str, ...]]:
        for (knob, value), part in fits.groupby(["knob", "value"], sort=False):
            first, last = (
                part[part.iteration == part.iteration.min()],
                part[part.iteration == steps],
            )
            if last.empty:
                continue
            mine = points[(points.knob == knob) & (points.value == value)]
            yield (
                f"{knob} {text_of(value)}",
                quartiles(first.seconds, 3),
                spread(first.psnr_ycbcr),
                quartiles(last.seconds),
                *(spread(last[key]) for key in ("psnr_ycbcr", "psnr_rgb", "psnr_wide")),
                *(
                    ", ".join(map(text_of, mine.iteration[mine[key] == 1])) or MISSING
                    for key in ("front", "front_same")
                ),
            )

    steps = fits.iteration.max()
    caption = (
        f"{name}, {counted(fits.image.nunique(), 'image')}: seconds and PSNR at the start and "
        f"after {steps:,} steps; after how many steps a fit is on the front of all fits, and of "
        "those with as many Gaussians; settings not named are the default ones"
    )
    start, fronts = ("s, start", "YCbCr, start"), ("on front", "as many")
    columns = ("fit", *start, "s", "YCbCr", "RGB", UNCUT, *fronts)
    return table(caption, columns, lines(), fits.code)


def _storage_table(stored: pd.DataFrame) -> Table:
    lines = [
        (
            f"{name} {precision}",
            number(part.bytes.iloc[0] / 1024),
            spread(part.psnr_ycbcr),
            spread(part.psnr_rgb),
        )
        for (name, precision), part in stored.groupby(["set", "precision"], sort=False)
    ]
    caption = "the default fits, stored in fewer bits a parameter: PSNR"
    return table(caption, ("stored as", "KiB", "YCbCr", "RGB"), lines, stored.code)


def _kernels_table(kernels: pd.DataFrame) -> Table:
    lines = [
        (
            f"{row.renderer} {row.cutoff:g}",
            number(row.forward_ms, 2),
            number(row.step_ms, 2),
            f"{row.largest_error:.1e}",
            f"{row.rms_error:.1e}",
        )
        for row in kernels.sort_values("renderer", kind="stable").itertuples()
    ]
    columns = ("cutoff", "forward, ms", "and reverse, ms", "largest error", "RMS error")
    caption = "the renderer, and what its cutoff leaves out of a picture"
    return table(caption, columns, lines, kernels.code)
