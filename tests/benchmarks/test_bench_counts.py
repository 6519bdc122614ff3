"""How much a quality takes: Gaussians, bytes, levels of detail."""

import csv
import io
import json
import math
from itertools import pairwise

import numpy as np
import pytest
from _helpers.benchmarks import RUN, lines_of, one_image, run, task_in
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from eigengs_bench.experiments import budget, levels, rate
from eigengs_bench.harness import datasets, store
from eigengs_bench.report.frames import frame_of, smallest
from eigengs_bench.report.sections import budget as budgets
from eigengs_bench.report.sections import rate as rates
from eigengs_dr.descent import descend
from eigengs_dr.fitting import fit, most_gaussians
from eigengs_dr.images import save_image
from eigengs_dr.levels import fit_levels
from eigengs_dr.metrics import psnr
from eigengs_dr.presets import PRESETS
from eigengs_dr.rendering import picture_of
from eigengs_dr.starting import begin


def broken_off(backend):
    return fit(one_image(), 16, iterations=0, backend=backend)._replace(stopped="interrupted")


# --- Budget: what is measured ---


@given(st.integers(1, 90), st.integers(1, 90))
def test_fixed_numbers_span_all_that_a_search_may_use(height, width):
    image = np.zeros((height, width, 3), np.float32)
    counts = budget.grid(image)
    assert counts == sorted(set(counts)) and counts[-1] == most_gaussians(image)
    assert counts[0] == min(counts[-1], math.ceil(height * width / 1024))
    for few, many in pairwise(counts):  # as they were before rounding
        assert (many - 0.5) / (few + 0.5) <= math.sqrt(2) + 1e-9


def law(count):
    """PSNR that grows by 4 dB an octave, 12 at one splat."""
    return 12 + 4 * math.log2(count)


@given(st.integers(1, 40), st.floats(5, 80))
def test_bisection_encloses_a_target_with_few_fits(length, target):
    counts = [3 * k + 2 for k in range(length)]
    rows = budget.bisect(counts, target, lambda n: {"n": n, "psnr_ycbcr": law(n)})
    seen = [row["n"] for row in rows]
    assert len(seen) == len(set(seen)) <= math.ceil(math.log2(length + 1))
    missing = [n for n in counts if law(n) < target]
    reaching = [n for n in counts if law(n) >= target]
    assert set(missing[-1:] + reaching[:1]) <= set(seen)


def test_a_fit_that_has_failed_reaches_nothing():
    assert len(budget.bisect([1, 2, 4], 20.0, lambda count: {"psnr_ycbcr": None})) == 2


def test_placing_anew_makes_a_difference(backend, tmp_path):
    """After 200 steps; the state before has none of it."""
    image, method = one_image(), PRESETS["default"]
    task = task_in(tmp_path, backend, iterations=200)
    once, anew = (budget._fit(task, image, 60, again) for again in (False, True))
    start = begin(image, 60, "auto", "natural", method, backend=backend)
    for row, rearrange in ((once, None), (anew, start.rearrange)):
        *_, last = descend(start.gaussians, start.target, method.schedule, 200, rearrange=rearrange)
        assert row["iteration"] == 200
        assert row["psnr_ycbcr"] == psnr(picture_of(last), image, "ycbcr")
    assert once["psnr_ycbcr"] != anew["psnr_ycbcr"]


def test_a_search_is_that_of_fit(backend, tmp_path, monkeypatch):
    image, task = one_image(), task_in(tmp_path, backend, iterations=20)
    row = budget._search(task, image, 30.0)
    fitted = fit(image, iterations=20, target_psnr=30.0, backend=backend)
    assert row["gaussians"] == len(fitted.gaussians)
    assert (row["stopped"], row["iterations"]) == (fitted.stopped, fitted.iterations)
    assert row["psnr_ycbcr"] == psnr(fitted.image, image, "ycbcr") >= 30
    assert row["psnr_rgb"] == psnr(fitted.image, image)
    monkeypatch.setattr(budget, "fit", lambda *rest, **settings: broken_off(backend))
    with pytest.raises(KeyboardInterrupt):
        budget._search(task, image, 30.0)


