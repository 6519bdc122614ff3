"""The paper's pictures, on images so small that only what goes where is tested."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from _helpers.benchmarks import RUN, family, run, small_model, task_in
from eigengs_bench.experiments import figure_strips, figures
from eigengs_bench.harness import datasets
from eigengs_bench.harness.datasets import images_of
from eigengs_bench.harness.store import read
from eigengs_bench.names import FIGURES, SETS
from eigengs_bench.report import charts as strips
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.fitting.fit import fit
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.io import save_image
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import picture_of
from eigengs_dr.viewer.pictures import overlay

CREDIT = "AFHQ, NAVER Corp., CC BY-NC 4.0"


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """All figures of three tiny sets, and what strips and charts were called with."""
    data, folder = tmp_path_factory.mktemp("data"), tmp_path_factory.mktemp("figures")
    for seed, name in enumerate(("cats512", "natural256", "kodak")):
        images = family(24, seed=seed + 1)
        parts = {"": images[:3]} if name == "kodak" else {"train": images[3:], "test": images[:3]}
        for part, chosen in parts.items():
            (data / name / part).mkdir(parents=True)
            for number, image in enumerate(chosen):
                save_image(data / name / part / f"{number}.png", image)
    seen, notes = {"strip": [], "curves_chart": [], "radii_chart": []}, []
    with pytest.MonkeyPatch.context() as patch:
        for name, chosen in SETS.items():
            patch.setitem(SETS, name, chosen._replace(width=32, height=32, gaussians=60))
        patch.setattr(datasets, "MAX_COMPONENTS", 10)
        patch.setattr(figures, "EVERY", 2)
        patch.setattr(figure_strips, "COMPONENTS", 8)
        load = EigenGS.load
        patch.setattr(
            EigenGS,
            "load",
            lambda name, *a: small_model("llvm") if name == "natural" else load(name, *a),
        )

        def spy(module, name):
            function = getattr(module, name)
            patch.setattr(module, name, lambda *a: seen[name].append(a) or function(*a))

        spy(figure_strips, "strip")
        spy(figures, "curves_chart")
        spy(figures, "radii_chart")
        task = task_in(folder, "llvm", data, images=2, iterations=4)
        made = figures.run(task, note=notes.append)
        yield SimpleNamespace(task=task, folder=folder, made=made, seen=seen, notes=notes)


def model(drawn, kind, source="cats256"):
    return EigenGS.load(drawn.folder / "models" / f"{source}-32x32-ycbcr-8-60-{kind}.npz")


def test_all_figures_are_drawn_listed_and_credited(drawn):
    assert [figure.name for figure in drawn.made] == 3 * ["iterations"] + list(FIGURES[1:])
    listed = json.loads((drawn.folder / "figures.json").read_text())["figures"]
    for entry, figure in zip(listed, drawn.made, strict=True):
        assert entry["run"]["commit"] == RUN["commit"]
        assert {key: entry[key] for key in figure._fields} == figure._asdict()
        assert 0 < (drawn.folder / figure.path).stat().st_size < 300_000
        cats = figure.path.startswith("cats-")
        assert figure.credit == (CREDIT if cats else "")
    credits = [credit for _, credit, _ in drawn.seen["strip"]]
    assert credits == ["", "", CREDIT, "", CREDIT, CREDIT]
    assert not drawn.notes


def first_fit(drawn, image, preset):
    """Start a fit as a preset does."""
    start = model(drawn, "auto") if preset == "eigengs" else None
    return fit(image, 60, 0, start=start, preset=preset, backend="llvm")


def test_iterations_are_those_of_the_presets(drawn):
    """The start of each row is that of `fit`."""
    rows, *_ = drawn.seen["strip"][2]
    [(_, image)] = images_of(drawn.task, "cats256", 1)
    assert [heading.split(":")[0] for heading, _ in rows] == ["gaussianimage", "eigengs", "default"]
    for heading, (first, last, photo) in rows:
        np.testing.assert_array_equal(photo[1], image)
        start = first_fit(drawn, image, heading.split(":")[0]).image
        np.testing.assert_allclose(first[1], start, atol=1e-5)
        assert first[0] == f"iteration 0: {psnr(start, image, 'ycbcr'):.1f} dB"
        assert last[0] == f"iteration 4: {psnr(last[1], image, 'ycbcr'):.1f} dB"
        assert psnr(last[1], image) > psnr(start, image)


def test_colors_have_both_psnrs_and_the_error(drawn):
    rows, *_ = drawn.seen["strip"][3]
    assert ["YCbCr;" in rows[0][0], "RGB;" in rows[1][0]] == [True, True]
    for _, (photo, fitted, error) in rows:
        shown = (error[1] - 0.5) / figure_strips.MAGNIFIED
        np.testing.assert_allclose(shown, fitted[1] - photo[1], atol=1e-6)
        both = [psnr(fitted[1], photo[1], space) for space in ("ycbcr", "rgb")]
        assert fitted[0] == "iteration 4: {:.1f} / {:.1f}".format(*both)


def test_curves_are_means_over_the_images(drawn):
    [(panels, marks, *_)] = drawn.seen["curves_chart"]
    measured = read(drawn.folder / "curves.jsonl")
    assert list(panels) == ["cats", "ImageNet", 'Kodak, basis "natural"'] and marks == [0, 2, 4]
    assert len(measured) == 3 * 3 * 2
    for preset, values in panels["cats"].items():
        same = {"set": "cats256", "preset": preset}
        own = [row["psnr_ycbcr"] for row in measured if same.items() <= row["job"].items()]
        assert len(own) == 2
        np.testing.assert_allclose(values, np.mean(own, axis=0))
        fits = [first_fit(drawn, image, preset) for _, image in images_of(drawn.task, "cats256")]
        expected = np.mean([fitted.trace[0]["psnr_ycbcr"] for fitted in fits])
        assert values[0] == pytest.approx(expected, abs=0.01)


def test_a_second_run_measures_nothing_again(drawn, monkeypatch):
    def fail(*arguments):
        raise AssertionError("measured again")

    before = (drawn.folder / "curves.jsonl").read_bytes()
    monkeypatch.setattr(figure_strips, "preset_descent", fail)
    figures.run(drawn.task, ["curves"])
    again = figures.read_list(drawn.folder / "figures.json")
    assert [figure["path"] for figure in again] == [figure.path for figure in drawn.made]
    assert (drawn.folder / "curves.jsonl").read_bytes() == before
    with pytest.raises(AssertionError, match="measured again"):
        figures.run(drawn.task._replace(seed=1), ["curves"])


def test_radii_are_told_apart_by_the_split(drawn):
    [(panels,)] = drawn.seen["radii_chart"]
    (none, whole), (low, high) = panels.values()
    assert (none.shape, whole.shape) == ((2, 0), (2, 60))
    assert (low.shape, high.shape) == ((2, 6), (2, 54))
    assert low.min() > 1.5 * np.median(high)


def test_the_radius_is_the_geometric_mean():
    factor = [[1 / 2, 0, 1 / 3], [1 / 5, 0.3, 1.0]]  # det F = 1 / (s t)
    splats = Gaussians.from_arrays([[1, 1]] * 2, factor, [[1.0]] * 2, size=(9, 9), space="data")
    np.testing.assert_allclose(figures.radii_of(splats), np.sqrt([6, 5]), rtol=1e-5)


def test_both_parts_of_a_split_make_the_whole(drawn):
    [(_, top), (_, bottom)], _, _ = drawn.seen["strip"][4]
    photo, low, high = (picture for _, picture in top)
    encoded = model(drawn, "split").encode(photo)
    np.testing.assert_allclose(bottom[0][1], picture_of(encoded), atol=1e-5)
    np.testing.assert_allclose(low + high - 0.5, bottom[0][1], atol=1e-5)
    np.testing.assert_allclose(low, picture_of(encoded[:6]), atol=1e-5)
    large = high.repeat(4, axis=0).repeat(4, axis=1)
    outlines = overlay(encoded[6:], large)[32:96, 32:96]
    np.testing.assert_allclose(bottom[2][1], outlines, atol=1e-5)
    assert "6 for low" in top[1][0] and "54 for high" in top[2][0]


def test_cats_are_projected_on_every_basis(drawn):
    rows, *_ = drawn.seen["strip"][5]
    bases = [model(drawn, "auto"), model(drawn, "auto", "natural256"), small_model("llvm")]
    for (_, cells), (_, image) in zip(rows, images_of(drawn.task, "cats256", 3), strict=True):
        np.testing.assert_array_equal(cells[0][1], image)
        for (caption, picture), basis in zip(cells[1:], bases, strict=True):
            expected = picture_of(basis.encode(image, "projected"))
            np.testing.assert_allclose(picture, expected, atol=1e-5)
            assert f"{psnr(expected, image, 'ycbcr'):.1f} dB" in caption


def test_without_data_photos_are_fitted(tmp_path):
    folder = tmp_path / "new" / "figures"
    told = run("bench", "figures", "-o", folder, "--iterations", 1, "--backend", "llvm")
    assert told.exit_code == 0, told.output
    assert told.stderr.count("\n") == 1
    for word in ("left out: curves, radii, split, cross", "no folder DATA"):
        assert word in told.stderr
    listed = figures.read_list(folder / "figures.json")
    paths = [figure["path"] for figure in listed]
    assert paths == ["iterations-coffee.jpg", "colors.jpg"]
    assert all("--iterations 1" in figure["run"]["command"] for figure in listed)
    for path in paths:
        assert path in told.stdout and Image.open(folder / path).width > 3 * strips.CELL


@pytest.mark.parametrize("text", ["{", "[]", '{"figures": [{"name": "colors"}]}'])
def test_a_damaged_list_is_told(tmp_path, text):
    (tmp_path / "figures.json").write_text(text)
    with pytest.raises(ValueError, match=r"figures.json: is damaged; delete it"):
        figures.run(task_in(tmp_path), ["colors"])


def test_mistakes_cost_one_line(tmp_path):
    for figure, data in (("curves", ()), ("split", (tmp_path,))):
        told = run("bench", "figures", *data, "-o", tmp_path / "x", "--figure", figure)
        assert told.exit_code == 2 and "no figure can be drawn" in told.stderr
    for folder in ("cats512/test", "cars256/train", "cars256/test", "kodak"):
        (tmp_path / folder).mkdir(parents=True)
    notes = []
    with pytest.raises(ValueError, match="no figure"):  # sets need images to train on
        figures.run(task_in(tmp_path, data=tmp_path), ["cross", "radii"], notes.append)
    assert notes == [f"left out: radii, cross: no such sets in {tmp_path}"]


def test_a_strip_has_pictures_above_their_captions():
    red, wide = np.zeros((10, 10, 3)), np.full((50, 100, 3), 0.5)
    red[..., 0] = 2  # clamped
    cell, gap, caption = strips.CELL, strips.GAP, 5 * strips.LETTERS // 4
    plain = strips.strip([("", [("a", red), ("", wide)])])
    assert plain.shape == (cell + caption + 2 + gap, 2 * (cell + gap), 3)
    np.testing.assert_allclose(plain[:cell, :cell], np.broadcast_to([1, 0, 0], (cell, cell, 3)))
    np.testing.assert_allclose(plain[: cell // 2, cell + gap : -gap], 0.5)
    below = plain[cell : cell + caption].min(axis=(0, 2))
    assert below[:cell].min() < 0.5 and below[cell:].min() == 1
    titled = strips.strip([("b", [("", red)])], credit="c")
    assert titled.shape[0] > plain.shape[0] + 5 * strips.HEADING // 4
    assert titled[-gap - caption :].min() < 0.5
