"""The page of all results: what is found in a folder, and what its sections say."""

import json
import re
import shutil
from pathlib import Path

import browser
import numpy as np
import pytest
from click.testing import CliRunner

from eigengs_dr.bench import results
from eigengs_dr.bench.charts import new_figure, save_figure
from eigengs_dr.bench.tables import Method
from eigengs_dr.cli.main import main
from eigengs_dr.image.io import save_image

VERSIONS = {"drjit": "1.5.0", "libllvm": "19.1.7", "libllvm_path": "/usr/lib/x.so"}
RUN = {"cpu": "a CPU", "threads": 2, "backend": "llvm", "versions": VERSIONS}


def line(command, date, job, **figures):
    return {"job": job, **figures, "run": {"date": date, "command": command, **RUN}}


def tables_rows():
    figures = {"psnr_ycbcr": 41.25, "psnr_rgb": 36.0, "ssim": 0.9, "ms_ssim": 0.99}
    moments = [{"iteration": 1000, "seconds": 2.5, **figures}]
    return [
        line(
            f"eigengs-dr bench tables data -o r --images {k + 1}",
            f"2026-01-0{k + 1} 10:00 UTC",
            {
                "set": "cars256",
                "image": f"{k}.png",
                "iterations": 1000,
                "seed": 0,
                **Method(preset)._asdict(),
            },
            moments=moments,
        )
        for k in range(2)
        for preset in ("default", "gaussianimage")
    ]


@pytest.fixture
def folder(tmp_path):
    """Results of two commands."""
    lines = [json.dumps(row) for row in tables_rows()]
    (tmp_path / "tables.jsonl").write_text("\n".join(lines) + "\n")
    save_image(tmp_path / "coffee.png", np.full((20, 60, 3), 0.5))
    chart = new_figure(4, 3)
    chart.subplots().plot([1, 2], [3, 4])
    save_figure(tmp_path / "curves.svg", chart)
    shown = [
        {"name": "iterations", "path": "coffee.png", "caption": "Coffee.", "credit": "Somebody"},
        {"name": "curves", "path": "curves.svg", "caption": "Curves.", "credit": ""},
    ]
    run = {"date": "2026-01-03 10:00 UTC", "command": "eigengs-dr bench figures -o r", **RUN}
    listed = {"figures": [{**figure, "run": run} for figure in shown]}
    (tmp_path / "figures.json").write_text(json.dumps(listed))
    return tmp_path


def test_a_section_stands_for_every_command_that_was_run(folder):
    page = results.page(folder)
    titles = [section.title for section in page.sections]
    assert titles == ["The methods", "Where default loses", "Pictures"]
    methods, _, pictures = page.sections
    assert "41.2 ± 0.0" in methods.tables[1].rows[0]
    assert [picture.path.name for picture in pictures.pictures] == ["coffee.png", "curves.svg"]
    assert pictures.pictures[0].credit == "Somebody"


def test_budgets_and_rates_make_a_section(folder):
    job = {"set": "natural256", "image": "a.png", "iterations": 9, "seed": 0, "gaussians": 50}
    fit = {"psnr_ycbcr": 41.25, "seconds": 2.0}
    rows = [
        line("eigengs-dr bench budget d -o r", "2026-02-01", {**job, "rearranged": anew}, **fit)
        for anew in (False, True)
    ]
    (folder / "budget.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    shutil.copy(folder / "curves.svg", folder / "budget-natural256.svg")
    section = results.page(folder).sections[2]
    assert section.title == "No more than is needed"
    assert section.tables[-1].rows[0][:4] == ("natural256", "50", "1", "0.00")
    assert [picture.path.name for picture in section.pictures] == ["budget-natural256.svg"]
    assert "bench budget" in section.source


def test_a_source_names_commands_days_machine_and_versions(folder):
    told = results.page(folder).sections[0].source.split("\n")
    assert told == [
        "`eigengs-dr bench tables data -o r --images 1` (2026-01-01 10:00 UTC)",
        "`eigengs-dr bench tables data -o r --images 2` (2026-01-02 10:00 UTC)",
        "a CPU, 2 threads, backend llvm; drjit 1.5.0, libllvm 19.1.7",
    ]
    rows = tables_rows()
    for row, hour in zip(rows, (12, 9, 10, 11), strict=True):
        row["run"] |= {"command": "one", "date": f"2026-01-01 {hour:02} UTC"}
    assert results.source(rows).startswith("`one` (2026-01-01 09 UTC to 2026-01-01 12 UTC)")


def test_images_are_not_counted_twice(folder):
    """Neither by another seed nor, where a page shows one length, by another number of steps."""
    rows = tables_rows()
    longer = [{**row, "job": {**row["job"], "iterations": 2000}} for row in rows]
    lines = "".join(json.dumps(row) + "\n" for row in rows + longer)
    (folder / "tables.jsonl").write_text(lines)
    assert len(results.page(folder).sections) == 3
    again = json.dumps({**rows[0], "job": {**rows[0]["job"], "seed": 1}})
    (folder / "tables.jsonl").write_text(lines + again + "\n")
    with pytest.raises(ValueError, match=r"tables.jsonl: has the same measurement with several"):
        results.page(folder)
    (folder / "tables.jsonl").unlink()
    job = {"case": "noise", "preset": "default", "seed": 0}
    cells = [line("c", "d", {**job, "iterations": steps}) for steps in (5, 6)]
    (folder / "stability.jsonl").write_text("".join(json.dumps(row) + "\n" for row in cells))
    with pytest.raises(ValueError, match=r"stability.jsonl: .* several seed or iterations"):
        results.page(folder)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no results; run bench tables"):
        results.page(tmp_path)


def test_the_command_writes_a_page_that_browsers_open(folder, tmp_path):
    output = tmp_path / "page"
    result = CliRunner().invoke(main, ["bench", "report", str(folder), "-o", str(output)])
    assert result.exit_code == 0 and "index.html" in result.stdout
    text = (output / "README.md").read_text()
    assert "41.2 ± 0.0" in text and "Somebody" in text
    before = (output / "index.html").read_bytes()
    shutil.rmtree(output / "pictures")
    CliRunner().invoke(main, ["bench", "report", str(folder), "-o", str(output), "--quiet"])
    assert (output / "index.html").read_bytes() == before
    assert len(list((output / "pictures").iterdir())) == 2
    found = browser.probe(output / "index.html")
    assert not found["errors"] and not found["blocked"]
    assert len(found["images"]) == 1 and found["images"][0]["loaded"]
    assert len(found["charts"]) == 1 and found["charts"][0]["paths"] > 0


def test_the_committed_page_is_whole():
    """In a browser every picture and chart is there that the Markdown beside it shows."""
    folder = Path(__file__).parents[1] / "docs" / "results"
    shown = re.findall(r"\]\((pictures/[^)]+)\)", (folder / "README.md").read_text())
    assert all((folder / name).is_file() for name in shown)
    assert {(folder / name).name for name in shown} == {
        path.name for path in (folder / "pictures").iterdir()
    }
    charts = sum(name.endswith(".svg") for name in shown)
    assert charts >= 5 and len(shown) - charts >= 5
    found = browser.probe(folder / "index.html")
    assert not found["errors"] and not found["blocked"]
    assert len(found["charts"]) == charts and len(found["images"]) == len(shown) - charts
    assert all(image["loaded"] and min(image["size"]) > 50 for image in found["images"])
    assert all(chart["paths"] > 0 and min(chart["size"]) > 50 for chart in found["charts"])
    assert len(found["tables"]) > 10