def test_a_run_goes_on_where_it_was_stopped(monkeypatch, tmp_path):
    done, shown = [], []

    def made_up(task, image, count, rearranged):
        done.append((count, rearranged))
        return {"psnr_ycbcr": law(count) + rearranged, "seconds": 1.0 + rearranged}

    def search(task, image, target):
        done.append(target)
        figures = {"seconds": 6.0, "iterations": 9, "psnr_ycbcr": target, "stopped": "met"}
        return {"gaussians": math.ceil(2 ** ((target - 12) / 4)), **figures}

    monkeypatch.setattr(datasets, "SAMPLE_SIDE", 32)
    monkeypatch.setattr(budget, "_fit", made_up)
    monkeypatch.setattr(budget, "_search", search)
    task = task_in(tmp_path, images=2, iterations=5, progress=lambda *step: shown.append(step))
    found = budget.run(task, ["samples"], (20.0, 24.0))
    assert shown == [("samples", k, 16) for k in range(1, 17)]
    path, count = tmp_path / "budget.jsonl", len(done)
    assert len(path.read_text().splitlines()) == count < len(found)  # shared fits are made once
    assert done[-2:] == [(1024, False), (1024, True)]  # no more splats than pixels
    at = [done.index(step) for step in (20.0, (4, True), 24.0, (8, True), (1024, False))]
    assert at == sorted(at)
    whole = path.read_bytes()
    assert budget.run(task, ["samples"], (20.0, 24.0)) == found
    assert len(done) == count and path.read_bytes() == whole
    path.write_bytes(whole[:-9])  # the last line was cut short
    assert budget.run(task, ["samples"], (20.0, 24.0))[:-1] == found[:-1]
    assert done[count:] == [(1024, True)]


# --- Budget: how it is told ---


@given(st.floats(13, 51), st.permutations(range(11)))
def test_a_law_is_interpolated_exactly(target, order):
    curve = {2**k: law(2**k) for k in order}
    assert law(smallest(curve, target)) == pytest.approx(target)


def test_what_no_size_encloses_is_missing():
    curve = {4: 20.0, 8: 24.0, 16: 23.0, 32: 28.0}
    assert math.isnan(smallest(curve, 19.9)) and math.isnan(smallest(curve, 28.1))
    assert smallest(curve, 24.0) == 8  # the first that reaches it
    assert smallest({4: 20.0, 8: 20.0}, 20.0) == 4
    assert math.isnan(smallest({}, 20.0)) and math.isnan(smallest({4: math.nan, 8: 30.0}, 20.0))


def sized(image, count, rearranged, decibels, seconds=1.0):
    job = {"set": "made", "image": image, "gaussians": count, "rearranged": rearranged}
    return {"job": job, "psnr_ycbcr": decibels, "seconds": seconds, "run": RUN}


def image_rows(image, found, stopped="met", gain=0.5):
    """A law of 4 dB an octave from 20 dB at 100 splats: 200 for 24 dB, 283 for 26.

    The search for 24 dB has its number; that for 26 finds 250, that for 40 nothing. The two last
    fits are of a number that others were made of too.
    """
    yield from (sized(image, n, False, 20 + 4 * math.log2(n / 100)) for n in (400, 100, 200))
    searches = ((24.0, found, stopped, 6.0), (26.0, 250, "met", 3.0), (40.0, 400, "no", 9.0))
    for target, count, why, seconds in searches:
        job = {"set": "made", "image": image, "target": target}
        figures = {"iterations": 1200, "psnr_ycbcr": 24.1, "seconds": seconds}
        yield {"job": job, "gaussians": count, "stopped": why, **figures, "run": RUN}
        yield sized(image, count, True, target + 0.25, 2.0)
    yield sized(image, 200, False, 24.0, 1.5)
    yield sized(image, 200, True, 24.0 + gain, 1.75)


def made_rows():
    """The second image does not meet 24 dB; savings of the others are 50, 10 and -5 %."""
    images = (("a", 100, "met", 0.5), ("b", 20, "no", 2.0), ("c", 180, "met", -0.25))
    return [row for case in (*images, ("d", 210, "met", 1.0)) for row in image_rows(*case)]


def points(rows):
    fits = frame_of(row for row in rows if "rearranged" in row["job"])
    return budgets.points_of(fits, frame_of(row for row in rows if "target" in row["job"]))


def test_points_are_taken_from_their_rows():
    first, second, third, fourth, *_ = points(made_rows()).itertuples()
    assert (first.image, first.target, first.found, first.met) == ("a", 24.0, 100, True)
    assert first.fixed == pytest.approx(200) and first.saving == pytest.approx(50)
    assert (first.seconds, first.fit_seconds, first.ratio) == (6.0, 2.0, 3.0)
    assert (first.psnr_ycbcr, first.fit_psnr, first.iterations) == (24.1, 24.25, 1200)
    assert second.fixed == pytest.approx(200 * math.sqrt(2))
    assert not third.met and math.isnan(third.fixed) and math.isnan(third.saving)
    assert not fourth.met and math.isnan(fourth.saving) and fourth.fixed == pytest.approx(200)


