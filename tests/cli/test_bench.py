"""The benchmarks' commands."""

import csv

import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run
from _helpers.photos import coffee
from eigengs_dr.fitting.levels import fit_levels
from eigengs_dr.raster.render import picture_of


@pytest.fixture(scope="module")
def image():
    return coffee(48)


def reached(gaussians, image):
    return eg.psnr(picture_of(gaussians), image, space="ycbcr")


def test_bench_draws_what_prefixes_are_worth(image, tmp_path):
    photo, out = tmp_path / "a.png", tmp_path / "out"
    eg.save_image(photo, image)
    settings = ["--gaussians", 64, "--levels", 3, "--iterations", 20]
    done = run("bench", "levels", photo, "-o", out, *settings)
    assert done.exit_code == 0, done.stderr
    lines = list(csv.DictReader((out / "levels.csv").open()))
    assert [int(line["splats"]) for line in lines] == [4, 8, 16, 32, 64]
    assert [line["level"] for line in lines] == ["True", "False", "True", "False", "True"]
    own = reached(eg.fit(image, 8, iterations=20).gaussians, image)
    assert float(lines[1]["alone"]) == pytest.approx(own, abs=1e-6)
    # All of a set, in whatever order.
    assert float(lines[-1]["alone"]) == pytest.approx(float(lines[-1]["sorted"]), abs=1e-4)
    assert float(lines[0]["levels"]) > float(lines[0]["sorted"])
    assert "8   " in done.stdout and (out / "levels.svg").stat().st_size > 1000


def test_bench_ends_with_a_fit_that_was_broken_off(image, tmp_path, monkeypatch):
    from eigengs_dr.bench import levels

    broken = fit_levels(image, 16, 2, iterations=0)._replace(stopped="interrupted")
    monkeypatch.setattr(levels, "fit_levels", lambda *rest, **settings: broken)
    photo, out = tmp_path / "a.png", tmp_path / "out"
    eg.save_image(photo, image)
    settings = ["--gaussians", 16, "--levels", 2]
    assert run("bench", "levels", photo, "-o", out, *settings).exit_code == 130
    assert not list(out.iterdir())


@pytest.mark.parametrize(
    "command",
    ["pareto", "rate", "budget", "levels", "stability", "figures", "tables .", "report ."],
)
def test_results_into_a_file(photo, command):
    assert_refused(run("bench", *command.split(), "-o", photo), "'-o'", photo, "is a file")
