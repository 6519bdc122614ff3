"""How many bytes a PSNR takes, and what levels of detail are worth."""

import csv
import io
import json

import numpy as np
import pytest
from PIL import Image

from _helpers.benchmarks import RUN, broken_off, lines_of, one_image, run, task_in
from eigengs_bench.experiments import rate
from eigengs_bench.harness import datasets
from eigengs_bench.report.sections import rate as rates
from eigengs_dr.fitting.fit import fit
from eigengs_dr.image.io import save_image
from eigengs_dr.image.metrics import psnr

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
    monkeypatch.setattr(rate, "fit", broken_off)
    with pytest.raises(KeyboardInterrupt):
        work()


def test_codecs_are_told_what_they_are_named_for(tmp_path):
    image = one_image(6)
    jobs = {job["codec"]: work for job, work in rate._jobs(task_in(tmp_path), "m", [("1", image)])}
    assert list(jobs)[1:] == list(rate.CODECS)
    for title, codec in rate.CODECS.items():
        points = jobs[title]()["points"]
        assert [point["setting"] for point in points] == list(codec.settings)
        file = io.BytesIO()
        coded = Image.fromarray((image * 255).round().astype(np.uint8))
        coded.save(file, codec.kind, **codec.set_to(codec.settings[3]))
        assert points[3]["bytes"] == len(file.getvalue())
        shown = np.asarray(Image.open(file).convert("RGB"), np.float32) / 255
        assert points[3]["psnr_rgb"] == pytest.approx(psnr(shown, image), abs=1e-9)
    grey = np.full((32, 32, 3), 128 / 255, np.float32)  # of which JPEG loses nothing
    assert rate._coded(grey, rate.CODECS["JPEG 4:4:4"])["points"][-1]["psnr_rgb"] == 100


def rate_rows():
    """Two images; on the second WebP does not reach 36 dB."""

    def row(image, codec, *points):
        names = ("setting", "bits_per_pixel", "psnr_rgb", "seconds")
        made = [
            {**dict(zip(names, point, strict=True)), "ms_ssim": 0.9, "decode_seconds": 0.1}
            for point in points
        ]
        job = {"set": "made", "image": image, "codec": codec}
        return {"job": job, "points": made, "run": RUN}

    for image, scale in (("a", 1), ("b", 3)):
        for count, bits, decibels in ((10, 1.0, 26.0), (20, 4.0, 38.0)):
            yield row(image, rate.OURS, (count, bits * scale, decibels, 3.0))
        for title in rate.CODECS:
            high = 34.0 if (image, title) == ("b", "WebP") else 38.0
            yield row(image, title, (1, 2.0, 26.0, 1.0), (2, 8.0, high, 1.0))


def test_rates_tell_ratios_and_where_they_are_missing():
    (table,) = rates.summarize(list(rate_rows())).tables
    cells = {row[0]: row[1:] for row in lines_of(table)}
    # 32 dB is half way: sqrt(1 * 4) and 3 times that; 2 * 4^(6 / 8) for WebP on the second.
    assert cells[rate.OURS][2] == "4.00" and cells[rate.OURS][6].startswith("3.00")
    assert cells["JPEG 4:2:0"][2] == "4.00 (1.00, 1)"
    assert cells["WebP"][2] == f"{(4 + 2 * 4**0.75) / 2:.2f} ({(4 + 2 * 4**0.75) / 8:.2f}, 1)"
    assert cells["images that all reach"] == ("2", "2", "2", "2", "1", "-", "-", "-")
    assert cells[rate.OURS][4] == f"{4 ** (10 / 12):.2f}"
    # Twice the bits at 26 dB and at 38 dB on the first image, on the second 1.5 times fewer.
    assert cells["JPEG 4:4:4"][5] == f"{100 * ((0.5 + 1.5) / 2 - 1):+.0f} %"


def test_rate_charts_show_the_means_of_the_images():
    _, figure = rates.summarize(list(rate_rows())).charts["rate-made"]
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
