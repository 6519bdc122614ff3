"""What was measured, for the pages of the manual: tables, charts and figures of ``rows.jsonl``.

``eigengs-dr bench NAME ... --record`` writes the rows. A page has ``{{ tables.kernels.cutoffs }}``
for a table with its source, ``{{ kernels.step_ratio|round(1) }}`` for a figure of the last row, and
charts in ``images/measured/``. A name that no row holds ends the build.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

from eigengs_bench.report import QUESTIONS, as_text, save_figure, sources_of
from eigengs_bench.rows import read

ROWS = Path(__file__).parent / "rows.jsonl"
CHARTS = Path(__file__).parent / "images" / "measured"


def substitutions() -> dict[str, Any]:
    """Return the tables of all questions in Markdown, and the figures of the last row of each."""
    CHARTS.mkdir(exist_ok=True)
    tables: dict[str, dict[str, str]] = {}
    found: dict[str, Any] = {"tables": tables}
    for bench in QUESTIONS:
        if rows := read(ROWS, bench):
            section = import_module(f"eigengs_bench.{bench}").summarize(rows)
            source = "; ".join(sources_of(rows))
            tables[bench] = {}
            for table in section.tables:
                if not table.frame.empty:
                    cells = as_text(table, "pipe").removeprefix(table.caption).strip()
                    tables[bench][table.name] = f"{cells}\n\n*{table.caption}. {source}.*"
            for name, figure in section.charts.items():
                save_figure(CHARTS / f"{name}.svg", figure)
            found[bench] = {k: v for k, v in rows[-1].items() if isinstance(v, (int, float, str))}
    return found
