"""One small run of each command: it measures, shows tables and charts, and goes on."""

import shutil

import numpy as np
import pandas as pd
import pytest

import eigengs_dr as eg
from _helpers.benchmarks import (  # noqa: F401  data is a fixture
    data,
    one_image,
    smaller,
    task_in,
)
from _helpers.command import assert_refused, run, said
from _helpers.lit_spheres import directions, photos
from eigengs_bench import alike, cases, inverse, kernels, rate, relight, scaling, texture
from eigengs_bench.images import images_of
from eigengs_bench.names import SETS, SUBJECTS_OF_SAMPLES, ImageSet
from eigengs_bench.report import Section
from eigengs_bench.rows import FILE, read
from eigengs_bench.subjects import SUBJECTS, photos_of, scene_of

slow = pytest.mark.slow


def answered(out, bench, *arguments):
    """The rows and the texts of a command, which does nothing if it is called again."""
    command = ("bench", bench, *arguments, "-o", out)
    told = said(*command)
    rows, before = read(out / FILE, bench), (out / FILE).read_bytes()
    assert said(*command) == told and (out / FILE).read_bytes() == before
    return rows, told


@pytest.fixture
def small(monkeypatch):
    """Samples as small as the basis allows that ships, and a few Gaussians."""
    monkeypatch.setitem(SETS, "samples", ImageSet("", 72, 72, 60))


def test_mistakes_are_told_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    for command in ("pareto", "rate", "number", "stability", "pictures", "tables"):
        assert_refused(run("bench", command, "-o", tmp_path / "file"), "File exists")
    output = ["-o", tmp_path / "out"]
    assert_refused(run("bench", "pareto", *output, "--set", "kodak"), "needs DATA")
    unknown = "case 'nothing' is unknown; use one of photo, constant"
    assert_refused(run("bench", "stability", *output, "--case", "nothing"), unknown)
    nothing = run("bench", "tables", *output, "--table", "ablation")
    assert_refused(nothing, "leave nothing to measure")
    assert_refused(run("bench", "inverse", *output, "--scene", "wall"), "--scene wall needs DATA")


@slow
def test_tables(data, tmp_path, backend):  # noqa: F811
    arguments = (data, "--set", "cats256", "--images", 1, "--iterations", 12, "--backend", backend)
    rows, text = answered(tmp_path / "out", "tables", *arguments)
    ends = {row["job"]["preset"]: row["moments"][-1] for row in rows if "moments" in row}
    assert set(ends) == {"default", "gaussianimage", "eigengs"}
    for words in ("eigengs, own basis", "eigengs, universal basis", "psnr_ycbcr / psnr_rgb in dB"):
        assert words in text
    image = images_of(task_in(tmp_path, data=data, images=1), "cats256")[0][1]
    expected = eg.fit(image, 60, 12, backend=backend).psnr_rgb
    assert ends["default"]["psnr_rgb"] == pytest.approx(expected)


@slow
def test_pictures(data, tmp_path):  # noqa: F811
    out = tmp_path / "out"
    rows, text = answered(out, "pictures", data, "--images", 1, "--iterations", 3)
    assert (out / "curves.svg").exists() and "gaussianimage" in text
    assert {row["job"]["set"] for row in rows} == {"cats256", "natural256"}


@slow
def test_pareto(small, tmp_path):
    rows, text = answered(tmp_path / "out", "pareto", "--images", 1, "--iterations", 3)
    knobs = {row["job"]["knob"] for row in rows}
    assert knobs == {"preset", "init", "solve steps", "cutoff", "gaussians"}
    default = next(row for row in rows if row["job"]["value"] == "default")
    assert [m["iteration"] for m in default["trace"]] == [0, 3] and default["gaussians"] == 60
    assert "preset default" in text and "gaussians 240" in text
    assert (tmp_path / "out" / "pareto-samples.svg").exists()


