"""Rate against distortion: what is measured, interpolated, drawn and told."""

import io
import json
import math
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from scenes import family

import eigengs_dr as eg
from eigengs_dr import cli_rate
from eigengs_dr.bench import rate, rate_tables, rows
from eigengs_dr.cli import options as cli_shared
from eigengs_dr.cli.console import Program
from eigengs_dr.image.metrics import MAX_PSNR


@pytest.fixture
def small(monkeypatch):
    """Fits so small and few that only what is done with them is tested."""
    monkeypatch.setattr(rate, "SAMPLE_SIDE", 32)
    monkeypatch.setattr(rate, "PIXELS", (32, 8))


def test_packed_fits_are_measured_as_they_are_read(small, backend):
    image = family(1, side=32, seed=5)[0]
    (label, work), *others = rate.jobs("made", [("one", image)], 20, 0.3, 0, backend)
    (point,) = work()["points"]
    assert label["gaussians"] == point["setting"] == 32
    assert [name["gaussians"] for name, _ in others[:1]] == [128]
    assert point["bits_per_pixel"] == 8 * point["bytes"] / 32**2
    fitted = eg.fit(image, 32, iterations=20, backend=backend)
    assert point["unpacked_rgb"] == pytest.approx(eg.psnr(fitted.image, image), abs=1e-6)
    before = eg.psnr(fitted.image, image, "ycbcr")
    assert point["psnr_ycbcr"] >= before - 0.3 - 1e-3
    assert point["seconds"] > point["fit_seconds"] > 0


def test_a_fit_that_was_broken_off_is_no_measurement(small, monkeypatch, tmp_path, backend):
    image = family(1, side=32, seed=5)[0]
    fitted = eg.fit(image, 32, iterations=0, backend=backend)._replace(stopped="interrupted")
    monkeypatch.setattr(rate, "fit", lambda *arguments, **settings: fitted)
    jobs = list(rate.jobs("made", [("one", image)], 20, 0.3, 0, backend))
    run = {"command": "a command"}
    with pytest.raises(KeyboardInterrupt):
        rows.measure(tmp_path / "r.jsonl", jobs, run)
    assert rows.read(tmp_path / "r.jsonl") == []


def test_what_is_exact_can_be_told_and_drawn(small, tmp_path, backend):
    """JPEG loses nothing of a grey image: its PSNR is the highest that is told, not null."""
    image = np.full((32, 32, 3), 128 / 255, np.float32)
    found = rows.measure(
        tmp_path / "r.jsonl",
        rate.jobs("made", [("one", image)], 1, 0.3, 0, backend),
        {"command": "a command"},
    )
    for row in found:
        if row["job"]["codec"].startswith("JPEG"):
            assert {point["psnr_rgb"] for point in row["points"]} == {MAX_PSNR}
    rate_tables.tables(found)
    rate_tables.chart(found, "made").draw_without_rendering()


def test_codecs_are_told_what_they_are_named_for():
    image = family(1, side=32, seed=6)[0]
    jobs = {name["codec"]: work for name, work in rate.jobs("made", [("one", image)], 1)}
    assert list(jobs)[1:] == list(rate.CODECS)
    for title, codec in rate.CODECS.items():
        points = jobs[title]()["points"]
        assert [point["setting"] for point in points] == list(codec.qualities)
        file = io.BytesIO()
        coded = Image.fromarray((image * 255).round().astype(np.uint8))
        coded.save(file, codec.format, quality=codec.qualities[3], **codec.options)
        assert points[3]["bytes"] == len(file.getvalue())
        shown = np.asarray(Image.open(file), np.float32) / 255
        assert points[3]["psnr_rgb"] == pytest.approx(eg.psnr(shown, image), abs=1e-9)
    jpegs = [jobs[title]()["points"][-1] for title in ("JPEG 4:2:0", "JPEG 4:4:4")]
    assert jpegs[0]["bytes"] < jpegs[1]["bytes"]
    assert jpegs[0]["psnr_rgb"] < jpegs[1]["psnr_rgb"]


def point(bits, decibels, setting=1, seconds=1.0):
    figures = {"bits_per_pixel": bits, "psnr_rgb": decibels, "ssim": 0.9}
    return {"setting": setting, "seconds": seconds, **figures}


def test_sizes_are_interpolated_in_their_logarithm():
    curve = [point(4.0, 34.0), point(1.0, 30.0), point(8.0, 40.0)]
    assert rate_tables.rate_at(curve, 30.0) == pytest.approx(1.0)
    assert rate_tables.rate_at(curve, 32.0) == pytest.approx(2.0)
    assert rate_tables.rate_at(curve, 37.0) == pytest.approx(math.sqrt(32))
    assert math.isnan(rate_tables.rate_at(curve, 29.9))
    assert math.isnan(rate_tables.rate_at(curve, 40.1))
    failed = [point(1.0, None), point(1.0, 20.0), point(2.0, None), point(4.0, 40.0)]
    assert math.isnan(rate_tables.rate_at(failed, 30.0))


