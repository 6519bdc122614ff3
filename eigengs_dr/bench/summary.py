"""The rows of `tables` as the paper prints them: means over images, a column a step."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np

from .paper import ABLATION, PRINTED
from .rows import Row
from .sets import SETS, UNIVERSAL
from .table import MISSING, Table, mean, median, number, spread
from .tables import PAPERS_COMPONENTS, Method, methods
from .trial import ITERATIONS

THRESHOLDS = (35, 40)
"""Decibels of psnr_ycbcr: the paper counts the images above."""

LINES = {
    "psnr_ycbcr": "PSNR YCbCr / dB",
    "psnr_rgb": "PSNR RGB / dB",
    "ssim": "SSIM",
    "ms_ssim": "MS-SSIM",
    "seconds": "seconds",
    **{str(limit): f"% above {limit} dB YCbCr" for limit in THRESHOLDS},
}
"""Lines of a method: their names by the keys of moments, and by thresholds."""

LINES_OF_CROSS = ("psnr_ycbcr", "ms_ssim", str(THRESHOLDS[-1]))


def tables(rows: Sequence[Row]) -> list[Table]:
    """Make all tables that rows are enough for.

    Parameters
    ----------
    rows : sequence of dict
        As `eigengs_dr.bench.tables.run` returns them, of any sets and lengths.

    Returns
    -------
    list of Table
        A set and a number of steps each: the methods, then bases of other sets; then the ablation
        of all sets, and how soon "default" has what "gaussianimage" has at the end.
    """
    groups = dict(by_set(rows))
    made = [_glance(steps, groups) for steps in sorted({steps for _, steps in groups})]
    made = [table for table in made if table.rows]
    for (name, iterations), group in groups.items():
        fits = by_method(group)
        where = f"{_images(name, fits)}, {iterations:,} steps"
        for table, title in (("main", "Methods"), ("cross", "Bases of other images")):
            shown = [m for m in methods(name, table, list(SETS)) if m in fits]
            if len({m.preset for m in shown}) > 1:
                lines = tuple(LINES) if table == "main" else LINES_OF_CROSS
                made.append(_over_steps(f"{title}: {where}", {m: fits[m] for m in shown}, lines))
                made += _printed(name, iterations) if table == "main" else []
    made += _ablations(groups)
    made += _reaches(groups)
    return made


def label(method: Method, name: str) -> str:
    """Name of a method on a set, for a reader."""
    if not method.source:
        return method.preset
    basis = "own" if method.source == name else "universal"
    if method.source not in (name, UNIVERSAL):
        basis = method.source
    return f"{method.preset}, {method.components} components, {basis} basis"


def _glance(iterations: int, groups: dict[tuple[str, int], list[Row]]) -> Table:
    """One line a set and method: means of the PSNR over steps, and the time of all of them."""
    steps = [step for step in ITERATIONS if step < iterations] + [iterations]
    lines: list[tuple[str, ...]] = []
    for (name, length), group in groups.items():
        fits = by_method(group) if length == iterations else {}
        for method in (m for m in methods(name, "main", list(SETS)) if m in fits):
            moments = (_moments(fits[method], step) for step in steps)
            means = (mean([m["psnr_ycbcr"] for m in some]) for some in moments)
            seconds = _seconds(_moments(fits[method], iterations))
            images = str(len(fits[method]))
            lines.append((name, label(method, name), images, *means, seconds))
    caption = f"PSNR YCbCr / dB by steps, means over images, and seconds of {iterations:,} steps"
    return Table(caption, ("set", "method", "images", *(f"{s:,}" for s in steps), "seconds"), lines)


def _seconds(moments: Sequence[Row]) -> str:
    """Median of the time, to the millisecond where it is short."""
    taken = [moment["seconds"] for moment in moments]
    return median(taken, 3 if taken and max(taken) < 0.1 else 2)


def by_set(rows: Iterable[Row]) -> list[tuple[tuple[str, int], list[Row]]]:
    """Gather the rows of each set and number of steps, in the order of `SETS`."""
    groups: dict[tuple[str, int], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["job"]["set"], row["job"]["iterations"]].append(row)
    return sorted(groups.items(), key=lambda item: (list(SETS).index(item[0][0]), item[0][1]))


def by_method(rows: Iterable[Row]) -> dict[Method, list[Row]]:
    """Gather the fits of each method."""
    found: dict[Method, list[Row]] = defaultdict(list)
    for row in rows:
        if "moments" in row:
            found[Method(**{key: row["job"][key] for key in Method._fields})].append(row)
    return found


def _images(name: str, fits: dict[Method, list[Row]]) -> str:
    """What was fitted, for a caption."""
    chosen, counts = SETS[name], sorted({len(rows) for rows in fits.values()})
    many = " to ".join(map(str, dict.fromkeys([counts[0], counts[-1]]))) if counts else "0"
    size = f"{chosen.width}x{chosen.height}"
    images = "image" if many == "1" else "images"
    return f"{name}, {many} {images} of {size}, {chosen.gaussians:,} Gaussians"


def _moments(rows: Sequence[Row], step: int) -> list[Row]:
    return [moment for row in rows for moment in row["moments"] if moment["iteration"] == step]


def _over_steps(caption: str, fits: dict[Method, list[Row]], lines: Sequence[str]) -> Table:
    """One line a method and figure, one column a step."""
    name = next(iter(fits.values()))[0]["job"]["set"]
    steps = sorted({m["iteration"] for rows in fits.values() for r in rows for m in r["moments"]})
    cells = [
        (label(method, name), LINES[line], *(_cell(line, _moments(rows, step)) for step in steps))
        for method, rows in fits.items()
        for line in lines
    ]
    return Table(caption, ("method", "figure", *(f"{step:,}" for step in steps)), cells)


def _cell(line: str, moments: Sequence[Row]) -> str:
    if not moments:
        return MISSING
    if line == "seconds":
        return _seconds(moments)
    if line in map(str, THRESHOLDS):
        above = [(m["psnr_ycbcr"] or 0) > float(line) for m in moments]
        return number(100 * float(np.mean(above)), 0)
    return spread([moment[line] for moment in moments], 3 if "ssim" in line else 1)


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
    return [Table(caption, ("images", "method", *(f"{step:,}" for step in steps)), cells)]


def _ablations(groups: dict[tuple[str, int], list[Row]]) -> list[Table]:
    """Colour space and split at the last step, and what the PSNR itself makes of the spaces."""
    made = []
    for iterations in sorted({steps for _, steps in groups}):
        cells = []
        for (name, steps), rows in groups.items():
            own = {
                m: r for m, r in by_method(rows).items() if m in methods(name, "ablation", [name])
            }
            if steps == iterations and len(own) == 4:
                cells += _ablation(name, iterations, own)
        if cells:
            caption = (
                f"Colour space and split: eigengs, {PAPERS_COMPONENTS[0]} components, after "
                f"{iterations:,} steps, dB; 'as compared': each fit in the space it was made in"
            )
            columns = (
                "set",
                "split",
                "fitted in",
                "PSNR YCbCr",
                "PSNR RGB",
                "MS-SSIM",
                "as compared",
            )
            made.append(Table(caption, columns, cells))
    if made:
        made.append(_papers_ablation())
    return made


def _ablation(name: str, iterations: int, fits: dict[Method, list[Row]]) -> list[tuple[str, ...]]:
    cells: list[tuple[str, ...]] = []
    for method, rows in fits.items():
        last = _moments(rows, iterations)
        both = {space: [m[f"psnr_{space}"] for m in last] for space in ("ycbcr", "rgb")}
        similar = spread([m["ms_ssim"] for m in last], 3)
        figures = (spread(both["ycbcr"]), spread(both["rgb"]), similar, spread(both[method.color]))
        cells.append((name, method.split, method.color, *figures))
    return cells


def _papers_ablation() -> Table:
    columns = list(next(iter(ABLATION.values())))
    cells = [
        (split, color, *(number(figures[column]) for column in columns))
        for (color, split), figures in ABLATION.items()
    ]
    caption = "Colour space and split in the paper, after 10,000 steps: PSNR / dB"
    return Table(caption, ("split", "fitted in", *columns), cells)


def _reaches(groups: dict[tuple[str, int], list[Row]]) -> list[Table]:
    cells: list[tuple[str, ...]] = []
    for (name, iterations), rows in groups.items():
        found = [row for row in rows if "share" in row]
        shares = [row["share"] for row in found if row["share"] is not None]
        if found:
            seconds = [row["seconds"] for row in found if row["share"] is not None]
            counted = f"{len(shares)} of {len(found)}"
            worst = number(max(shares, default=None), 4)
            cells.append(
                (name, f"{iterations:,}", counted, median(seconds, 3), median(shares, 4), worst)
            )
    caption = "Time in which default has what gaussianimage has at its last step, from the start"
    columns = ("set", "its steps", "images", "seconds", "share of its time", "largest share")
    return [Table(caption, columns, cells)] if cells else []