@slow
def test_stability(monkeypatch, tmp_path):
    """A useless start is kept: the table shows the descent from it."""
    photo = cases.Case("photo", lambda: cases.photo(32, 32), 60, 100)
    made = {
        "photo": photo._replace(iterations=5, seeds=(0, 1)),
        "heap": photo._replace(place=cases.heap),
        "thin": photo._replace(image=lambda: cases.photo(70, 71)),
    }
    for name, case in made.items():
        monkeypatch.setitem(cases.CASES, name, case._replace(name=name))
    options = [word for name in made for word in ("--case", name)]
    rows, text = answered(tmp_path / "out", "stability", *options)
    cells = {(row["job"]["case"], row["job"]["preset"]): row for row in rows}
    assert "photo" in text and " to " in text
    first, *_, last = eg.fit(cases.photo(32, 32), 60, 5, seed=1).trace
    seeded = cells["photo", "default"]
    ends = [row["psnr_ycbcr"] for row in (first, last)]
    assert [seeded["start_ycbcr"], seeded["end_ycbcr"]] == pytest.approx(ends)
    assert cells["thin", "eigengs"]["needs"] == "a basis with at most 4970 Gaussians"
    heap, recipe = cells["heap", "default"], cells["heap", "gaussianimage"]
    assert "needs" in cells["heap", "eigengs"] and heap["gaussians"] == 60
    assert heap["end_ycbcr"] > heap["start_ycbcr"] > recipe["start_ycbcr"]
    assert heap["end_ycbcr"] > recipe["end_ycbcr"]


@slow
def test_kodak(tmp_path, monkeypatch):
    monkeypatch.setitem(SETS, "kodak", ImageSet("kodak", 32, 24, 40))
    (tmp_path / "kodak").mkdir()
    eg.save_image(tmp_path / "kodak" / "a.png", one_image()[:24])
    arguments = (tmp_path, "--counts", 40, "--steps", 3, "--timed")
    [found], text = answered(tmp_path / "out", "kodak", *arguments)
    [(_, image)] = images_of(task_in(tmp_path, data=tmp_path), "kodak")
    error = np.clip(eg.fit(image, 40, 3, space="rgb").image, 0, 1).astype(np.float64) - image
    assert found["psnr_float"] == pytest.approx(-10 * np.log10(np.mean(error**2)), abs=1e-6)
    assert "GaussianImage" in text and "measured" in text
    for chart in ("kodak-gaussians", "kodak-speed"):
        assert (tmp_path / "out" / f"{chart}.svg").exists()


@slow
def test_number(small, tmp_path):
    arguments = ("--images", 1, "--iterations", 5, "--target", 20)
    [searched], text = answered(tmp_path / "out", "number", *arguments)
    assert searched["stopped"] in ("met", "out of reach") and "20 dB" in text


@slow
def test_rate(small, tmp_path, monkeypatch):
    for name, codec in rate.CODECS.items():
        monkeypatch.setitem(rate.CODECS, name, codec._replace(settings=codec.settings[5:10:4]))
    rows, text = answered(tmp_path / "out", "rate", "--images", 1, "--iterations", 3)
    packed = [row["points"][0] for row in rows if row["job"]["codec"] == rate.OURS]
    assert all(p["bits_per_pixel"] == 8 * p["bytes"] / 72**2 for p in packed) and len(packed) == 6
    assert {row["job"]["codec"] for row in rows} == {rate.OURS, *rate.CODECS}
    assert "JPEG XL" in text and "AVIF 4:4:4" in text


@slow
def test_scaling(tmp_path):
    arguments = ("--part", "pixels", "--iterations", 2, "--max-side", 128)
    [row], _ = answered(tmp_path / "out", "scaling", *arguments)
    assert row["job"]["gaussians"] == 1250
    assert row["step_ms"] > 0 and row["start_seconds"] > 0
    assert scaling.measure_fits(scaling.Case(16, 16, 20), 1, "llvm", 1e-9)["many_ratio"] > 0


