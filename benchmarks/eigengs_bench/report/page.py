"""The page of all results in a folder: one HTML file, and Markdown with pictures."""

import json
import mimetypes
from base64 import b64encode
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from eigengs_bench.experiments.figures import LIST, read_list
from eigengs_bench.harness.store import Row, code_name, count_codes, read
from eigengs_bench.report.charts import draw
from eigengs_bench.report.frames import Section, as_text, remark
from eigengs_bench.report.sections import budget, kodak, methods, pareto, rate, scaling, stability
from eigengs_bench.report.sections.losses import where_default_loses
from eigengs_dr.storage.atomic import atomic_write

TILES = "stability-tiles.png"

# Titles, the files of their rows, and what makes tables and charts of the rows.
SECTIONS: tuple[tuple[str, tuple[str, ...], Callable[..., Section]], ...] = (
    ("The methods", ("tables.jsonl",), methods.summarize),
    ("Speed against accuracy", ("pareto.jsonl",), pareto.summarize),
    ("Where methods fail", ("stability.jsonl",), stability.summarize),
    ("Where default loses", ("tables.jsonl", "stability.jsonl"), where_default_loses),
    ("The Kodak photos, beside published figures", ("kodak.jsonl",), kodak.summarize),
    ("Gaussians that a PSNR takes", ("budget.jsonl",), budget.summarize),
    ("Bytes that a PSNR takes", ("rate.jsonl",), rate.summarize),
    ("What size costs", ("scaling.jsonl",), scaling.summarize),
)


class Picture(NamedTuple):
    """A chart or a photo: the name and the content of its file, and its caption."""

    name: str
    content: bytes
    caption: str

    @property
    def uri(self) -> str:
        """A link that holds the picture."""
        kind = mimetypes.guess_type(self.name)[0]
        return f"data:{kind};base64,{b64encode(self.content).decode()}"


def write_page(folder: Path, output: Path) -> None:
    """Write index.html, which needs no other file, and README.md with pictures/ beside it.

    `ValueError` if the folder holds no results, or damaged ones.
    """
    sections = []
    for title, files, summarize in SECTIONS:
        runs = [row["run"] for file in files for row in rows_of(folder / file)]
        if runs:
            tables, charts = summarize(*(rows_of(folder / file) for file in files))
            shown = [Picture(f"{name}.svg", draw(f), text) for name, (text, f) in charts.items()]
            if files == ("stability.jsonl",) and (folder / TILES).exists():
                caption = f'Tiles in the case "smooth", and errors.{remark(map(code_name, runs))}'
                shown.append(Picture(TILES, (folder / TILES).read_bytes(), caption))
            sections.append((title, tables, shown, source_of(runs)))
    if listed := read_list(folder / LIST):
        shown = [
            Picture(f["path"], (folder / f["path"]).read_bytes(), f"{f['caption']} {f['credit']}")
            for f in listed
        ]
        sections.append(("Pictures", (), shown, source_of([f["run"] for f in listed])))
    if not sections:
        raise ValueError(f"{folder}: holds no results; run bench tables, pareto or stability first")
    (output / "pictures").mkdir(parents=True, exist_ok=True)
    for picture in (picture for *_, pictures, _ in sections for picture in pictures):
        with atomic_write(output / "pictures" / picture.name) as temporary:
            temporary.write_bytes(picture.content)
    loader = PackageLoader("eigengs_bench.report", ".")
    for name, escaped in (("index.html", True), ("README.md", False)):
        pages = Environment(loader=loader, autoescape=escaped, trim_blocks=True, lstrip_blocks=True)
        pages.filters["markdown"] = lambda table: as_text(table, "pipe")
        pages.filters["html"] = lambda table: Markup(table.frame.to_html(index=False, border=0))
        with atomic_write(output / name) as temporary:
            text = pages.get_template(f"{name}.j2").render(sections=sections)
            temporary.write_text(text + "\n", encoding="utf-8")


def rows_of(path: Path) -> list[Row]:
    """Read rows; `ValueError` if two differ in the seed (or steps) alone, and would be counted."""
    several = path.name in ("tables.jsonl", "kodak.jsonl")  # numbers of steps, side by side
    free = ("seed",) if several else ("seed", "iterations")
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
        named = ", ".join(f"{name} {version}" for name, version in versions.items())
        lines.append(f"{run['cpu']}, {run['threads']} threads, backend {run['backend']}; {named}")
    return [*dict.fromkeys(lines), f"rows of {count_codes(runs)}"]
