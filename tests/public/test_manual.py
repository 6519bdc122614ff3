"""README and manual: their names, figures, links and tables are those of the package."""

import re
import runpy

import pytest

from _helpers.pages import FOLDER, ROOT


@pytest.fixture(scope="module")
def check():
    return runpy.run_path(str(ROOT / "tools" / "manual" / "check_pages.py"))


def test_names_are_where_the_manual_says(check):
    assert check["missing"]() == []


def test_the_folders_are_those_of_the_layers():
    """Write them anew by ``python tools/manual/folders.py``."""
    assert runpy.run_path(str(ROOT / "tools" / "manual" / "folders.py"))["outdated"]() == {}


def test_figures_of_the_manual_can_be_traced(check):
    assert check["untraced"]() == []


def test_links_of_pages_work_in_a_checkout(check):
    assert check["broken"]() == []


def test_files_of_the_architecture_exist():
    """Folders and files on the page and in its drawing lie in the package, or beside it."""
    texts = (ROOT / "CONTRIBUTING.md", FOLDER / "images/architecture.svg")
    paths = re.findall(r"[`>]([a-z_]+/[\w/]*(?:\.py)?)[`<]", "".join(t.read_text() for t in texts))
    tops = (ROOT / "eigengs_dr", ROOT)
    assert len(paths) > 50
    assert not [path for path in paths if not any((top / path).exists() for top in tops)]


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_pages_and_charts_have_what_their_rows_give(drawn):
    """To draw a chart takes half a second, so tables, figures and names of charts go first."""
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    from eigengs_bench import pages
    from eigengs_bench.rows import read

    draw = pages.chart_file if drawn else lambda figure: b""
    assert {path for path in pages.outdated(ROOT, draw) if drawn or path.suffix == ".md"} == set()
    shown = "".join(page.read_text() for page in pages.pages_of(ROOT))
    once = {f"table: once.{row['job']['table']} -->" for row in read(ROOT / pages.ROWS, "once")}
    assert not [mark for mark in once if mark not in shown]
    charts = sorted((ROOT / pages.CHARTS).iterdir())
    assert {chart.stem for chart in charts} == {*pages.CHART.findall(shown)}
    assert max(chart.stat().st_size for chart in charts) < 60_000


def test_a_page_and_a_chart_that_differ_from_their_rows_are_written_anew(tmp_path):
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    from eigengs_bench import pages
    from eigengs_bench.rows import read, record

    (tmp_path / "docs").mkdir()
    record(tmp_path / pages.ROWS, read(ROOT / pages.ROWS, "stability"))
    (tmp_path / "README.md").write_text("A page without a mark.\n")
    page, chart = tmp_path / "docs/results.md", tmp_path / pages.CHARTS / "stability.svg"
    mark = "<!-- table: stability.ends -->\n<!-- end -->\n"
    page.write_text(f"{mark}![cases](images/measured/stability.svg)\n")
    assert pages.write(tmp_path) == [page, chart]
    right = page.read_text(), chart.read_bytes()
    assert " (`bench stability`).*" in right[0]
    page.write_text(re.sub(r"(\| *)(\d)", r"\g<1>1\2", right[0], count=1))
    chart.unlink()
    assert pages.write(tmp_path) == [page, chart]
    assert (page.read_text(), chart.read_bytes()) == right
    page.write_text("<!-- table: stability.none -->\n<!-- end -->")
    with pytest.raises(ValueError, match=r"results\.md: no row holds the table: stability\.none"):
        pages.outdated(tmp_path)


@pytest.mark.mitsuba
def test_the_reference_is_what_the_code_says():
    """Public names, commands, and the parameters of plugins; ``make pages`` writes them anew."""
    pytest.importorskip("mitsuba")
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    pages = runpy.run_path(str(ROOT / "tools" / "manual" / "pages.py"))
    assert pages["outdated"]() == {}