@slow
def test_kernels(monkeypatch, backend, tmp_path):
    smaller(monkeypatch, kernels, SIDE=64, COUNT=300, ROUNDS=2, PEAK_LANES=1 << 10)
    told = said("bench", "kernels", "--backend", backend, "-o", tmp_path)
    [found] = read(tmp_path / FILE)
    assert found["step_ms"] > 0 < found["forward_peak_fraction"] and "forward_ms" in told


@slow
@pytest.mark.mitsuba
def test_texture(monkeypatch, tmp_path):
    pytest.importorskip("mitsuba")
    counts = {"COUNTS": (20,), "SETTLED": 20, "CHANGED": (20,), "HELD": (20,)}
    smaller(monkeypatch, texture, SIDE=16, TEXELS=16, SPP=1, STEPS=2, ROUNDS=1, **counts)
    images = {"PHOTOS": ("coffee",), "MAPS": ("gravel",)}
    smaller(monkeypatch, alike, TEXELS=64, PIXELS=32, GOAL=25.0, **images)
    smaller(monkeypatch, alike, ROWS=32, SIDE=8, SPP=4, STEPS=5, ROUNDS=1)
    text = said("bench", "texture", "-o", tmp_path)  # it times the ball anew each time
    photo, material, letters, *lights, ball = read(tmp_path / FILE, "texture")
    for found, goal in ((photo, 25), (material, 25), (letters, alike.TEXT_GOAL)):
        assert found["psnr"] >= goal and found["psnr_bitmap"] >= goal and found["side"] <= 64
        assert found["filtered_bytes"] > found["bytes"] > 0
    # Texels of a colour take four bytes, those of a map one.
    assert photo["bitmap_bytes"] == pytest.approx(4 * photo["side"] ** 2, rel=0.1)
    assert material["bitmap_bytes"] == pytest.approx(material["side"] ** 2, rel=0.1)
    assert ball["bytes_20"] > 0 and ball["held_20"] > 0
    assert ball["ratio_20"] > 0 and ball["ratio_step_filtered"] > 0
    assert "memory, sharp text" in text and "coffee" in text
    for light in lights:
        # A fit of logarithms for 25 dB: nothing keeps the mean of its light.
        assert 0 <= light["mean"] < 0.5 and light["variance"] > 0 and light["ratio"] > 0
        assert 15 < light["lookups"] < 60 and light["images"] > 20 and light["bytes"] > 0


@slow
@pytest.mark.mitsuba
def test_inverse(monkeypatch, tmp_path):
    pytest.importorskip("mitsuba")
    smaller(monkeypatch, inverse, WARM_UP=4, STEPS_OF_MAPS=16)
    for name, subject in SUBJECTS.items():
        one = subject._replace(texels=64, side=16, cameras=(2,), runs={4: (4, 16)})
        monkeypatch.setitem(SUBJECTS, name, one)
    scenes = ("--scene", "ball", "--scene", "material", "--seeds", "1")
    rows, text = answered(tmp_path / "out", "inverse", *scenes, "--backend", "llvm")
    ball, material = rows[:8], rows[8:]
    for first, then in zip(ball[:3], ball[3:6], strict=True):
        assert first["job"]["method"] == then["job"]["method"] in inverse.METHODS
        assert first["seconds"] > 0 and 5 < first["psnr_rgb"] < then["psnr_rgb"]
    descents = [(row["job"]["steps"], row["job"]["method"]) for row in material]
    longer = [(24, method) for method in inverse.RIVALS]
    assert descents == [(steps, m) for steps in (4, 16) for m in inverse.METHODS] + longer
    assert all(row["albedo"] > 5 and row["roughness_constant"] > 5 for row in material)
    assert "ball, 2 cameras" in text and "within equal seconds" in text


