"""The page of all results: what is found in a folder, and what its sections say."""

import json
import re
import xml.etree.ElementTree as ElementTree
from base64 import b64decode

import numpy as np
import pytest

from _helpers.benchmarks import RUN, cell_row, fit_row, moment, run
from eigengs_bench.report.charts import draw, new_figure, save_figure
from eigengs_bench.report.page import Picture, rows_of, source_of
from eigengs_dr.image.io import save_image

LATER = {**RUN, "command": "later", "date": "2026-03-01 10:00 UTC", "commit": "b" * 40}


def write(folder, name, rows):
    (folder / name).write_text("".join(json.dumps(row) + "\n" for row in rows))


@pytest.fixture
def folder(tmp_path):
    """Results of three commands, the last row of another commit."""
    folder = tmp_path / "results"
    folder.mkdir()
    fits = [
        fit_row(f"{k}.png", [moment(1000, 41.25)], preset, RUN)
        for k in range(2)
        for preset in ("default", "gaussianimage")
    ]
    fits[-1]["run"] = LATER
    write(folder, "tables.jsonl", fits)
    write(folder, "stability.jsonl", [cell_row("a<b&c"), cell_row("a<b&c", "eigengs")])
    save_image(folder / "coffee.png", np.full((20, 60, 3), 0.5))
    save_figure(folder / "curves.svg", chart())
    shown = [
        {"name": "iterations", "path": "coffee.png", "caption": "Coffee.", "credit": "Somebody"},
        {"name": "curves", "path": "curves.svg", "caption": "Curves.", "credit": ""},
    ]
    listed = {"figures": [{**figure, "run": RUN} for figure in shown]}
    (folder / "figures.json").write_text(json.dumps(listed))
    return folder


def chart():
    figure = new_figure(4, 3, "Title")
    figure.subplots().plot([1, 2], [3, 4])
    return figure


def test_a_page_has_all_that_a_folder_holds(folder, tmp_path):
    told = run("bench", "report", folder, "-o", tmp_path / "page")
    assert told.exit_code == 0, told.output
    page = (tmp_path / "page" / "index.html").read_text()
    titles = ["The methods", "Where methods fail", "Where default loses", "Pictures"]
    assert re.findall("<h2.*?>(.*)</h2>", page) == titles == re.findall("<a .*?>(.*)</a>", page)
    assert re.findall('href="#(.*?)"', page) == re.findall('id="(.*?)"', page)
    for cell in ("41.2 ± 0.0", "40.0 from 30.0", "a&lt;b&amp;c"):
        assert f"<td>{cell}</td>" in page
    assert page.count("different code: commit aaaaaaaaa") == 3  # not in the matrix
    for text in ("Coffee. Somebody", "later (2026-03-01 10:00 UTC)", "a CPU, 2 threads"):
        assert text in page
    assert "rows of commit aaaaaaaaa (3), commit bbbbbbbbb (1)" in page
    kinds, contents = zip(*re.findall('src="data:(.*?);base64,(.*?)"', page), strict=True)
    assert kinds == ("image/png", "image/svg+xml")
    assert b64decode(contents[1]) == (folder / "curves.svg").read_bytes()
    assert "://" not in (tmp_path / "page" / "index.html").read_text()


def test_the_readme_says_the_same(folder, tmp_path):
    run("bench", "report", folder, "-o", tmp_path / "page", "--quiet")
    readme = (tmp_path / "page" / "README.md").read_text()
    for text in ("## The methods", "| case", "40.0 from 30.0", "a<b&c", "Coffee. Somebody"):
        assert text in readme
    assert "![](pictures/coffee.png)" in readme
    copy = (tmp_path / "page" / "pictures" / "coffee.png").read_bytes()
    assert copy == (folder / "coffee.png").read_bytes()
    first = (tmp_path / "page" / "index.html").read_bytes()
    run("bench", "report", folder, "-o", tmp_path / "page", "--quiet")
    assert (tmp_path / "page" / "index.html").read_bytes() == first


def test_a_folder_without_results_is_refused(tmp_path):
    told = run("bench", "report", tmp_path, "-o", tmp_path / "page")
    assert told.exit_code == 2 and "holds no results" in told.stderr
    assert not (tmp_path / "page").exists()


def test_one_measurement_with_two_seeds_is_refused(tmp_path):
    rows = [fit_row("a", [moment(1000, 40.0)]), fit_row("a", [moment(1000, 40.0)])]
    write(tmp_path, "tables.jsonl", rows)
    assert len(rows_of(tmp_path / "tables.jsonl")) == 2
    rows[1]["job"]["seed"] = 1
    write(tmp_path, "tables.jsonl", rows)
    with pytest.raises(ValueError, match="same measurement with several seed; a page shows one"):
        rows_of(tmp_path / "tables.jsonl")


def test_the_source_tells_commands_days_machines_and_commits():
    again = {**RUN, "date": "2026-02-01 10:00 UTC"}
    command, later, machine, code = source_of([RUN, again, LATER])
    assert command == f"{RUN['command']} (2026-01-01 10:00 UTC to 2026-02-01 10:00 UTC)"
    assert later.startswith("later") and machine == (
        "a CPU, 2 threads, backend llvm; eigengs_dr 0.1.0"
    )
    assert code == "rows of commit aaaaaaaaa (2), commit bbbbbbbbb (1)"


def test_equal_charts_give_equal_files(tmp_path):
    assert draw(chart()) == draw(chart())
    ElementTree.fromstring(draw(chart()))
    save_figure(tmp_path / "a.png", chart())
    assert Picture("a.jpg", b"x", "").uri.startswith("data:image/jpeg;")