def test_tables_tell_medians_and_ranges():
    made, starts = budgets.tell(made_rows()).tables
    assert "made, 4 images" in made.caption
    cells = {row[0]: dict(zip(made.frame.columns, row, strict=True)) for row in lines_of(made)}
    line = cells["24 dB"]
    assert line["fixed"] == "200 (200-200)" and line["found"] == "180 (140-195)"
    assert (line["% fewer"], line["range"]) == ("10", "-5 to 50")
    assert (line["images"], line["% met"]) == ("3", "75")
    assert line["s"] == "6.00 (6.00-6.00)" and line["over a fit"] == "3.00 (3.00-3.00)"
    assert line["fit, dB"] == "24.25"
    assert (cells["26 dB"]["% fewer"], cells["26 dB"]["range"]) == ("12", "12 to 12")  # 1 - 250/283
    line = cells["40 dB"]
    assert [line[name] for name in ("fixed", "found", "% fewer", "range")] == 4 * ["-"]
    assert (line["images"], line["% met"]) == ("0", "0")
    seconds = ("1.50 (1.50-1.50)", "1.75 (1.75-1.75)")
    assert lines_of(starts) == [("made", "200", "4", "0.75", "-0.25 to 2.00", *seconds)]


def test_an_image_that_a_run_was_stopped_at_counts_as_far_as_it_goes():
    rows = made_rows()
    for kept in range(0, len(rows), 3):
        told = budgets.tell(rows[:kept])
        assert sum(map(len, told.points.values())) <= 12
    assert len(points(rows[:-1])) == 12


def test_charts_show_what_was_met_and_the_diagonal():
    _, figure = budgets.tell(made_rows()).charts["budget-made"]
    (axis,) = figure.axes
    lines = {line.get_label(): line.get_xydata() for line in axis.lines}
    np.testing.assert_allclose(lines["24 dB, 3 of 4 images"], [[200, 100], [200, 180], [200, 210]])
    assert len(lines["26 dB, 4 of 4 images"]) == 4 and len(lines["40 dB, 0 of 4 images"]) == 0
    diagonal = lines["as many"]
    assert (diagonal[:, 0] == diagonal[:, 1]).all()
    assert diagonal[0, 0] < 100 and diagonal[1, 0] > 283


def test_the_command_searches_draws_and_goes_on(monkeypatch, backend, tmp_path):
    monkeypatch.setattr(datasets, "SAMPLE_SIDE", 16)
    out = tmp_path / "out"
    arguments = ("-o", out, "--images", 1, "--iterations", 3, "--target", 22, "--target", 22)
    told = run("bench", "budget", *arguments, "--backend", backend)
    assert told.exit_code == 0, told.output
    for text in ("22 dB", "% fewer", "gain, dB", "budget-samples.svg"):
        assert text in told.stdout
    (point,) = csv.DictReader((out / "budget-samples.csv").open())
    (search,) = (row for row in store.read(out / "budget.jsonl") if "target" in row["job"])
    assert (point["target"], point["found"]) == ("22.0", str(search["gaussians"]))
    assert run("bench", "budget", *arguments, "--backend", backend).stdout == told.stdout


# --- Rate ---


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(datasets, "SAMPLE_SIDE", 32)
    monkeypatch.setattr(rate, "PIXELS", (32, 8))


def test_packed_fits_are_measured_as_they_are_read(small, backend, tmp_path, monkeypatch):
    image, task = one_image(), task_in(tmp_path, backend, iterations=20)
    (label, work), (other, _), *_ = rate._jobs(task, "made", [("one", image)])
    (point,) = work()["points"]
    assert label["gaussians"] == point["setting"] == 32 and other["gaussians"] == 128
    assert point["bits_per_pixel"] == 8 * point["bytes"] / 32**2
    fitted = fit(image, 32, iterations=20, backend=backend)
    assert point["unpacked_rgb"] == pytest.approx(psnr(fitted.image, image), abs=1e-6)
    assert point["psnr_ycbcr"] >= psnr(fitted.image, image, "ycbcr") - rate.BUDGET - 1e-3
    assert point["seconds"] > point["fit_seconds"] > 0
    monkeypatch.setattr(rate, "fit", lambda *rest, **settings: broken_off(backend))
    with pytest.raises(KeyboardInterrupt):
        work()


def test_codecs_are_told_what_they_are_named_for(tmp_path):
    image = one_image(6)
    jobs = {job["codec"]: work for job, work in rate._jobs(task_in(tmp_path), "m", [("1", image)])}
    assert list(jobs)[1:] == list(rate.CODECS)
    for title, (kind, options) in rate.CODECS.items():
        points = jobs[title]()["points"]
        assert [point["setting"] for point in points] == list(rate.QUALITIES)
        file = io.BytesIO()
        coded = Image.fromarray((image * 255).round().astype(np.uint8))
        coded.save(file, kind, quality=rate.QUALITIES[3], **options)
        assert points[3]["bytes"] == len(file.getvalue())
        shown = np.asarray(Image.open(file), np.float32) / 255
        assert points[3]["psnr_rgb"] == pytest.approx(psnr(shown, image), abs=1e-9)
    grey = np.full((32, 32, 3), 128 / 255, np.float32)  # of which JPEG loses nothing
    assert rate._coded(grey, *rate.CODECS["JPEG 4:4:4"])["points"][-1]["psnr_rgb"] == 100


