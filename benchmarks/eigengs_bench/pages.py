"""Tables, charts and figures of the rows of a checkout, written into its pages.

A page has marks, which are comments of HTML and do not show::

    <!-- table: kodak.quality -->
    (what `as_text` makes of the table "quality" that `summarize` of kodak returns)
    <!-- end -->

In a sentence it is ``<!-- figure: kernels.peak -->6.3<!-- end -->``, not at the start of a line. A
page shows a chart as a picture in ``docs/images/measured/``.

Rows of "once" hold tables that no current question produces: their caption, columns and lines.
Where the commit of a run was not recorded, it is the one that brought the figures into a page.

A caption ends with the benchmark; ``<!-- table: all.runs -->`` lists all runs, once for all pages.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path

from matplotlib import __version__ as drawn_with
from matplotlib.figure import Figure

from eigengs_bench.report import Table, as_text, chart_file, machine_of, table
from eigengs_bench.rows import Row, code_name, read
from eigengs_dr.storage.atomic import atomic_write

ROWS = Path("docs/rows.jsonl")
CHARTS = Path("docs/images/measured")
MARK = re.compile(r"(?<!`)<!-- ((\w+): [\w.-]+) -->(.*?)<!-- end -->", re.S)
CHART = re.compile(r"images/measured/([\w-]+)\.svg")
DRAWN_WITH = re.compile(rb"Matplotlib v([^,<]+)")
BENCHMARK = re.compile(r"(`bench \w+).*(`)")


def pages_of(checkout: Path) -> list[Path]:
    """List README.md and the pages of the manual."""
    docs = checkout / "docs"
    return [checkout / "README.md", *sorted(docs.glob("*.md")), *sorted(docs.glob("*/*.md"))]


def outdated(checkout: Path, draw: Callable[[Figure], bytes] = chart_file) -> dict[Path, bytes]:
    """Return the pages and charts that are out of date, with what they should hold.

    `draw` makes the file of a chart. A chart drawn by another version of matplotlib counts as up to
    date. `ValueError` if a page names a table, a figure or a chart that no row holds.
    """
    parts, charts = contents(checkout / ROWS, draw)
    right, used = dict[Path, bytes](), set[str]()
    for page in pages_of(checkout):
        text = page.read_text("utf-8")
        right[page] = filled(text, parts, str(page)).encode()
        used |= set(CHART.findall(text))
    if unknown := used - charts.keys():
        raise ValueError(f"{checkout / ROWS}: no row holds the chart {min(unknown)}")
    right |= {checkout / CHARTS / f"{name}.svg": charts[name] for name in used}
    return {path: content for path, content in right.items() if not _is_right(path, content)}


def _is_right(path: Path, content: bytes) -> bool:
    if not path.exists():
        return False
    there = path.read_bytes()
    version = DRAWN_WITH.search(there) if path.suffix == ".svg" else None
    return there == content or bool(version and version[1].decode() != drawn_with)


def write(checkout: Path) -> list[Path]:
    """Write the pages and charts that are out of date, and return their paths."""
    changed = outdated(checkout)
    (checkout / CHARTS).mkdir(parents=True, exist_ok=True)
    for path, content in changed.items():
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)
    return list(changed)


def filled(text: str, parts: Mapping[str, str], name: str) -> str:
    """Return a page with its parts written between their marks; marks of other kinds stay."""
    kinds = {key.partition(":")[0] for key in parts}
    if inside := re.search(r"^ *<!-- (figure: \S+|setting) -->", text, re.M):
        raise ValueError(
            f"{name}: a line begins with <!-- {inside[1]} -->, which ends the sentence"
        )

    def part(mark: re.Match[str]) -> str:
        if mark[2] not in kinds:
            return mark[0]
        if mark[1] not in parts:
            raise ValueError(f"{name}: no row holds the {mark[1]}")
        space = "" if mark[2] == "figure" else "\n\n"
        return f"<!-- {mark[1]} -->{space}{parts[mark[1]]}{space}<!-- end -->"

    return MARK.sub(part, text)


def contents(
    path: Path, draw: Callable[[Figure], bytes] = chart_file
) -> tuple[dict[str, str], dict[str, bytes]]:
    """Return the Markdown for each mark that a page can hold, and the charts by their names."""
    rows: dict[str, list[Row]] = {}
    for row in (every := read(path)):
        rows.setdefault(row["bench"], []).append(row)
    parts = {"table: all.runs": _runs(every), **_tables_measured_once(rows.pop("once", []))}
    charts = dict[str, bytes]()
    for bench, measured in rows.items():
        section = import_module(f"eigengs_bench.{bench}").summarize(measured)
        tables = [one for one in section.tables if not one.frame.empty]
        parts |= {f"table: {bench}.{one.name}": _captioned(one, measured) for one in tables}
        parts |= {f"figure: {bench}.{name}": text for name, text in section.figures.items()}
        charts |= {name: draw(figure) for name, figure in section.charts.items()}
    return parts, charts


def _tables_measured_once(measured: Sequence[Row]) -> dict[str, str]:
    """Lay out the rows of "once"; the rows of one table are its parts, from several runs."""
    groups: dict[str, list[Row]] = {}
    for row in measured:
        groups.setdefault(row["job"]["table"], []).append(row)
    return {
        f"table: once.{name}": _captioned(
            table(rows[0]["caption"], rows[0]["columns"], [ln for r in rows for ln in r["lines"]]),
            rows,
        )
        for name, rows in groups.items()
    }


def _captioned(measured: Table, rows: Sequence[Row]) -> str:
    """Lay out a table for a page; the caption below it names the benchmarks that measured it."""
    cells = as_text(measured, "pipe").removeprefix(measured.caption).strip()
    names = dict.fromkeys(
        BENCHMARK.sub(r"\1\2", _command(row))
        for row in (rows if measured.rows is None else measured.rows)
    )
    ending = f" ({', '.join(names)})" if names else ""
    return f"{cells}\n\n*{measured.caption}{ending}.*"


def _runs(rows: Sequence[Row]) -> str:
    """List the benchmarks that measured rows, by machine, day and commit."""
    machines: dict[str, dict[str, dict[str, None]]] = {}
    for row in rows:
        run = row["run"]
        code = f"{run['date'][:10]}, {code_name(run)}"
        commands = machines.setdefault(machine_of(run), {}).setdefault(code, {})
        commands[BENCHMARK.sub(r"\1\2", _command(row))] = None
    lines = []
    for machine, codes in machines.items():
        lines.append(f"- {machine}")
        lines += [f"  - {code}: {', '.join(codes[code])}" for code in sorted(codes)]
    return "\n".join(lines)


def _command(row: Row) -> str:
    return f"`{row['run']['command'].removeprefix('eigengs-dr ')}`"
