"""What was measured, for the pages of the manual: tables, charts and figures of ``rows.jsonl``.

``eigengs-dr bench NAME ... --record`` writes the rows. A page has ``{{ tables.kernels.cutoffs }}``
for a table with its source, ``{{ kernels.step_ratio|round(1) }}`` for a figure of the last row, and
charts in ``images/measured/``. A name that no row holds ends the build.

Rows of "once" hold tables that no question of today makes: their caption, columns and lines. If
nobody wrote down the commit of a run, theirs is the one with which the figures came into a page.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

from eigengs_bench.report import QUESTIONS, Table, as_text, save_figure, sources_of, table
from eigengs_bench.rows import Row, read

ROWS = Path(__file__).parent / "rows.jsonl"
CHARTS = Path(__file__).parent / "images" / "measured"


def substitutions() -> dict[str, Any]:
    """Return the tables of all questions in Markdown, and the figures of the last row of each."""
    CHARTS.mkdir(exist_ok=True)
    tables, figures = {"once": _tables_measured_once()}, dict[str, Any]()
    for bench in QUESTIONS:
        if rows := read(ROWS, bench):
            section = import_module(f"eigengs_bench.{bench}").summarize(rows)
            known = [one for one in section.tables if not one.frame.empty]
            tables[bench] = {one.name: _with_source(one, rows) for one in known}
            for name, figure in section.charts.items():
                save_figure(CHARTS / f"{name}.svg", figure)
            figures[bench] = {k: v for k, v in rows[-1].items() if isinstance(v, (int, float, str))}
    return figures | {"tables": tables}


def _tables_measured_once() -> dict[str, str]:
    """Lay out the rows of "once"; rows of one table are parts of it, of several runs."""
    parts: dict[str, list[Row]] = {}
    for row in read(ROWS, "once"):
        parts.setdefault(row["job"]["table"], []).append(row)
    return {
        name: _with_source(
            table(rows[0]["caption"], rows[0]["columns"], [ln for r in rows for ln in r["lines"]]),
            rows,
        )
        for name, rows in parts.items()
    }


def _with_source(shown: Table, rows: list[Row]) -> str:
    cells = as_text(shown, "pipe").removeprefix(shown.caption).strip()
    return f"{cells}\n\n*{shown.caption}. {'; '.join(sources_of(rows))}.*"