@slow
@pytest.mark.mitsuba
def test_photos_of_all_scenes(monkeypatch):
    """Each scene shows its texture: photos depend on most of it, and differ from those of grey."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    for name in SUBJECTS_OF_SAMPLES:
        monkeypatch.setitem(SUBJECTS, name, SUBJECTS[name]._replace(texels=64, side=32))
        scene = scene_of(mi, name, 3, None)
        grey = photos_of(mi, scene.load(mi), 3)
        for photo, other in zip(scene.photos[3:], grey, strict=True):
            assert np.isfinite(photo).all() and np.abs(photo - other).mean() > 0.01
        assert np.mean(scene.seen > 0) > 0.3


# --- Photos under many lights ---

LATER = directions(5, 0.5) @ np.diag([-1, 1, 1])


@pytest.fixture
def lit(tmp_path):
    """A set of photos with an ``.lp`` file, and one with photos of its own to measure on."""
    for name, lights in (("a", directions(20)), ("b/Dome", directions(12)), ("b/Test", LATER)):
        folder = tmp_path / "lit" / name
        folder.mkdir(parents=True)
        lines = [f"{k}.png {x} {y} {z}" for k, (x, y, z) in enumerate(lights)]
        (folder / "dirs.lp").write_text("\n".join([str(len(lines)), *lines]))
        for k, photo in enumerate(photos(lights)):
            eg.save_image(folder / f"{k}.png", photo)
    return tmp_path / "lit"


@slow
@pytest.mark.mitsuba
def test_relight(lit, tmp_path, monkeypatch):
    pytest.importorskip("mitsuba")
    eg.register_plugins()  # before the first row, which names the threads of Dr.Jit
    few = {"PLANES": (3,), "PIXELS": (None, 8), "BUDGETS": (0.5, 4.0)}
    smaller(monkeypatch, relight, **few)
    shutil.rmtree(lit / "b")
    list_of_lights = lit / "a" / "dirs.lp"
    list_of_lights.write_text(list_of_lights.read_text().replace("20", "19", 1))  # only a warning
    rows, text = answered(tmp_path / "out", "relight", lit, "--iterations", 5)
    assert {row["job"]["set"] for row in rows} == {"a"}
    assert {row["job"]["method"] for row in rows} == {relight.OURS, *relight.METHODS}
    points = [point for row in rows for point in row["points"]]
    assert all(p["bytes_per_pixel"] == p["bytes"] / 24**2 for p in points)
    assert "median" in text and (tmp_path / "out" / "relight.svg").exists()
    assert relight.summarize(rows[1:]) == Section()  # the run has not measured the default
    missing = run("bench", "relight", lit, "--set", "c", "-o", tmp_path / "other")
    assert_refused(missing, "--set c", "has a")


def test_ratios_of_bytes_are_those_of_equal_psnr():
    """Half the bytes at each PSNR; where ours begins above the other's end, that of the ends."""
    sizes, psnrs = np.array([1.0, 2.0, 4.0]), np.array([30.0, 31.0, 32.0])
    other = pd.DataFrame({"bytes_per_pixel": sizes, "psnr_rgb": psnrs})
    ours = pd.DataFrame({"bytes_per_pixel": sizes / 2, "psnr_rgb": psnrs})
    np.testing.assert_allclose(relight.ratios(ours, other), [0.5] * 5)
    np.testing.assert_allclose(relight.ratios(ours, other[1:2]), [0.5] * 5)
    assert list(relight.ratios(ours.assign(psnr_rgb=psnrs + 9), other)) == [0.5 / 4]
    assert not len(relight.ratios(ours, other.assign(psnr_rgb=psnrs + 9)))


def test_a_network_learns_a_set(lit):
    pytest.importorskip("torch")
    row = relight.network(*relight.photos_of(lit / "b"))
    assert row["points"][0]["psnr_rgb"] > 15 and row["seconds"] > 0


def test_every_fifth_light_is_left_out(lit):
    """Unless a set has photos to measure on."""
    assert relight.sets_of(lit) == ["a", "b"]
    seen, unseen = relight.photos_of(lit / "a")
    np.testing.assert_allclose(unseen.lights, directions(20)[2::5], atol=1e-9)
    assert len(seen.photos) == 16
    np.testing.assert_allclose(relight.photos_of(lit / "b")[1].lights, LATER, atol=1e-9)
