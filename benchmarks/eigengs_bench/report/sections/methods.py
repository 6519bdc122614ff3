"""The rows of `tables` as the paper prints them: means over images, a column a step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import pandas as pd

from eigengs_bench.experiments.tables import COMPONENTS, ITERATIONS, Method, methods
from eigengs_bench.harness.store import Row
from eigengs_bench.names import NATURAL, SETS
from eigengs_bench.report.frames import (
    MISSING,
    Table,
    Told,
    counted,
    frame_of,
    mean,
    number,
    quartiles,
    spread,
    table,
)
from eigengs_bench.report.sections.paper import ABLATION, PRINTED


def _seconds(values: pd.Series) -> str:
    """Median of the time, to the millisecond where it is short."""
    return quartiles(values, 3 if values.max() < 0.1 else 2)


def _percent_above(limit: float, values: pd.Series) -> str:
    return number(100 * (values > limit).mean(), 0)


THRESHOLDS = (35, 40)
"""Decibels of psnr_ycbcr: the paper counts the images above."""

LINES: dict[str, tuple[str, Callable[[pd.Series], str]]] = {
    "PSNR YCbCr / dB": ("psnr_ycbcr", spread),
    "PSNR RGB / dB": ("psnr_rgb", spread),
    "SSIM": ("ssim", partial(spread, decimals=3)),
    "MS-SSIM": ("ms_ssim", partial(spread, decimals=3)),
    "seconds": ("seconds", _seconds),
    **{f"% above {t} dB YCbCr": ("psnr_ycbcr", partial(_percent_above, t)) for t in THRESHOLDS},
}
"""Lines of a method: their figures, and what writes a cell of the values of all images."""

CROSS_LINES = ("PSNR YCbCr / dB", "MS-SSIM", f"% above {THRESHOLDS[-1]} dB YCbCr")


def tell(rows: Sequence[Row]) -> Told:
    """Make all tables that rows are enough for.

    Parameters
    ----------
    rows : sequence of dict
        As `eigengs_bench.experiments.tables.run` returns them, of any sets and lengths.

    Returns
    -------
    Told
        All sets at a glance; for each set and number of steps the methods, and bases of other sets;
        the ablation of all sets; and how soon "default" has what "gaussianimage" has at the end.
    """
    groups = groups_of(frame_of(rows, "moments"))
    made = list(_glances(groups))
    for (name, iterations), fits in groups.items():
        for kind, title in (("main", "Methods"), ("cross", "Bases of other images")):
            chosen = methods_of(fits, name, kind)
            if chosen.preset.nunique() > 1:
                lines = list(LINES) if kind == "main" else CROSS_LINES
                where = f"{_images(name, chosen)}, {iterations:,} steps"
                made.append(_over_steps(f"{title}: {where}", chosen, lines))
                made += _printed(name, iterations) if kind == "main" else []
    return Told([*made, *_ablations(groups), *_reaches(frame_of(r for r in rows if "share" in r))])


def groups_of(fits: pd.DataFrame) -> dict[tuple[str, int], pd.DataFrame]:
    """Gather the fits of each set and number of steps, in the order of `SETS`."""
    if fits.empty:
        return {}
    groups = dict(iter(fits.groupby(["set", "iterations"])))
    order = sorted(groups, key=lambda key: (list(SETS).index(key[0]), key[1]))
    return {(name, int(steps)): groups[name, steps] for name, steps in order}


def methods_of(fits: pd.DataFrame, name: str, kind: str) -> pd.DataFrame:
    """Choose the fits of a table, with their label as a column "method", ordered as in the table.

    Parameters
    ----------
    fits : DataFrame
        Those of one set and number of steps.
    name : str
        The set.
    kind : str
        One of `TABLES`.
    """
    labels = {method: label(method, name) for method in methods(name, kind, list(SETS))}
    keys = fits[list(Method._fields)].itertuples(index=False, name=None)
    shown = [labels.get(Method(*key)) for key in keys]
    known = list(dict.fromkeys(labels.values()))
    chosen = fits.assign(method=pd.Categorical(shown, known, ordered=True))
    chosen = chosen.dropna(subset="method")
    return chosen.assign(method=chosen.method.cat.remove_unused_categories())


def label(method: Method, name: str) -> str:
    """Name of a method on a set, for a reader."""
    if not method.source:
        return method.preset
    basis = "own" if method.source == name else "universal"
    if method.source not in (name, NATURAL):
        basis = method.source
    text = f"{method.preset}, {method.components} components, {basis} basis"
    return text if method.split == "auto" else f"{text}, {method.color}, {method.split}"


def _glances(groups: dict[tuple[str, int], pd.DataFrame]) -> Iterator[Table]:
    """One line a set and method: means of the PSNR over steps, and the time of all of them."""
    for length in sorted({steps for _, steps in groups}):
        steps, lines, codes = [*(s for s in ITERATIONS if s < length), length], [], list[str]()
        for (name, own), fits in groups.items():
            chosen = methods_of(fits, name, "main") if own == length else fits[:0]
            codes += chosen.code.tolist()
            for method, part in chosen.groupby("method", observed=True) if len(chosen) else ():
                looked = {step: part[part.iteration == step] for step in steps}
                means = (mean(looked[step].psnr_ycbcr) for step in steps)
                images = str(part.image.nunique())
                lines.append((name, method, images, *means, _seconds(looked[length].seconds)))
        if lines:
            caption = (
                f"PSNR YCbCr / dB by steps, means over images, and seconds of all {length:,} steps"
            )
            columns = ("set", "method", "images", *(f"{s:,}" for s in steps), "seconds")
            yield table(caption, columns, lines, codes)


def _images(name: str, fits: pd.DataFrame) -> str:
    """What was fitted, for a caption."""
    chosen, counts = SETS[name], fits.groupby("method", observed=True).image.nunique()
    images = counted(counts.max(), "image")
    if counts.min() < counts.max():
        images = f"{counts.min()} to {images}"
    return f"{name}, {images} of {chosen.width}x{chosen.height}, {chosen.gaussians:,} Gaussians"


def _over_steps(caption: str, fits: pd.DataFrame, lines: Sequence[str]) -> Table:
    """One line a method and figure, one column a step."""
    groups = fits.groupby(["method", "iteration"], observed=True)
    cells = {line: groups[LINES[line][0]].agg(LINES[line][1]).unstack() for line in lines}
    frame = pd.concat(cells, names=["figure", "method"]).swaplevel().fillna(MISSING)
    frame = frame.reindex(pd.MultiIndex.from_product([fits.method.cat.categories, list(lines)]))
    frame.columns = [f"{step:,}" for step in frame.columns]
    frame.index.names = ["method", "figure"]
    frame = frame.reset_index()
    return table(caption, frame.columns, frame.to_numpy(), fits.code)


def _printed(name: str, iterations: int) -> list[Table]:
    """What the paper prints for images of that kind."""
    if name not in PRINTED:
        return []
    steps = sorted({step for row in PRINTED[name] for step in row.psnr if step <= iterations})
    cells = [
        (row.images, row.method, *(number(row.psnr.get(step)) for step in steps))
        for row in PRINTED[name]
    ]
    caption = f"What the paper prints for images like {name}: PSNR YCbCr / dB"
    return [table(caption, ("images", "method", *(f"{step:,}" for step in steps)), cells)]


def _ablations(groups: dict[tuple[str, int], pd.DataFrame]) -> Iterator[Table]:
    """Colour space and split at the last step, and what the PSNR itself makes of the spaces."""
    made = False
    for length in sorted({steps for _, steps in groups}):
        cells, codes = [], list[str]()
        for (name, steps), fits in groups.items():
            own = methods_of(fits, name, "ablation")
            own = own[own.iteration == own.iterations]
            if steps != length or own.method.nunique() < 4:
                continue
            codes += own.code.tolist()
            for _, part in own.groupby("method", observed=True):
                split, color = part.split.iloc[0], part.color.iloc[0]
                figures = [spread(part[f"psnr_{space}"]) for space in ("ycbcr", "rgb", color)]
                figures.insert(2, spread(part.ms_ssim, 3))
                cells.append((name, split, color, *figures))
        if cells:
            made = True
            caption = (
                f"Colour space and split: eigengs, {COMPONENTS[0]} components, after {length:,} "
                "steps, dB; 'as compared': each fit in the space it was made in"
            )
            psnrs = ("PSNR YCbCr", "PSNR RGB", "MS-SSIM", "as compared")
            yield table(caption, ("set", "split", "fitted in", *psnrs), cells, codes)
    if made:
        columns = list(next(iter(ABLATION.values())))
        lines = [
            (split, color, *(number(figures[column]) for column in columns))
            for (color, split), figures in ABLATION.items()
        ]
        caption = "Colour space and split in the paper, after 10,000 steps: PSNR / dB"
        yield table(caption, ("split", "fitted in", *columns), lines)


def _reaches(found: pd.DataFrame) -> Iterator[Table]:
    if found.empty:
        return
    lines = []
    for (name, iterations), part in groups_of(found).items():
        some = part.dropna(subset="share")
        times = quartiles(some.seconds, 3), quartiles(some.share, 4)
        worst = number(some.share.max(), 4)
        lines.append((name, f"{iterations:,}", f"{len(some)} of {len(part)}", *times, worst))
    caption = "Time in which default has what gaussianimage has at its last step, from the start"
    columns = ("set", "its steps", "images", "seconds", "share of its time", "largest share")
    yield table(caption, columns, lines, found.code)