def made_rows():
    """Two images; on the second WebP does not reach 36 dB."""
    ours = [
        {
            "job": {"set": "made", "image": image, "codec": rate.OURS, "gaussians": count},
            "points": [point(bits * scale, decibels, count, 3.0)],
        }
        for image, scale in (("a", 1), ("b", 3))
        for count, bits, decibels in ((10, 1.0, 26.0), (20, 4.0, 38.0))
    ]
    others = [
        {
            "job": {"set": "made", "image": image, "codec": title},
            "points": [point(2.0, 26.0), point(8.0, high, 2)],
        }
        for image in "ab"
        for title in rate.CODECS
        for high in [34.0 if (image, title) == ("b", "WebP") else 38.0]
    ]
    return ours + others


def test_tables_tell_ratios_and_where_they_are_missing():
    (table,) = rate_tables.tables(made_rows())
    cells = {row[0]: row[1:] for row in table.rows}
    # 32 dB is half way: sqrt(1 * 4) and 3 times that; 2 * 4^(6 / 8) for WebP on the second.
    assert cells[rate.OURS][1] == "4.00"
    assert cells["JPEG 4:2:0"][1] == "4.00 (1.00, 1)"
    assert cells["WebP"][1] == f"{(4 + 2 * 4**0.75) / 2:.2f} ({(4 + 2 * 4**0.75) / 8:.2f}, 1)"
    assert cells["images that all reach"] == ("2", "2", "1", "-")
    assert cells[rate.OURS][2] == f"{4 ** (10 / 12):.2f}"
    assert cells[rate.OURS][3].startswith("3.00")
    nothing = [row for row in made_rows() if row["job"]["codec"] != "WebP"]
    with_one = [r | {"points": [point(1.0, 20.0)]} for r in made_rows() if r not in nothing]
    (table,) = rate_tables.tables(nothing + with_one)
    assert table.rows[0][1:4] == ("-", "-", "-")


def test_charts_show_the_means_of_the_images():
    figure = rate_tables.chart(made_rows(), "made")
    left, right = figure.axes
    lines = {line.get_label(): line.get_xydata() for line in left.lines}
    np.testing.assert_allclose(lines[rate.OURS], [[2.0, 26.0], [8.0, 38.0]])
    np.testing.assert_allclose(lines["WebP"], [[2.0, 26.0], [8.0, 36.0]])
    assert {line.get_label() for line in right.lines} == {rate.OURS, *rate.CODECS}


def bench(*arguments):
    group = Program("bench")
    group.add_command(cli_rate.rate)
    return CliRunner().invoke(group, ["rate", *map(str, arguments)])


def test_the_command_measures_draws_and_goes_on(small, backend, tmp_path):
    out = tmp_path / "out"
    arguments = ("-o", out, "--images", 1, "--iterations", 3, "--backend", backend)
    told = bench(*arguments)
    assert told.exit_code == 0, told.output
    for text in (rate.OURS, *rate.CODECS, "32 dB", "rate-samples.svg"):
        assert text in told.output
    kept = {name: (out / name).read_bytes() for name in ("rate.jsonl", "rate-samples.svg")}
    found = [json.loads(line) for line in kept["rate.jsonl"].splitlines()]
    assert len(found) == 2 + len(rate.CODECS)
    assert {row["job"]["budget"] for row in found[:2]} == {rate.BUDGET}
    again = bench(*arguments)
    assert again.output == told.output
    assert kept == {name: (out / name).read_bytes() for name in kept}


def test_sets_are_read_from_a_folder(tmp_path):
    (tmp_path / "faces256").mkdir()
    eg.save_image(tmp_path / "faces256" / "a.png", family(1, side=32, seed=1)[0])
    ((name, image),) = rate.images_of(tmp_path, "faces256", 9)
    assert (name, image.shape) == ("a.png", (256, 256, 3))
    with pytest.raises(ValueError, match="needs DATA"):
        rate.images_of(None, "faces256", 1)


def test_mistakes_are_told_before_the_work(monkeypatch, tmp_path):
    told = bench("-o", tmp_path / "out", "--set", "kodak")
    assert told.exit_code == 2
    assert "needs DATA" in told.output
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    told = bench("-o", tmp_path / "out")
    assert told.exit_code == 2
    assert "eigengs-dr[charts]" in told.output
    assert not (tmp_path / "out").exists()
    assert rate.SAMPLES == cli_shared.SAMPLES
    assert "Examples" in bench("--help").output
