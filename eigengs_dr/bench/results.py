"""The page of all that benchmarks left in a folder: tables, charts and pictures, with sources."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from . import budget_tables, losses, pareto_tables, rate_tables, stability, summary
from .figures import read_list
from .page import Page, Picture, Section
from .rows import Row, read
from .table import Table

TITLE = "eigengs_dr, measured"

INTRO = """
What the methods of eigengs_dr reach, in what time, and where they fail, as measured by the commands
that stand below each section; they draw all of it again.

**How it was measured.** Clocks start before the first splat is placed, and stop while pictures are
judged. Methods take turns image by image in one run, on the same kernels; programs are compiled
(but for hard cases and packed files), and bases trained, before the clock starts. Seconds are
medians over images, with the range of the middle half; other figures are means with standard
deviations. `psnr_ycbcr` is the PSNR of the paper's code, in studio-range YCbCr / 255, unclamped;
`psnr_rgb` is that of 8-bit RGB. Of the same pictures the first reads some 6 dB more, less where a
fit is bad and clamping mends it, more where it is so good that 8 bits show. Nothing was trained or
tuned on the images of a test folder.

**The methods.** `default` is this package's own. `gaussianimage` is the recipe of GaussianImage
(Zhang et al., ECCV 2024): a random start, Adan, one rate. `eigengs` is that of the paper (Tai et
al., CVPR 2025): the same descent from the projection on an eigenbasis, its mean image kept as
pixels. Their bases are fitted here by one factorisation, not by 15,000 steps of training.
"""

METHODS = """
Columns are steps of descent; column 0 is the start. `default` lets its rates fall over the run, so
a longer run is not a shorter one continued, and a shorter run ends better than the column of its
steps says. A basis splits its Gaussians by frequency where that renders its components better, and
is slower for it: of cats512 that of its own images, of the other sets none.
"""

SPEED = """
Every point is a fit that differs from the default one in one setting; up and to the left is better,
and the line is the front that nothing measured is ahead of. Seconds of few images scatter by a
tenth: what is that close to the front may as well be on it. The "samples" are photos of
scikit-image, and the basis that ships was trained on all of them but coffee: fits that start from
it are flattered there.
"""

OF_A_SET = """
All fits of one set of images, and below the same by setting. The grey band is the front of all, the
dashed line that of fits with as many Gaussians.
"""

CAPTIONS = {
    "pareto-kernels": "The renderer: what a cutoff saves in time, and leaves out of a picture.",
    "pareto-storage": "A finished set of Gaussians, stored in fewer bits a parameter.",
}
"""Of the charts that are not of a set."""

TILES = """
The case "smooth": what tiling looks like, and what is measured of it. Above the middle of the
picture, below its errors.
"""

FAILURE = """
Every case is made by code, most of them on the photo "chelsea", which the basis of `eigengs` was
trained on. Images: one colour, one white pixel, a checkerboard of single pixels,
thin lines, small letters, a slow gradient of 512x512 pixels, saturated blocks, a photo with heavy
noise, of one row, of 4,096x4,096 pixels, and in stripes that a basis of photos does not know.
Starts on the photo: needles, splats smaller than a pixel, all in one heap, all outside the image.
Settings: rates ten times as high ("fast"), and 10,000 steps ("long"). From a start that is given,
`eigengs` is `gaussianimage`.

