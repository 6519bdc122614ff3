"""Speed against accuracy, from the rows that `pareto` measured: points, fronts and tables."""

import math
from collections.abc import Sequence

import pandas as pd

from eigengs_bench.experiments.pareto import WIDE
from eigengs_bench.harness.store import Row
from eigengs_bench.report import frames as fr
from eigengs_bench.report.frames import Told
from eigengs_bench.report.sections.pareto_charts import kernels_chart, set_chart, storage_chart

PSNRS = ["psnr_ycbcr", "psnr_rgb", "psnr_wide"]

SET_CAPTION = (
    "All fits of a set, and the same by setting. The grey band is the front of all, the dashed "
    "line that of fits with as many Gaussians."
)


def tell(rows: Sequence[Row]) -> Told:
    """Lay out what was measured: a table and a chart a set, of storage, and of the renderer."""
    fits, tables, charts, drawn = fr.frame_of(rows, "trace"), [], {}, {}
    for name, part in fits.groupby("set", sort=False) if len(fits) else ():
        stem = f"pareto-{name}"
        drawn[stem] = points_of(part)
        tables.append(_variants_table(name, part, drawn[stem]))
        charts[stem] = SET_CAPTION + fr.remark(part.code), set_chart(drawn[stem], name)
    if len(stored := fr.frame_of(rows, "stored")):
        tables.append(_storage_table(stored))
        charts["pareto-storage"] = tables[-1].caption, storage_chart(stored)
    if len(kernels := fr.frame_of(rows, "kernels")):
        tables.append(_kernels_table(kernels))
        charts["pareto-kernels"] = tables[-1].caption, kernels_chart(kernels)
    return Told(tables, charts, drawn)


def points_of(fits: pd.DataFrame) -> pd.DataFrame:
    """Gather the images of a set: medians of seconds and means of PSNRs, NaN where a fit failed.

    "front" and "front_same" are 1 on the front of all points, and on that of those with as many
    Gaussians as the default fit.
    """
    groups = fits.groupby(["knob", "value", "iteration", "gaussians"], sort=False)
    points = groups[PSNRS].agg(lambda values: values.mean(skipna=False))
    points.insert(0, "seconds", groups.seconds.median())
    points = points.assign(images=groups.size()).reset_index()
    same = points.gaussians.isin(points.gaussians[points.value == "default"])
    for column, some in (("front", points), ("front_same", points[same])):
        best = front(list(zip(some.seconds, some.psnr_ycbcr, strict=True)))
        on = [(p.seconds, p.psnr_ycbcr) in best for p in some.itertuples()]
        points[column] = (
            pd.Series(on, some.index).reindex(points.index, fill_value=False).astype(int)
        )
    return points


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Find the points (seconds, PSNR) of which none is as fast and better, or faster and as good.

    From the fastest to the best; of equal points one; those with NaN are on no front.
    """
    best, kept = -math.inf, []
    known = [point for point in points if not any(map(math.isnan, point))]
    for seconds, reached in sorted(known, key=lambda point: (point[0], -point[1])):
        if reached > best:
            best = reached
            kept.append((seconds, reached))
    return kept


def _variants_table(name: str, fits: pd.DataFrame, points: pd.DataFrame) -> fr.Table:
    lines, steps = [], fits.iteration.max()
    for (knob, value), part in fits.groupby(["knob", "value"], sort=False):
        first, last = part[part.iteration == part.iteration.min()], part[part.iteration == steps]
        mine = points[(points.knob == knob) & (points.value == value)]
        on = [mine.iteration[mine[key] == 1] for key in ("front", "front_same")]
        cells = [
            fr.quartiles(first.seconds, 3),
            fr.spread(first.psnr_ycbcr),
            fr.quartiles(last.seconds),
        ]
        cells += [fr.spread(last[key]) for key in PSNRS]
        cells += [", ".join(f"{step:,}" for step in steps) or fr.MISSING for steps in on]
        named = value if isinstance(value, str) else f"{value:,g}"
        lines += [(f"{knob} {named}", *cells)] if len(last) else []
    caption = (
        f"{name}, {fr.counted(fits.image.nunique())}: seconds and PSNR at the start and after "
        f"{steps:,} steps; after how many steps a fit is on the front of all fits, and of those "
        "with as many Gaussians; settings not named are the default ones"
    )
    uncut, start = f"YCbCr at {WIDE:g} sigma", ("s, start", "YCbCr, start")
    columns = ("fit", *start, "s", "YCbCr", "RGB", uncut, "on front", "as many")
    return fr.table(caption, columns, lines, fits.code)


def _storage_table(stored: pd.DataFrame) -> fr.Table:
    lines = []
    for (name, precision), part in stored.groupby(["set", "precision"], sort=False):
        size = fr.number(part.bytes.iloc[0] / 1024)
        lines.append((f"{name} {precision}", size, *(fr.spread(part[key]) for key in PSNRS[:2])))
    caption = "The default fits, stored in fewer bits a parameter: PSNR / dB"
    return fr.table(caption, ("stored as", "KiB", "YCbCr", "RGB"), lines, stored.code)


def _kernels_table(kernels: pd.DataFrame) -> fr.Table:
    lines = []
    for row in kernels.sort_values("renderer", kind="stable").itertuples():
        times = fr.number(row.forward_ms, 2), fr.number(row.step_ms, 2)
        errors = f"{row.largest_error:.1e}", f"{row.rms_error:.1e}"
        lines.append((f"{row.renderer} {row.cutoff:g}", *times, *errors))
    columns = ("cutoff", "forward, ms", "and reverse, ms", "largest error", "RMS error")
    caption = "The renderer: time, and what its cutoff leaves out of a picture (1 is white)"
    return fr.table(caption, columns, lines, kernels.code)
