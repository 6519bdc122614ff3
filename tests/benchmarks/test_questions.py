"""Each question: that its command measures, shows and goes on, and that its sums are right."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eigengs_dr as eg
from _helpers.benchmarks import (  # noqa: F401  data is a fixture
    data,
    lines_of,
    moment,
    one_image,
    row,
    task_in,
)
from _helpers.command import assert_refused, run, said
from _helpers.lit_spheres import directions, photos
from _helpers.packed import few_groups
from eigengs_bench import (
    cases,
    kernels,
    kodak,
    overview,
    pareto,
    peers,
    rate,
    relight,
    scaling,
    stability,
    tables,
)
from eigengs_bench.clock import METHODS
from eigengs_bench.images import images_of
from eigengs_bench.names import SETS, ImageSet
from eigengs_bench.report import Section
from eigengs_bench.rows import FILE, read
from eigengs_dr.fitting.fit import fit
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.io import load_image, save_image
from eigengs_dr.image.resize import resample


def answered(out, bench, *arguments, again=False):
    """The rows and the texts of a command, which does nothing if it is called `again`."""
    command = ("bench", bench, *arguments, "-o", out)
    told = said(*command)
    rows, before = read(out / FILE, bench), (out / FILE).read_bytes()
    if again:
        assert said(*command) == told and (out / FILE).read_bytes() == before
    return rows, told


@pytest.fixture
def small(monkeypatch):
    """Samples as small as the basis allows that ships, and a few Gaussians."""
    monkeypatch.setitem(SETS, "samples", ImageSet("", 72, 72, 60))


# --- The paper's tables, curves and pictures ---


def test_tables(data, tmp_path, backend):  # noqa: F811
    arguments = (data, "--set", "cats256", "--images", 1, "--iterations", 12, "--backend", backend)
    rows, text = answered(tmp_path / "out", "tables", *arguments, again=True)
    ends = {row["job"]["preset"]: row["moments"][-1] for row in rows if "moments" in row}
    assert set(ends) == {"default", "gaussianimage", "eigengs"}
    for words in ("eigengs, own basis", "eigengs, universal basis", "psnr_ycbcr / psnr_rgb in dB"):
        assert words in text
    # The same figures as those of a fit.
    image = images_of(task_in(tmp_path, data=data, images=1), "cats256")[0][1]
    for preset in ("default", "gaussianimage"):
        [found] = [row for row in rows if row["job"].get("preset") == preset]
        expected = fit(image, 60, 12, method=METHODS[preset], backend=backend)
        assert found["moments"][-1]["psnr_rgb"] == pytest.approx(expected.trace[-1]["psnr_rgb"])


def test_means_of_tables_count_failures():
    job = {"set": "faces256", "iterations": 1000, "gaussians": 60}
    usual = {"source": "", "components": 0, "space": "ycbcr", "split": "auto"}
    made = [
        row(
            {**job, **usual, "image": str(k), "preset": preset},
            moments=[moment(0, 30.0 + 2 * k), moment(1000, value)],
        )
        for preset in ("default", "gaussianimage")
        for k, value in enumerate((34.0, 36.0, None, 42.0))
    ]
    first, *_ = tables.summarize(made).tables
    assert lines_of(first)[0] == ("faces256", "default", "33.0", "37.3 (1 failed)", "1.00")


def test_few_columns_have_what_the_paper_prints_beside_ours():
    usual = {"set": "faces256", "iterations": 1000, "gaussians": 60, "space": "ycbcr"}
    starts = {"default": "", "gaussianimage": "", "eigengs": "natural256"}
    made = [
        row(
            {**usual, "preset": preset, "source": source, "components": 300 * bool(source)}
            | {"split": "auto", "image": image},
            moments=[moment(0, 20.0 + k), moment(1000, 30.0 + k)],
        )
        for image in ("a", "b")
        for k, (preset, source) in enumerate(starts.items())
    ]
    [few] = [t for t in tables.summarize(made).tables if t.name == "main_1000"]
    assert list(few.frame) == ["set", "method", "0", "1,000", "s"]
    assert lines_of(few) == [
        ("faces256", "default", "20.0", "30.0", "1.00"),
        ("", "gaussianimage", "21.0", "31.0 (30.0)", "1.00"),
        ("", "eigengs, universal basis", "22.0 (28.7)", "32.0 (42.2)", "1.00"),
    ]
    assert few.rows == made and "CelebA" in few.caption


def test_pictures(data, tmp_path, backend):  # noqa: F811
    out = tmp_path / "out"
    arguments = (data, "--images", 1, "--iterations", 3, "--backend", backend)
    names = ("curves", "tiles")
    wanted = [word for name in names for word in ("--picture", name)]
    rows, text = answered(out, "pictures", *arguments, *wanted)
    assert (out / "curves.svg").exists() and "The middle of a slow gradient" in text
    assert {row["job"]["set"] for row in rows if "psnr_ycbcr" in row} == {"cats256", "natural256"}
    assert load_image(out / "tiles.png").std() > 0.01


# --- Speed against accuracy ---


@given(st.lists(st.tuples(st.floats(0.1, 9), st.one_of(st.floats(0, 50), st.just(np.nan)))))
def test_front_is_what_nothing_beats(points):
    known = {p for p in points if p[1] == p[1]}
    beaten = {p for p in known for q in known if q != p and q[0] <= p[0] and q[1] >= p[1]}
    assert pareto.front(points) == sorted(known - beaten)


def test_pareto(small, tmp_path, backend):
    arguments = ("--images", 1, "--iterations", 3, "--backend", backend)
    rows, text = answered(tmp_path / "out", "pareto", *arguments)
    knobs = {row["job"]["knob"] for row in rows}
    assert knobs == {"preset", "init", "solve steps", "cutoff", "gaussians"}
    default = next(row for row in rows if row["job"]["value"] == "default")
    assert [m["iteration"] for m in default["trace"]] == [0, 3] and default["gaussians"] == 60
    assert "preset default" in text and "gaussians 240" in text
    assert (tmp_path / "out" / "pareto-samples.svg").exists()


def test_other_programs_stand_in_the_chart_of_speed():
    photo = {"set": "samples", "image": "a"}
    ours = row({**photo, "knob": "preset", "value": "default"}, trace=[moment(0, 30.0)])
    job = {"set": "kodak", "image": "a", "gaussians": 5000, "iterations": 1000, "timed": True}
    fits = row(job, psnr_float=33.0, seconds=4.0)
    rows = {"pareto": [ours], "kodak": [fits]}
    job = {**photo, "peer": "another program", "setting": "fast", "gaussians": 60, "timed": True}
    peer = row(job, seconds=2.0, psnr_rgb=31.0)
    assert overview.charts({"kodak": [fits]}) == {}
    for others in ([], [peer]):
        charts = overview.charts({**rows, "peers": others})
        (alone,), (left, right, *more) = charts["kodak-speed"].axes, charts["speed"].axes
        assert [line.get_label() for line in alone.lines] == [ln.get_label() for ln in right.lines]
        assert left.get_legend().get_texts()[0].get_text() == "eigengs_dr"
        published = [text.get_text() for text in right.get_legend().get_texts()]
        assert any("NVIDIA V100 (arXiv 2403.08551)" in text for text in published)
        names = [text.get_text() for axis in more for text in axis.get_legend().get_texts()]
        assert names == ["another program"] * len(others)


# --- Where methods fail ---


def case(name="photo", **changes):
    return cases.Case(name, lambda: cases.photo(32, 32), 30, 10)._replace(**changes)


def test_a_cell_says_what_the_fit_says(backend):
    found = stability.measure_cell(case(), "default", backend)
    first, *_, last = fit(cases.photo(32, 32), 30, 10, backend=backend).trace
    ends = [row["psnr_ycbcr"] for row in (first, last)]
    assert [found["start_ycbcr"], found["end_ycbcr"]] == ends and found["finite"]
    thin = case(image=lambda: cases.photo(70, 71))
    assert stability.measure_cell(thin, "eigengs", backend) == {
        "needs": "a basis with at most 4970 Gaussians"
    }
    placed = case(place=cases.heap)
    assert "needs" in stability.measure_cell(placed, "eigengs", backend)


def test_cases_start_as_users_do(backend):
    """A useless start is kept: the table shows the descent from it."""
    heap = case(place=cases.heap, gaussians=60, iterations=100)
    found = stability.measure_cell(heap, "default", backend)
    assert found["finite"] and found["gaussians"] == 60
    assert found["end_ycbcr"] > found["start_ycbcr"]
    stays = stability.measure_cell(heap, "gaussianimage", backend)
    assert stays["finite"] and stays["end_ycbcr"] < found["end_ycbcr"]
    assert stays["start_ycbcr"] < found["start_ycbcr"]  # it solves for no colours


def test_units_of_data_change_nothing(backend):
    made = {name: c for name, c in cases.CASES.items() if name.startswith("data")}
    ends = []
    for made_case in made.values():
        image = made_case.image()[100:132, 100:132]
        small = made_case._replace(image=lambda image=image: image, gaussians=60, iterations=10)
        ends.append(stability.measure_cell(small, "default", backend)["end_ycbcr"])
    assert len(ends) == 4
    # The photo itself is measured with the peak 1, data of other units with their range.
    assert max(ends[1:]) - min(ends[1:]) < 0.02 and ends[0] > max(ends[1:])


def test_the_matrix_of_ends():
    def cell(name, **figures):
        return row({"case": name, "preset": "default", "iterations": 9}, **figures)

    usual = {"finite": True, "start_ycbcr": 30.0, "seconds": 2.0}
    made = [
        cell("better", **usual, end_ycbcr=40.0),
        cell("exact", **usual, end_ycbcr=100.0),
        cell("broken", **usual | {"finite": False}, end_ycbcr=None),
        cell("thin", needs="a larger image"),
    ]
    ends, costs = stability.summarize(made).tables
    expected = {
        "better": "40.0 from 30.0",
        "exact": "exact from 30.0",
        "broken": "not finite",
        "thin": "needs a larger image",
    }
    assert dict(lines_of(ends)) == expected
    assert [cost for _, cost in lines_of(costs)] == ["2.0", "2.0", "2.0", ""]


def test_seeds_are_a_mean_and_a_range():
    job = {"case": "seeds", "preset": "default", "iterations": 9}
    made = [
        row({**job, "seed": seed}, finite=True, start_ycbcr=30.0, end_ycbcr=end, seconds=seed + 1.0)
        for seed, end in enumerate((40.0, 40.5, 41.0))
    ]
    ends, costs = stability.summarize(made).tables
    assert lines_of(ends) == [("seeds", "40.5 (40.00 to 41.00) from 30.0")]
    assert lines_of(costs) == [("seeds", "2.0")]


def test_stability(monkeypatch, tmp_path):
    monkeypatch.setitem(cases.CASES, "photo", case())
    arguments = ("--case", "photo", "--preset", "default", "--iterations", 5)
    rows, text = answered(tmp_path / "out", "stability", *arguments)
    assert len(rows) == 1 and "photo" in text and "5 steps" in text
    monkeypatch.setitem(cases.CASES, "photo", case(seeds=(0, 1)))
    rows, text = answered(tmp_path / "two", "stability", *arguments)
    assert [row["job"]["seed"] for row in rows] == [0, 1] and " to " in text


# --- Kodak, the number for a quality, rate ---


def test_kodak(tmp_path, monkeypatch, backend):
    monkeypatch.setitem(SETS, "kodak", ImageSet("kodak", 32, 24, 40))
    (tmp_path / "kodak").mkdir()
    save_image(tmp_path / "kodak" / "a.png", one_image()[:24])
    arguments = (tmp_path, "--counts", 40, "--steps", 3, "--timed", "--backend", backend)
    [found], text = answered(tmp_path / "out", "kodak", *arguments)
    [(_, image)] = images_of(task_in(tmp_path, data=tmp_path), "kodak")
    expected = fit(image, 40, 3, space="rgb", backend=backend).image
    error = np.clip(expected, 0, 1).astype(np.float64) - image
    assert found["psnr_float"] == pytest.approx(-10 * np.log10(np.mean(error**2)), abs=1e-6)
    assert "GaussianImage" in text and "measured" in text
    assert (tmp_path / "out" / "kodak-gaussians.svg").exists()
    assert {"gaussians", "psnr_float", "source"} <= set(kodak.published())


def test_number(small, tmp_path, backend):
    arguments = ("--images", 1, "--iterations", 5, "--target", 20, "--backend", backend)
    rows, text = answered(tmp_path / "out", "number", *arguments)
    [searched] = rows
    assert searched["stopped"] in ("met", "out of reach") and "20 dB" in text


@pytest.mark.slow
def test_rate(small, tmp_path, backend, monkeypatch):
    for name, codec in rate.CODECS.items():
        few = codec._replace(settings=codec.settings[5:10:4])
        monkeypatch.setitem(rate.CODECS, name, few)
    arguments = ("--images", 1, "--iterations", 3, "--backend", backend)
    rows, text = answered(tmp_path / "out", "rate", *arguments)
    packed = [row["points"][0] for row in rows if row["job"]["codec"] == rate.OURS]
    assert all(p["bits_per_pixel"] == 8 * p["bytes"] / 72**2 for p in packed) and len(packed) == 6
    assert {row["job"]["codec"] for row in rows} == {rate.OURS, *rate.CODECS}
    assert "JPEG XL" in text and "AVIF 4:4:4" in text


def curve(bits, decibels, image="a", codec="x"):
    points = {"bits_per_pixel": bits, "psnr_rgb": decibels, "image": image, "codec": codec}
    return pd.DataFrame(points)


def test_bd_rate_of_half_the_bits():
    bits, decibels = np.array([0.5, 1.0, 2.0, 4.0]), np.array([28.0, 31.0, 34.0, 37.0])
    found = rate.bd_rate(curve(bits / 2, decibels), curve(bits, decibels))
    assert found == pytest.approx(-0.5)
    assert np.isnan(rate.bd_rate(curve(bits, decibels), curve(bits, decibels + 90)))


def test_means_at_equal_slope_give_hard_images_more():
    """Of D(R) = c 4^-R the slope is proportional to D: all images end at one error."""
    bits = np.linspace(0.5, 8, 200)
    points = [
        curve(bits, 10 * np.log10(255**2 / (c * 4.0**-bits)), str(c)) for c in (1000.0, 16000.0)
    ]
    found = rate.at_equal_slope(pd.concat(points, ignore_index=True))
    error = 255**2 * 10 ** (-found.psnr_rgb / 10)
    expected = rate.SLOPES / np.log(4)
    inside = (expected < 400) & (expected > 20)
    np.testing.assert_allclose(error[inside[: len(error)]], expected[inside], rtol=0.05)


# --- What else one would pick ---


@few_groups()
def test_peers(small, tmp_path, backend):
    chosen = [word for peer in ("texels", "JPEG", "AVIF") for word in ("--peer", peer)]
    arguments = ("--set", "samples", "--gaussians", 300, "--iterations", 3, "--backend", backend)
    rows, text = answered(tmp_path / "out", "peers", *chosen, *arguments)
    made = {row["job"]["peer"]: row for row in rows}
    codecs = ["JPEG 4:2:0", "JPEG 4:4:4", "AVIF 4:4:4"]
    assert list(made) == [peers.OURS, peers.PACKED, "texels", *codecs]
    assert made["texels"]["memory"] <= made[peers.OURS]["memory"] == 4 * (300 * 8 + 3)
    assert made["texels"]["number"] == made["texels"]["memory"] / 4
    for name, figures in made.items():
        assert np.isfinite(figures["psnr_rgb"]) and name in text
    assert made["AVIF 4:4:4"]["bytes"] <= made[peers.PACKED]["bytes"]
    assert "Image-GS" in text and "What a peer does better" in text


FAKE = """#!{python}
import json, pathlib, shutil, sys
words = dict(zip(sys.argv[2::2], sys.argv[3::2]))
shutil.copy(sys.argv[1], words["--preview"])
pathlib.Path(words["-o"]).write_text("<svg/>")
log = pathlib.Path(words["--artifacts-dir"])
log.mkdir()
count = int(words["--splats"]) - 1
figures = {{"total_time_sec": len(words["--stages"].split(",")), "final_splat_count": count}}
figures["final_metrics"] = {{"psnr_srgb": 20.5}}
(log / "run_manifest.json").write_text(json.dumps(figures))
sys.exit("of no use\\nno splats" if count < 1 else 0)
"""


@pytest.mark.skipif(os.name == "nt", reason="the program that stands for a peer is a script")
def test_a_peer_draws_its_own_picture(tmp_path, monkeypatch):
    program = tmp_path / "splatthis"
    program.write_text(FAKE.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setattr(peers, "environment", lambda folder, requirements: folder.parents[0])
    image = one_image()
    found = peers._splatthis(tmp_path, image, 5, "3,2,1")
    assert (found["seconds"], found["number"], found["bytes"]) == (3, 4, 6)
    assert (
        found["psnr_rgb"] == 100
        and found["own_psnr_rgb"] == 20.5
        and "torch==2.13.0" in found["requirements"]
    )
    with pytest.raises(ValueError, match="splatthis failed: no splats"):
        peers._splatthis(tmp_path, image, 1, "3,2,1")


@pytest.mark.slow
def test_a_peer_has_an_environment_of_its_own(tmp_path):
    programs = peers.environment(tmp_path / "peer", ["pip"])  # is there: nothing is fetched
    [python] = programs.glob("python3")
    code = "import sys, importlib.util as u; print(sys.prefix, u.find_spec('eigengs_dr'))"
    shown = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == [str(tmp_path / "peer"), "None"]
    (tmp_path / "peer" / "kept").touch()
    assert peers.environment(tmp_path / "peer", ["pip"]) == programs
    assert (tmp_path / "peer" / "kept").exists()
    missing = str(tmp_path / "missing-1.0-py3-none-any.whl")
    with pytest.raises(ValueError, match="cannot be installed"):
        peers.environment(tmp_path / "peer", [missing])


@given(st.integers(2, 40), st.integers(1, 40))
def test_bilinear_weights(size, count):
    weights = peers.bilinear(size, count)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    if count == size:
        np.testing.assert_allclose(weights, np.eye(size), atol=1e-12)
    # A ramp of texels is a ramp of pixels between the outer texels.
    at = (np.arange(size) + 0.5) * count / size
    ramp = np.clip(at, 0.5, count - 0.5)
    np.testing.assert_allclose(weights @ (np.arange(count) + 0.5), ramp, atol=1e-9)


def test_texels_are_those_of_least_squares():
    """No texels of the same size are closer: those that a filter makes are not."""
    image = np.asarray(one_image(), np.float64)
    found = peers._texels(image.astype(np.float32), 20)
    side = int(32 * (peers.memory_of(20) / (4 * 32 * 32)) ** 0.5)
    up = peers.bilinear(32, side)
    filtered = np.clip(resample(image.astype(np.float32), side, side), 0, 1)
    shown = np.einsum("yr,rkc,xk->yxc", up, filtered, up)
    assert found["number"] == side**2 and found["psnr_rgb"] > eg.psnr(shown, image, "rgb") + 0.2


# --- What size costs, and how fast the renderer is ---


def test_scaling(backend, tmp_path):
    arguments = ("--part", "pixels", "--iterations", 2, "--max-side", 128, "--backend", backend)
    [row], _ = answered(tmp_path / "out", "scaling", *arguments)
    assert row["job"]["gaussians"] == 1250 and row["mean_ms"] > 0 and row["place_seconds"] > 0
    assert scaling.measure_fits(scaling.Case(16, 16, 20), 1, backend, 1e-9)["many_ratio"] > 0
    image = scaling.mosaic(2 * scaling.CELL, scaling.CELL + 8)
    assert image.shape == (scaling.CELL + 8, 2 * scaling.CELL, 3)


@pytest.fixture
def tiny(monkeypatch):
    small = {"SIDE": 64, "COUNT": 300, "ROUNDS": 2, "PEAK_LANES": 1 << 10}
    for name, value in small.items():
        monkeypatch.setattr(kernels, name, value)


def test_kernels(tiny, backend, tmp_path):
    told = said("bench", "kernels", "--backend", backend, "-o", tmp_path)
    [found] = read(tmp_path / FILE)
    for name in ("step_ms", "forward_ms", "forward_peak_fraction", "step_peak_fraction"):
        assert found[name] > 0 and name in told


@pytest.mark.slow
@pytest.mark.mitsuba
def test_texture(monkeypatch, tmp_path):
    pytest.importorskip("mitsuba")
    from eigengs_bench import poster, sky, texture

    small = {"SIDE": 16, "TEXELS": 16, "SPP": 1, "COUNTS": (20,), "SETTLED": 20, "CHANGED": (20,)}
    for name, value in (small | {"STEPS": 2, "ROUNDS": 1, "HELD": (20,)}).items():
        monkeypatch.setattr(texture, name, value)
    small = {"TEXELS": 64, "PIXELS": 32, "GOAL": 25.0, "PHOTOS": ("coffee",), "MAPS": ("gravel",)}
    for name, value in small.items():
        monkeypatch.setattr(poster, name, value)
    small = {"ROWS": 32, "PIXELS": 8, "SPP": 4, "GOAL": 25.0, "STEPS": 5, "ROUNDS": 1}
    for name, value in small.items():
        monkeypatch.setattr(sky, name, value)
    text = said("bench", "texture", "-o", tmp_path)  # it times the ball anew each time
    photo, material, letters, *lights, ball = read(tmp_path / FILE, "texture")
    for found, goal in ((photo, 25), (material, 25), (letters, poster.TEXT_GOAL)):
        assert found["psnr"] >= goal and found["psnr_bitmap"] >= goal and found["side"] <= 64
        assert found["filtered_bytes"] > found["bytes"] > 0
    # Texels of a colour take four bytes, those of a map one.
    assert photo["bitmap_bytes"] == pytest.approx(4 * photo["side"] ** 2, rel=0.1)
    assert material["bitmap_bytes"] == pytest.approx(material["side"] ** 2, rel=0.1)
    assert ball["bytes_filtered_20"] > ball["bytes_20"] > 0 and ball["first_20_ms"] > 0
    assert ball["ratio_20"] > 0 and ball["ratio_step"] > 0 and ball["ratio_step_filtered"] > 0
    assert "memory, sharp text" in text and "coffee" in text
    for light in lights:
        assert light["mean"] < 0.2 and light["variance"] > 0 and light["ratio"] > 0
        assert 15 < light["lookups"] < 60 and light["images"] > 20
        assert light["bitmap_bytes"] > 0 and light["bytes"] > 0
        assert light["job"]["light"] in text


def test_a_psnr_without_noise():
    from eigengs_bench.sky import psnr_without_noise

    noise = np.random.default_rng(0).normal(0, 0.05, (2, 64, 32, 32, 3))
    pictures = noise + np.reshape([0.3, 0.32], (2, 1, 1, 1, 1))
    expected = -20 * np.log10(to_coded(np.array(0.32)) - to_coded(np.array(0.3)))
    assert psnr_without_noise(pictures[1], pictures[0]) == pytest.approx(expected, abs=0.2)


@pytest.mark.mitsuba
@pytest.mark.slow
def test_inverse(monkeypatch, tmp_path):
    pytest.importorskip("mitsuba")
    from eigengs_bench import inverse
    from eigengs_bench.subjects import SUBJECTS

    small = {"STEPS": (4, 16), "NOISES": (), "WARM_UP": 4, "NOISY_STEPS": 16}
    for name, value in small.items():
        monkeypatch.setattr(inverse, name, value)
    for name, subject in SUBJECTS.items():
        one = subject._replace(texels=64, side=16, cameras=(2,))
        monkeypatch.setitem(SUBJECTS, name, one)
    scenes = ("--scene", "ball", "--scene", "material", "--seeds", "1")
    rows, text = answered(tmp_path / "out", "inverse", *scenes, "--backend", "llvm")
    ball, material = rows[:6], rows[6:]
    for first, then in zip(ball[:3], ball[3:], strict=True):
        assert first["job"]["method"] == then["job"]["method"] in inverse.METHODS
        assert first["seconds"] > 0 and 5 < first["psnr_rgb"] < then["psnr_rgb"]
    assert [row["job"]["method"] for row in material] == [*inverse.METHODS] * 2
    assert all(row["albedo"] > 5 and row["roughness_constant"] > 5 for row in material)
    assert "ball, 2 cameras" in text and "at equal seconds" in text


def test_gains_are_means_of_seeds():
    from eigengs_bench import inverse

    figures = {"seconds": 1.0, "color_constant": 20.0, "gaussians": 100, "parameters": 800}
    rows = [
        {
            "job": {"scene": "ball", "cameras": 2, "spp": 4, "method": method, "steps": steps}
            | {"seed": seed},
            **figures,
            "psnr_rgb": 30.0 + 2 * seed * (method == "fit"),
            "color": 30.0,
        }
        for method in ("pyramid", "fit")
        for steps, seeds in ((120, 2), (240, 1))
        for seed in range(seeds)
    ]
    gains = inverse.summarize(rows).tables[0]
    assert gains.frame.to_numpy().tolist() == [["ball, 2 cameras", "+1.0", "+0.0 (1)"]]
    assert gains.caption.endswith("means of 2 seeds, or of as many as brackets say")
    assert (
        "seeds"
        not in inverse.summarize([r for r in rows if not r["job"]["seed"]]).tables[0].caption
    )


def test_scenes_of_data_need_their_folder(tmp_path):
    command = "bench", "inverse", "--scene", "wall", "-o", tmp_path / "out"
    assert_refused(run(*command), "--scene wall needs DATA")


def test_gain_at_equal_seconds():
    """Half-way in the logarithm of the seconds lies half the gain; the best rival counts."""
    from eigengs_bench import inverse

    pyramid = {k: {"seconds": s, "psnr_rgb": p} for k, s, p in ((1, 1, 30), (2, 4, 40))}
    texels = {1: {"seconds": 6, "psnr_rgb": 35}}
    seconds = ((1, 2 / inverse.SLOWER), (2, 8), (3, 0.5))
    fits = {k: {"seconds": s, "psnr_rgb": 36} for k, s in seconds}
    assert inverse.gain({"pyramid": pyramid, "fit": fits}) == pytest.approx([1, -4, 6])
    assert inverse.gain({"pyramid": pyramid, "texels": texels, "fit": fits}) == pytest.approx(
        [1, -4, 1]
    )


# --- Photos under many lights ---


@pytest.fixture
def lit(tmp_path):
    """A set of photos with an ``.lp`` file, and one with photos of its own to measure on."""
    for name, lights in (("a", directions(20)), ("b/Dome", directions(12)), ("b/Test", LATER)):
        folder = tmp_path / "lit" / name
        folder.mkdir(parents=True)
        lines = [f"{k}.png {x} {y} {z}" for k, (x, y, z) in enumerate(lights)]
        (folder / "dirs.lp").write_text("\n".join([str(len(lines)), *lines]))
        for k, photo in enumerate(photos(lights)):
            save_image(folder / f"{k}.png", photo)
    return tmp_path / "lit"


LATER = directions(5, 0.5) @ np.diag([-1, 1, 1])


@pytest.mark.mitsuba
@few_groups()
def test_relight(lit, tmp_path, backend, monkeypatch):
    pytest.importorskip("mitsuba")
    eg.register_plugins()  # before the first row, which names the threads of Dr.Jit
    small = {"PLANES": (6,), "QUALITIES": (30, 90), "PIXELS": (16,), "BUDGETS": (0.5,)}
    for name, value in (small | {"FOUND": 1, "STEPS": 2}).items():
        monkeypatch.setattr(relight, name, value)
    shutil.rmtree(lit / "b")
    rows, text = answered(tmp_path / "out", "relight", lit, "--iterations", 5, "--backend", backend)
    assert {row["job"]["set"] for row in rows} == {"a"}
    assert {row["job"]["method"] for row in rows} == {relight.OURS, *relight.METHODS}
    points = [point for row in rows for point in row["points"]]
    assert all(p["bytes_per_pixel"] == p["bytes"] / 24**2 for p in points)
    assert "median" in text and (tmp_path / "out" / "relight.svg").exists()
    assert relight.summarize(rows[:-1]) == Section()  # the run was stopped
    missing = run("bench", "relight", lit, "--set", "c", "-o", tmp_path / "other")
    assert_refused(missing, "--set c", "has a")


def test_every_fifth_light_is_left_out(lit):
    """Unless a set has photos to measure on."""
    assert relight.sets_of(lit) == ["a", "b"]
    seen, unseen = relight.photos_of(lit / "a")
    np.testing.assert_allclose(unseen.lights, directions(20)[2::5], atol=1e-9)
    assert len(seen.photos) == 16
    np.testing.assert_allclose(relight.photos_of(lit / "b")[1].lights, LATER, atol=1e-9)


@pytest.mark.parametrize("tuned", [False, True])
@pytest.mark.parametrize("kind", ["JPEG", "AVIF"])
def test_coded_planes_are_near_the_planes(kind, tuned):
    y, x = np.mgrid[:32, :32] / 32
    planes = np.stack([np.sin(3 * x + k) / (k + 1) for k in range(6)], 2).astype(np.float32)
    size, found = relight.coded(planes + y[..., None], kind, tuned, 95)
    assert size > 200
    assert np.abs(found - planes - y[..., None]).max() < 0.05


def test_bytes_at_a_psnr():
    points = pd.DataFrame({"bytes_per_pixel": [1.0, 4.0, 2.0], "psnr_rgb": [30.0, 34.0, 29.0]})
    assert relight.at_level(points, 32.0) == (pytest.approx(2.0), 0.0)
    assert relight.at_level(points, 40.0) == (4.0, -6.0)
    assert relight.at_level(points, 28.0) == (1.0, 2.0)
