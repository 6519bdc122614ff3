"""The page of all that benchmarks left in a folder: one HTML file, and Markdown with pictures."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from eigengs_bench.experiments.figures import LIST, read_list
from eigengs_bench.harness.store import Row, count_codes, read
from eigengs_bench.report.charts import data_uri, draw
from eigengs_bench.report.frames import Table, Told, as_text, code_remark
from eigengs_bench.report.sections import budget, methods, pareto, rate, stability
from eigengs_bench.report.sections.losses import where_default_loses
from eigengs_dr.atomic import replacing

TILES = "stability-tiles.png"


class Section(NamedTuple):
    """A question: rows of some files, what makes tables and charts of them, and a short text."""

    title: str
    text: str
    files: tuple[str, ...]
    tell: Callable[..., Told]


SECTIONS = (
    Section(
        "The methods",
        "Columns are steps of descent; column 0 is the start. The rates of default fall over a "
        "run, so a shorter run ends better than the column of its steps says.",
        ("tables.jsonl",),
        methods.tell,
    ),
    Section(
        "Speed against accuracy",
        "Each point is the default fit, or one with a single setting changed, after some number of "
        "steps. Seconds of few images scatter by a tenth. The basis that ships was trained on all "
        "samples but coffee: fits that start from it are flattered there.",
        ("pareto.jsonl",),
        pareto.tell,
    ),
    Section(
        "Where methods fail",
        "Every case is made by code, most of them on the photo chelsea. PSNR above 100 dB is "
        "rounding and counts as exact. Tiling is the root mean square of the fine part of the "
        "errors where the image is smooth.",
        ("stability.jsonl",),
        stability.tell,
    ),
    Section(
        "Where default loses",
        "Another preset has a higher PSNR than default after as many steps, after as much time, or "
        "at the end of a hard case. The training of the model that eigengs starts from is not "
        "counted.",
        ("tables.jsonl", "stability.jsonl"),
        where_default_loses,
    ),
    Section(
        "Gaussians that a PSNR takes",
        "Fits of fixed numbers whose splats are placed once, and the search fit --target-psnr.",
        ("budget.jsonl",),
        budget.tell,
    ),
    Section("Bytes that a PSNR takes", "Packed fits, JPEG and WebP.", ("rate.jsonl",), rate.tell),
)


class Picture(NamedTuple):
    """A chart or a photo: the name and the content of its file, and what is said of it."""

    name: str
    content: bytes
    caption: str

    @property
    def uri(self) -> str:
        """A link that holds the picture."""
        return data_uri(self.content, Path(self.name).suffix)


def write_page(folder: Path, output: Path) -> None:
    """Write index.html, which needs no other file, and README.md with pictures/ beside it.

    `ValueError` if the folder holds no results, or damaged ones.
    """
    sections = []
    for title, text, files, tell in SECTIONS:
        rows = [rows_of(folder / file) for file in files]
        if any(rows):
            told, runs = tell(*rows), [row["run"] for some in rows for row in some]
            pictures = [
                Picture(f"{name}.svg", draw(figure), caption)
                for name, (caption, figure) in told.charts.items()
            ]
            if files == ("stability.jsonl",) and (folder / TILES).exists():
                caption = f'Tiles in the case "smooth", and errors.{code_remark(rows[0])}'
                pictures.append(Picture(TILES, (folder / TILES).read_bytes(), caption))
            sections.append((title, text, told.tables, pictures, source_of(runs)))
    if listed := read_list(folder / LIST):
        shown = [
            Picture(f["path"], (folder / f["path"]).read_bytes(), f"{f['caption']} {f['credit']}")
            for f in listed
        ]
        text = "Photos of scikit-image, of Kodak, and cats of AFHQ: those that may be shown."
        sections.append(("Pictures", text, [], shown, source_of([f["run"] for f in listed])))
    if not sections:
        raise ValueError(
            f"{folder}: holds no results; run bench tables, pareto, stability or figures first"
        )
    (output / "pictures").mkdir(parents=True, exist_ok=True)
    for picture in (picture for *_, pictures, _ in sections for picture in pictures):
        with replacing(output / "pictures" / picture.name) as temporary:
            temporary.write_bytes(picture.content)
    loader = PackageLoader("eigengs_bench.report", ".")
    for name, escaped in (("index.html", True), ("README.md", False)):
        pages = Environment(loader=loader, autoescape=escaped, trim_blocks=True, lstrip_blocks=True)
        pages.filters.update(markdown=lambda table: as_text(table, "pipe"), html=_html)
        with replacing(output / name) as temporary:
            text = pages.get_template(f"{name}.j2").render(sections=sections)
            temporary.write_text(text + "\n", encoding="utf-8")


def rows_of(path: Path) -> list[Row]:
    """Read rows; `ValueError` if two differ in the seed (or steps) alone, and would be counted."""
    free = ("seed",) if path.name == "tables.jsonl" else ("seed", "iterations")
    rows, known = read(path), dict[str, Row]()
    for job in (row["job"] for row in rows):
        what = json.dumps({k: v for k, v in job.items() if k not in free}, sort_keys=True)
        if known.setdefault(what, job) != job:
            raise ValueError(
                f"{path}: has the same measurement with several {' or '.join(free)}; "
                "a page shows one: keep the others in another folder"
            )
    return rows


def source_of(runs: Sequence[Row]) -> list[str]:
    """Say how rows were made: each command with its days, each machine, and the commits."""
    lines = []
    for command in dict.fromkeys(run["command"] for run in runs):
        days = [run["date"] for run in runs if run["command"] == command]
        lines.append(f"{command} ({' to '.join(dict.fromkeys((min(days), max(days))))})")
    for run in runs:
        versions = {k: v for k, v in run["versions"].items() if v and not k.endswith("_path")}
        told = ", ".join(f"{name} {version}" for name, version in versions.items())
        machine = f"{run['cpu']}, {run['threads']} threads, backend {run['backend']}; {told}"
        lines += [machine] if machine not in lines else []
    return [*lines, f"rows of {count_codes(runs)}"]


def _html(table: Table) -> Markup:
    return Markup(table.frame.to_html(index=False, border=0))