def rate_rows():
    """Two images; on the second WebP does not reach 36 dB."""

    def row(image, codec, *points):
        names = ("setting", "bits_per_pixel", "psnr_rgb", "seconds")
        made = [{**dict(zip(names, point, strict=True)), "ssim": 0.9} for point in points]
        job = {"set": "made", "image": image, "codec": codec}
        return {"job": job, "points": made, "run": RUN}

    for image, scale in (("a", 1), ("b", 3)):
        for count, bits, decibels in ((10, 1.0, 26.0), (20, 4.0, 38.0)):
            yield row(image, rate.OURS, (count, bits * scale, decibels, 3.0))
        for title in rate.CODECS:
            high = 34.0 if (image, title) == ("b", "WebP") else 38.0
            yield row(image, title, (1, 2.0, 26.0, 1.0), (2, 8.0, high, 1.0))


def test_rates_tell_ratios_and_where_they_are_missing():
    (table,) = rates.tell(list(rate_rows())).tables
    cells = {row[0]: row[1:] for row in lines_of(table)}
    # 32 dB is half way: sqrt(1 * 4) and 3 times that; 2 * 4^(6 / 8) for WebP on the second.
    assert cells[rate.OURS][1] == "4.00" and cells[rate.OURS][3].startswith("3.00")
    assert cells["JPEG 4:2:0"][1] == "4.00 (1.00, 1)"
    assert cells["WebP"][1] == f"{(4 + 2 * 4**0.75) / 2:.2f} ({(4 + 2 * 4**0.75) / 8:.2f}, 1)"
    assert cells["images that all reach"] == ("2", "2", "1", "-")
    assert cells[rate.OURS][2] == f"{4 ** (10 / 12):.2f}"


def test_rate_charts_show_the_means_of_the_images():
    _, figure = rates.tell(list(rate_rows())).charts["rate-made"]
    left, right = figure.axes
    lines = {line.get_label(): line.get_xydata() for line in left.lines}
    np.testing.assert_allclose(lines[rate.OURS], [[2.0, 26.0], [8.0, 38.0]])
    np.testing.assert_allclose(lines["WebP"], [[2.0, 26.0], [8.0, 36.0]])
    assert {line.get_label() for line in right.lines} == {rate.OURS, *rate.CODECS}


def test_the_command_codes_draws_and_goes_on(small, backend, tmp_path):
    out = tmp_path / "out"
    arguments = ("-o", out, "--images", 1, "--iterations", 3, "--backend", backend)
    told = run("bench", "rate", *arguments)
    assert told.exit_code == 0, told.output
    for text in (rate.OURS, *rate.CODECS, "32 dB", "rate-samples.svg"):
        assert text in told.stdout
    kept = {name: (out / name).read_bytes() for name in ("rate.jsonl", "rate-samples.svg")}
    found = [json.loads(line) for line in kept["rate.jsonl"].splitlines()]
    assert len(found) == 2 + len(rate.CODECS)
    assert run("bench", "rate", *arguments).stdout == told.stdout
    assert kept == {name: (out / name).read_bytes() for name in kept}


# --- Levels ---


def test_levels_tell_what_prefixes_are_worth(tmp_path, backend):
    photo, out = tmp_path / "a.png", tmp_path / "out"
    save_image(photo, one_image())
    settings = ["--gaussians", 64, "--levels", 3, "--iterations", 20, "--backend", backend]
    done = run("bench", "levels", photo, "-o", out, *settings)
    assert done.exit_code == 0, done.output
    lines = list(csv.DictReader((out / "levels.csv").open()))
    assert [int(line["splats"]) for line in lines] == [4, 8, 16, 32, 64]
    assert [line["level"] for line in lines] == ["True", "False", "True", "False", "True"]
    # All of a set, in whatever order.
    assert float(lines[-1]["alone"]) == pytest.approx(float(lines[-1]["sorted"]), abs=1e-4)
    assert float(lines[0]["levels"]) > float(lines[0]["sorted"])
    assert "4 *" in done.stdout and (out / "levels.svg").stat().st_size > 1000


def test_levels_end_with_a_fit_that_was_broken_off(tmp_path, monkeypatch):
    broken = fit_levels(one_image(), 16, 2, iterations=0)._replace(stopped="interrupted")
    monkeypatch.setattr(levels, "fit_levels", lambda *rest, **settings: broken)
    save_image(tmp_path / "a.png", one_image())
    arguments = ("-o", tmp_path / "out", "--gaussians", 16, "--levels", 2)
    assert run("bench", "levels", tmp_path / "a.png", *arguments).exit_code == 130
    assert not list((tmp_path / "out").iterdir())
