"""The rows of `tables` as the paper prints them: means over images, a column a step."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import pandas as pd

from eigengs_bench.experiments.tables import ITERATIONS, Method, methods
from eigengs_bench.harness.store import Row
from eigengs_bench.names import NATURAL, SETS
from eigengs_bench.report import frames as fr
from eigengs_bench.report.frames import Told
from eigengs_bench.report.sections.paper import ABLATION, PRINTED


def _seconds(values: pd.Series) -> str:
    """Median of the time, to the millisecond where it is short."""
    return fr.quartiles(values, 3 if values.max() < 0.1 else 2)


def _percent_above(limit: float, values: pd.Series) -> str:
    return fr.number(100 * (values > limit).mean(), 0)


THRESHOLDS = (35, 40)  # decibels of psnr_ycbcr: the paper counts the images above
# Lines of a method: their figures, and what writes a cell of the values of all images.
LINES: dict[str, tuple[str, Callable[[pd.Series], str]]] = {
    "PSNR YCbCr / dB": ("psnr_ycbcr", fr.spread),
    "PSNR RGB / dB": ("psnr_rgb", fr.spread),
    "SSIM": ("ssim", partial(fr.spread, decimals=3)),
    "MS-SSIM": ("ms_ssim", partial(fr.spread, decimals=3)),
    "seconds": ("seconds", _seconds),
    **{f"% above {t} dB YCbCr": ("psnr_ycbcr", partial(_percent_above, t)) for t in THRESHOLDS},
}
# Titles and lines of tables; the paper compares each fit in the space it was made in.
KINDS = {
    "main": ("Methods", list(LINES)),
    "cross": ("Bases of other images", ["PSNR YCbCr / dB", "MS-SSIM", "% above 40 dB YCbCr"]),
    "ablation": ("Colour space and split", ["PSNR YCbCr / dB", "PSNR RGB / dB", "MS-SSIM"]),
}


def tell(rows: Sequence[Row]) -> Told:
    """Make all tables that rows are enough for.

    All sets at a glance; for each set and number of steps the `KINDS`; the paper's figures; and how
    soon "default" has what "gaussianimage" has at the end.
    """
    groups = groups_of(fr.frame_of(rows, "moments"))
    made, printed = list(_glances(groups)), dict[str, Any]()
    for (name, iterations), fits in groups.items():
        for kind, (title, lines) in KINDS.items():
            chosen = methods_of(fits, name, kind)
            if chosen.method.nunique() > 1:
                where = f"{_images(name, chosen)}, {iterations:,} steps"
                made.append(_over_steps(f"{title}: {where}", chosen, lines))
                printed |= {name: PRINTED[name]} if kind == "main" and name in PRINTED else {}
                printed |= {kind: ABLATION} if kind == "ablation" else {}
    made += [
        fr.table(f"What the paper prints, like {name}: PSNR / dB", *p)
        for name, p in printed.items()
    ]
    return Told([*made, *_reaches(fr.frame_of(row for row in rows if "share" in row))])


def groups_of(fits: pd.DataFrame) -> dict[tuple[str, int], pd.DataFrame]:
    """Gather the fits of each set and number of steps, in the order of `SETS`."""
    groups = dict(iter(fits.groupby(["set", "iterations"]))) if len(fits) else {}
    return {
        key: groups[key] for key in sorted(groups, key=lambda k: (list(SETS).index(k[0]), k[1]))
    }


def methods_of(fits: pd.DataFrame, name: str, kind: str) -> pd.DataFrame:
    """Choose the fits of a table of a set, with ordered labels as a column "method"."""
    labels = {method: label(method, name) for method in methods(name, kind, list(SETS))}
    keys = fits[list(Method._fields)].itertuples(index=False, name=None)
    shown = [labels.get(Method(*key)) for key in keys]
    order = pd.CategoricalDtype([text for text in labels.values() if text in shown], ordered=True)
    return fits.assign(method=pd.Series(shown, fits.index).astype(order)).dropna(subset="method")


def label(method: Method, name: str) -> str:
    """Name of a method on a set, for a reader."""
    if not method.source:
        return method.preset
    basis = {NATURAL: "universal", name: "own"}.get(method.source, method.source)
    text = f"{method.preset}, {method.components} components, {basis} basis"
    return text if method.split == "auto" else f"{method.preset}, {method.color}, {method.split}"


def _glances(groups: dict[tuple[str, int], pd.DataFrame]) -> Iterator[fr.Table]:
    """One line a set and method: means of the PSNR over steps, and the time of all of them."""
    for length in sorted({steps for _, steps in groups}):
        steps, lines, codes = [*(s for s in ITERATIONS if s < length), length], [], list[str]()
        for name in (name for name, own in groups if own == length):
            chosen = methods_of(groups[name, length], name, "main")
            codes += chosen.code.tolist()
            for method, part in chosen.groupby("method", observed=True):
                means = (fr.mean(part.psnr_ycbcr[part.iteration == step]) for step in steps)
                seconds = _seconds(part.seconds[part.iteration == length])
                lines.append((name, method, str(part.image.nunique()), *means, seconds))
        if lines:
            caption = (
                f"PSNR YCbCr / dB by steps, means over images, and seconds of {length:,} steps"
            )
            columns = ("set", "method", "images", *(f"{s:,}" for s in steps), "seconds")
            yield fr.table(caption, columns, lines, codes)


def _images(name: str, fits: pd.DataFrame) -> str:
    """What was fitted, for a caption."""
    chosen, counts = SETS[name], fits.groupby("method", observed=True).image.nunique()
    least = f"{counts.min()} to " if counts.min() < counts.max() else ""
    size = f"{chosen.width}x{chosen.height}"
    return f"{name}, {least}{fr.counted(counts.max())} of {size}, {chosen.gaussians:,} Gaussians"


def _over_steps(caption: str, fits: pd.DataFrame, lines: Sequence[str]) -> fr.Table:
    """One line a method and figure, one column a step."""
    groups = fits.groupby(["method", "iteration"], observed=True)
    cells = {line: groups[LINES[line][0]].agg(LINES[line][1]).unstack() for line in lines}
    order = pd.MultiIndex.from_product([fits.method.cat.categories, lines])
    frame = pd.concat(cells).swaplevel().reindex(order).fillna(fr.MISSING)
    texts = frame.rename_axis(["method", "figure"]).reset_index()
    return fr.table(
        caption, ["method", "figure", *(f"{s:,}" for s in frame)], texts.to_numpy(), fits.code
    )


def _reaches(found: pd.DataFrame) -> Iterator[fr.Table]:
    lines = []
    for (name, iterations), part in groups_of(found).items():
        some = part.dropna(subset="share")
        times = (
            fr.quartiles(some.seconds, 3),
            fr.quartiles(some.share, 4),
            fr.number(some.share.max(), 4),
        )
        lines.append((name, f"{iterations:,}", f"{len(some)} of {len(part)}", *times))
    caption = "Time in which default has what gaussianimage has at its last step, from the start"
    columns = ("set", "its steps", "images", "seconds", "share of its time", "largest share")
    if lines:
        yield fr.table(caption, columns, lines, found.code)