PSNR above 100 dB is rounding and counts as exact: as 100 dB where one is taken from another. A set
is not finite if a parameter or a pixel was not, at any moment that was looked at. The condition
number is the highest of a splat's covariance, and half precision is what storing the last set in 16
bits costs. Tiling is the root mean square of the fine part of the errors where the image is smooth;
"-" where it is smooth nowhere.
"""

LOSSES = """
Every place, of those measured above, where another preset has a higher PSNR than `default` after as
many steps, after as much time, or at the end of a hard case. `eigengs` starts from a model that was
trained before; that time is not counted.
"""

NEEDED = """
How many Gaussians a PSNR takes: of fits of fixed numbers whose splats are placed once, and of the
search `fit --target-psnr`; what placing them anew gains; and how many bits a pixel a packed fit
takes for a PSNR, beside JPEG and WebP.
"""

NEEDED_CHARTS = {
    "budget": "Every point is an image and a target: Gaussians found over the smallest number.",
    "rate": "Means over the images; fits of several numbers of Gaussians, packed.",
}
"""By the first word of the name of a file."""

PICTURES = """
Of the pictures that may be shown: photos of scikit-image, of Kodak, and cats of AFHQ.
"""


def page(folder: Path) -> Page:
    """Put a page together from what the commands ``bench tables``, ... left in a folder.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    Page
        A section a command; what was not run has none.

    Raises
    ------
    ValueError
        If the folder holds no results, or damaged ones.
    """
    parts: tuple[Callable[[Path], Section | None], ...] = (
        _methods,
        _speed,
        _failure,
        _losses,
        _needed,
        _pictures,
    )
    sections = [section for part in parts if (section := part(folder))]
    if not sections:
        raise ValueError(
            f"{folder}: holds no results; run bench tables, pareto, stability or figures first"
        )
    return Page(TITLE, INTRO, sections)


def _rows(folder: Path, name: str, *settings: str) -> list[Row]:
    """Read the rows of a file, of which no two may differ in seed and settings alone.

    Raises
    ------
    ValueError
        If some do: they are no more images of a table.
    """
    rows, free = read(folder / name), ("seed", *settings)
    known: dict[str, Row] = {}
    for job in (row["job"] for row in rows):
        what = json.dumps({k: v for k, v in job.items() if k not in free}, sort_keys=True)
        if known.setdefault(what, job) != job:
            raise ValueError(
                f"{folder / name}: has the same measurement with several {' or '.join(free)}; "
                "a page shows one: keep the others in another folder"
            )
    return rows


def source(rows: Sequence[Row]) -> str:
    """Say what made some rows: each command with its days, then each machine with its versions."""
    days: dict[str, list[str]] = {}
    machines: dict[str, None] = {}
    for row in rows:
        run = row["run"]
        days.setdefault(run["command"], []).append(run["date"])
        machines[_machine(run)] = None
    lines = [
        f"`{command}` ({' to '.join(dict.fromkeys((min(dates), max(dates))))})"
        for command, dates in days.items()
    ]
    return "\n".join([*lines, *machines])


def _machine(run: Row) -> str:
    versions = {k: v for k, v in run["versions"].items() if v and not k.endswith("_path")}
    told = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"{run['cpu']}, {run['threads']} threads, backend {run['backend']}; {told}"


def _section(
    title: str, text: str, tables: list[Table], pictures: list[Picture], rows: list[Row]
) -> Section:
    return Section(title, text, tables, pictures, source(rows))


def _methods(folder: Path) -> Section | None:
    rows = _rows(folder, "tables.jsonl")
    return _section("The methods", METHODS, summary.tables(rows), [], rows) if rows else None


def _speed(folder: Path) -> Section | None:
    rows = _rows(folder, "pareto.jsonl", "iterations")
    if not rows:
        return None
    charts = sorted(folder.glob("pareto-*.svg"))
    pictures = [Picture(chart, CAPTIONS.get(chart.stem, OF_A_SET)) for chart in charts]
    return _section("Speed against accuracy", SPEED, pareto_tables.tables(rows), pictures, rows)


def _failure(folder: Path) -> Section | None:
    rows = _rows(folder, "stability.jsonl", "iterations")
    if not rows:
        return None
    tiles = folder / "stability-tiles.png"
    pictures = [Picture(tiles, TILES)] if tiles.exists() else []
    found = "; ".join(stability.defects(rows)) or "none"
    text = f"{FAILURE}\nCells of `default` that are not finite or end below their start: {found}.\n"
    return _section("Where methods fail", text, stability.tables(rows), pictures, rows)


def _losses(folder: Path) -> Section | None:
    fits, cells = _rows(folder, "tables.jsonl"), _rows(folder, "stability.jsonl", "iterations")
    if not fits and not cells:
        return None
    return _section("Where default loses", LOSSES, [losses.table(fits, cells)], [], fits + cells)


def _needed(folder: Path) -> Section | None:
    searched, packed = (
        _rows(folder, "budget.jsonl", "iterations"),
        _rows(folder, "rate.jsonl", "iterations"),
    )
    if not searched and not packed:
        return None
    tables = (budget_tables.tables(searched) if searched else []) + (
        rate_tables.tables(packed) if packed else []
    )
    pictures = [
        Picture(chart, caption)
        for word, caption in NEEDED_CHARTS.items()
        for chart in sorted(folder.glob(f"{word}-*.svg"))
    ]
    return _section("No more than is needed", NEEDED, tables, pictures, searched + packed)


def _pictures(folder: Path) -> Section | None:
    found = read_list(folder / "figures.json")
    if not found:
        return None
    pictures = [Picture(folder / f["path"], f["caption"], f["credit"]) for f in found]
    return _section("Pictures", PICTURES, [], pictures, found)
