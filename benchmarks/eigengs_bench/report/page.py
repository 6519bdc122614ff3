"""The page of all that benchmarks left in a folder: one HTML file, and Markdown with pictures."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from eigengs_bench.experiments.budget import FILE as BUDGET
from eigengs_bench.experiments.figures import LIST, read_list
from eigengs_bench.experiments.pareto import FILE as PARETO
from eigengs_bench.experiments.rate import FILE as RATE
from eigengs_bench.experiments.stability import FILE as STABILITY
from eigengs_bench.experiments.tables import FILE as TABLES
from eigengs_bench.harness.store import Row, codes, read
from eigengs_bench.report.charts import data_uri, drawn
from eigengs_bench.report.frames import Table, Told, as_text, code_remark
from eigengs_bench.report.sections import budget, methods, pareto, rate, stability
from eigengs_bench.report.sections.losses import where_default_loses
from eigengs_dr.atomic import replacing

TILES = "stability-tiles.png"
"""File of the picture of tiles."""

METHODS = (
    "Columns are steps of descent; column 0 is the start. The rates of default fall over a run, so "
    "a shorter run ends better than the column of its steps says."
)

SPEED = (
    "Each point is the default fit, or one with a single setting changed, after some number of "
    "steps. Seconds of few images scatter by a tenth. The basis that ships was trained on all "
    "samples but coffee: fits that start from it are flattered there."
)

FAILURE = (
    "Every case is made by code, most of them on the photo chelsea. PSNR above 100 dB is rounding "
    "and counts as exact. Tiling is the root mean square of the fine part of the errors where the "
    "image is smooth. Cells of default that are not finite or end below their start: {}."
)

LOSSES = (
    "Every place, of those measured above, where another preset has a higher PSNR than default "
    "after as many steps, after as much time, or at the end of a hard case. The training of the "
    "model that eigengs starts from is not counted."
)

NEEDED = (
    "How many Gaussians a PSNR takes: of fits of fixed numbers whose splats are placed once, and "
    "of the search fit --target-psnr; and how many bits a pixel a packed fit takes."
)


class Picture(NamedTuple):
    """A chart or a photo: the name and the content of its file, and what is said of it."""

    name: str
    content: bytes
    caption: str
    credit: str = ""

    @property
    def uri(self) -> str:
        """A link that holds the picture."""
        return data_uri(self.content, Path(self.name).suffix)


class Section(NamedTuple):
    """One question and its answer; `source` tells commands, days, machines and commits."""

    title: str
    text: str
    tables: Sequence[Table]
    pictures: Sequence[Picture]
    source: Sequence[str]


def write_page(folder: Path, output: Path) -> None:
    """Write index.html, which needs no other file, and README.md with pictures/ beside it.

    Parameters
    ----------
    folder : Path
        What the commands ``bench tables``, ... left. What was not run has no section.
    output : Path
        A folder, made where it is missing.

    Raises
    ------
    ValueError
        If the folder holds no results, or damaged ones.
    OSError
        If a file cannot be written.
    """
    parts = (_methods, _speed, _failure, _losses, _needed, _pictures)
    sections = [section for part in parts if (section := part(folder))]
    if not sections:
        raise ValueError(
            f"{folder}: holds no results; run bench tables, pareto, stability or figures first"
        )
    (output / "pictures").mkdir(parents=True, exist_ok=True)
    for picture in (one for section in sections for one in section.pictures):
        with replacing(output / "pictures" / picture.name) as temporary:
            temporary.write_bytes(picture.content)
    loader = PackageLoader("eigengs_bench.report", ".")
    for name, escaped in (("index.html", True), ("README.md", False)):
        pages = Environment(loader=loader, autoescape=escaped, trim_blocks=True, lstrip_blocks=True)
        pages.filters.update(markdown=lambda table: as_text(table, "pipe"), html=_html)
        text = pages.get_template(f"{name}.j2").render(sections=sections)
        with replacing(output / name) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")


def rows_of(folder: Path, file: str, *settings: str) -> list[Row]:
    """Read the rows of a file, of which no two may differ in the seed and in settings alone.

    Raises
    ------
    ValueError
        If some do: a table would count them as further images.
    """
    rows, free = read(folder / file), ("seed", *settings)
    known: dict[str, Row] = {}
    for job in (row["job"] for row in rows):
        what = json.dumps({k: v for k, v in job.items() if k not in free}, sort_keys=True)
        if known.setdefault(what, job) != job:
            raise ValueError(
                f"{folder / file}: has the same measurement with several {' or '.join(free)}; "
                "a page shows one: keep the others in another folder"
            )
    return rows


def source_of(rows: Sequence[Row]) -> list[str]:
    """Say how rows were made: each command with its days, each machine, and the commits."""
    runs = [row["run"] for row in rows]
    lines = []
    for command, some in groupby(sorted(runs, key=_command), _command):
        days = sorted(run["date"] for run in some)
        lines.append(f"{command} ({' to '.join(dict.fromkeys((days[0], days[-1])))})")
    return [*lines, *dict.fromkeys(map(_machine, runs)), f"rows of {codes(runs)}"]


def _command(run: Row) -> str:
    return str(run["command"])


def _machine(run: Row) -> str:
    versions = {k: v for k, v in run["versions"].items() if v and not k.endswith("_path")}
    told = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"{run['cpu']}, {run['threads']} threads, backend {run['backend']}; {told}"


def _section(
    title: str, text: str, rows: Sequence[Row], *told: Told, more: Sequence[Picture] = ()
) -> Section:
    tables = [table for one in told for table in one.tables]
    charts = [chart for one in told for chart in one.charts]
    pictures = [Picture(f"{c.name}.svg", drawn(c.figure), c.caption) for c in charts]
    return Section(title, text, tables, [*pictures, *more], source_of(rows))


def _methods(folder: Path) -> Section | None:
    rows = rows_of(folder, TABLES)
    return _section("The methods", METHODS, rows, methods.tell(rows)) if rows else None


def _speed(folder: Path) -> Section | None:
    rows = rows_of(folder, PARETO, "iterations")
    return _section("Speed against accuracy", SPEED, rows, pareto.tell(rows)) if rows else None


def _failure(folder: Path) -> Section | None:
    rows, tiles = rows_of(folder, STABILITY, "iterations"), folder / TILES
    if not rows:
        return None
    text = FAILURE.format("; ".join(stability.defects(rows)) or "none")
    caption = 'The case "smooth": the middle of the picture, and below its errors.'
    smooth = [row for row in rows if row["job"]["case"] == "smooth"]
    shown = [Picture(TILES, tiles.read_bytes(), caption + code_remark(smooth))]
    told = stability.tell(rows)
    return _section("Where methods fail", text, rows, told, more=shown if tiles.exists() else ())


def _losses(folder: Path) -> Section | None:
    fits, cells = rows_of(folder, TABLES), rows_of(folder, STABILITY, "iterations")
    if not fits and not cells:
        return None
    told = Told([where_default_loses(fits, cells)])
    return _section("Where default loses", LOSSES, fits + cells, told)


def _needed(folder: Path) -> Section | None:
    searched, packed = (rows_of(folder, file, "iterations") for file in (BUDGET, RATE))
    pairs: tuple[tuple[list[Row], Callable[[Sequence[Row]], Told]], ...] = (
        (searched, budget.tell),
        (packed, rate.tell),
    )
    told = [tell(rows) for rows, tell in pairs if rows]
    return _section("No more than is needed", NEEDED, searched + packed, *told) if told else None


def _pictures(folder: Path) -> Section | None:
    found = read_list(folder / LIST)
    if not found:
        return None
    pictures = [
        Picture(f["path"], (folder / f["path"]).read_bytes(), f["caption"], f["credit"])
        for f in found
    ]
    text = "Of the pictures that may be shown: photos of scikit-image, of Kodak, and cats of AFHQ."
    return _section("Pictures", text, found, more=pictures)


def _html(table: Table) -> Markup:
    """Write the cells of a table as HTML."""
    return Markup(table.frame.to_html(index=False, border=0))
