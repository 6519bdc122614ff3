"""The paper's pictures, on images so small that only what goes where is tested."""

import json
from types import SimpleNamespace

import click
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from scenes import covariances, factors_of, family, small_model

import eigengs_dr as eg
from eigengs_dr import cli_figures
from eigengs_dr.bench import figure_charts, figure_strips, figure_task, figures, sets
from eigengs_dr.bench.figure_pictures import CELL, HEADING, LETTERS, Cell, Row, save_strip, strip
from eigengs_dr.cli import pictures
from eigengs_dr.cli.console import Program
from eigengs_dr.image.metrics import psnr
from eigengs_dr.image.montage import GAP
from eigengs_dr.raster.render import picture_of

SETS = ("cats512", "natural256", "kodak")
MACHINE = {"command": "test", "cpu": "any"}
ITERATIONS, IMAGES = 4, 2
MARKS = (0, 2, 4)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Sets of 32x32 pixels; the other sets are not there."""
    folder = tmp_path_factory.mktemp("data")
    for seed, name in enumerate(SETS):
        images = family(24, seed=seed + 1)
        parts = {"": images[:3]} if name == "kodak" else {"train": images[3:], "test": images[:3]}
        for part, chosen in parts.items():
            (folder / name / part).mkdir(parents=True)
            for number, image in enumerate(chosen):
                eg.save_image(folder / name / part / f"{number}.png", image)
    return folder


@pytest.fixture(scope="module", autouse=True)
def small():
    """Sets, bases and charts as small as the images."""
    with pytest.MonkeyPatch.context() as patch:
        tiny = {n: s._replace(width=32, height=32, gaussians=60) for n, s in sets.SETS.items()}
        patch.setattr(sets, "SETS", tiny)
        patch.setattr(sets, "MOST_COMPONENTS", 10)
        patch.setattr(figure_task, "COMPONENTS", 8)
        patch.setattr(figure_charts, "EVERY", 2)
        panels = {name: figure_charts.PANELS[name] for name in ("faces256", "cats256", "kodak")}
        patch.setattr(figure_charts, "PANELS", panels)
        for module in (figure_charts, figure_strips):
            patch.setattr(module, "load_basis", lambda name, backend: small_model(backend))
        yield


@pytest.fixture(scope="module")
def drawn(data, tmp_path_factory):
    """All figures, what was handed to the functions that draw them, and the notes."""
    folder, seen, notes = tmp_path_factory.mktemp("figures"), {}, []
    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (figure_charts, "save_curves"),
            (figure_charts, "save_radii"),
            (figure_strips, "strip"),
        ):
            _recorded(patch, module, name, seen)
        settings = {"iterations": ITERATIONS, "images": IMAGES, "note": notes.append}
        made = figures.run(folder, data, MACHINE, backend="llvm", **settings)
    return SimpleNamespace(folder=folder, made=made, seen=seen, notes=notes)


def _recorded(patch, module, name, seen):
    function = getattr(module, name)

    def record(*arguments):
        seen.setdefault(name, []).append(arguments)
        return function(*arguments)

    patch.setattr(module, name, record)


def models(drawn, kind):
    return eg.EigenGS.load(drawn.folder / "models" / f"cats256-32x32-ycbcr-8-60-{kind}.npz")


def test_every_figure_is_drawn_and_listed(drawn):
    assert [figure.name for figure in drawn.made] == [
        *["iterations"] * 3,  # of a photo, one of Kodak, one cat
        *["colors", "curves", "radii", "split", "cross"],
    ]
    listed = json.loads((drawn.folder / "figures.json").read_text())
    for entry, figure in zip(listed["figures"], drawn.made, strict=True):
        assert "UTC" in entry["run"].pop("date")
        assert entry == {**figure._asdict(), "run": MACHINE}
    files = {
        path.name for path in drawn.folder.iterdir() if path.suffix in (".jpg", ".png", ".svg")
    }
    assert files == {figure.path for figure in drawn.made}
    for figure in drawn.made:
        assert figure.caption.endswith(".")
        assert (drawn.folder / figure.path).stat().st_size < 300_000


def test_cats_are_credited(drawn):
    for figure in drawn.made:
        shown = figure.name in ("split", "cross") or figure.caption.startswith("A cat")
        assert figure.path.startswith("cats-") == shown
        assert figure.credit == ("AFHQ, NAVER Corp., CC BY-NC 4.0" if shown else "")
    for figure, arguments in zip(drawn.made[:3], drawn.seen["strip"], strict=False):
        assert arguments[1] == figure.credit
    for arguments in drawn.seen["strip"][-2:]:
        assert "AFHQ" in arguments[1]


def test_what_is_missing_is_said_once(drawn):
    [note] = drawn.notes
    assert "curves (faces256, cars256)" in note
    assert "radii" not in note


def test_iterations_are_those_of_the_presets(drawn, data):
    """The start and the end of each row are what `fit` gives."""
    [rows, _] = drawn.seen["strip"][2]
    [(_, image)] = sets.test_images(data, "cats256", 1)
    assert [row.heading.split(":")[0] for row in rows] == ["gaussianimage", "eigengs", "default"]
    for row in rows:
        first, last, photo = row.cells
        np.testing.assert_array_equal(photo.picture, image)
        basis = models(drawn, "auto")
        preset = row.heading.split(":")[0]
        start = eg.fit(image, 60, 0, basis=basis, preset=preset, backend="llvm").image
        np.testing.assert_allclose(first.picture, start, atol=1e-5)
        assert first.caption == f"iteration 0: {psnr(start, image, 'ycbcr'):.1f} dB"
        assert last.caption == f"iteration 4: {psnr(last.picture, image, 'ycbcr'):.1f} dB"
        assert psnr(last.picture, image) > psnr(start, image)


def test_colors_have_both_psnrs_and_the_error(drawn):
    [rows, *_] = drawn.seen["strip"][3]
    assert ["YCbCr;" in rows[0].heading, "RGB;" in rows[1].heading] == [True, True]
    for row in rows:
        photo, fit, error = row.cells
        shown = (error.picture - 0.5) / figure_strips.MAGNIFIED
        np.testing.assert_allclose(shown, fit.picture - photo.picture, atol=1e-6)
        both = [psnr(fit.picture, photo.picture, space) for space in ("ycbcr", "rgb")]
        assert fit.caption == "iteration 4: {:.1f} / {:.1f}".format(*both)
    assert np.abs(rows[0].cells[1].picture - rows[1].cells[1].picture).max() > 1e-3


def test_curves_are_means_over_the_images(drawn, data):
    [(_, panels, *_)] = drawn.seen["save_curves"]
    measured = [json.loads(line) for line in (drawn.folder / "curves.jsonl").open()]
    assert list(panels) == ["cats", 'Kodak, basis "natural"']
    assert len(measured) == 2 * 3 * IMAGES
    images = dict(sets.test_images(data, "cats256", IMAGES))
    for curve in panels["cats"]:
        own = [
            row
            for row in measured
            if row["job"]["set"] == "cats256" and row["job"]["preset"] == curve.name
        ]
        assert [row["job"]["image"] for row in own] == list(images)
        assert tuple(curve.x) == MARKS
        np.testing.assert_allclose(curve.y, np.mean([row["psnr_ycbcr"] for row in own], axis=0))
        starts = [
            eg.fit(
                image, 60, 0, basis=models(drawn, "auto"), preset=curve.name, backend="llvm"
            ).trace[0]["psnr_ycbcr"]
            for image in images.values()
        ]
        assert curve.y[0] == pytest.approx(np.mean(starts), abs=0.01)


def test_a_second_run_measures_nothing_again(drawn, data, monkeypatch):
    def fail(*arguments):
        raise AssertionError("measured again")

    before = (drawn.folder / "curves.jsonl").read_bytes()
    listed = (drawn.folder / "figures.json").read_bytes()
    monkeypatch.setattr(figure_charts, "descent", fail)
    settings = {"iterations": ITERATIONS, "images": IMAGES}
    figures.run(drawn.folder, data, MACHINE, ["curves"], backend="llvm", **settings)
    again = figures.read_list(drawn.folder / "figures.json")
    assert [figure["path"] for figure in again] == [figure.path for figure in drawn.made]
    assert (drawn.folder / "curves.jsonl").read_bytes() == before
    with pytest.raises(AssertionError, match="measured again"):
        figures.run(drawn.folder, data, MACHINE, ["curves"], backend="llvm", seed=1, **settings)
    (drawn.folder / "figures.json").write_bytes(listed)


def test_radii_are_told_apart_by_the_split(drawn):
    [(_, [whole, split])] = drawn.seen["save_radii"]
    assert (len(whole.low), len(whole.high)) == (0, 60 * IMAGES)
    assert (len(split.low), len(split.high)) == (6 * IMAGES, 54 * IMAGES)
    assert split.low.min() > 1.5 * np.median(split.high)
    start = figure_charts.radii_of(models(drawn, "whole").gaussians)
    assert not np.allclose(np.sort(whole.high[:60]), np.sort(start), atol=1e-6)  # refined


def test_the_radius_is_the_geometric_mean():
    covariance = covariances(np.array([[4.0, 9.0], [25.0, 1.0]]), np.array([0.3, 2.0]))
    splats = eg.Gaussians.from_arrays(
        [[1, 1]] * 2, factors_of(covariance), [[1.0]] * 2, size=(9, 9), space="data"
    )
    np.testing.assert_allclose(figure_charts.radii_of(splats), np.sqrt([6, 5]), rtol=1e-5)


def test_both_parts_of_a_split_make_the_whole(drawn, data):
    [[top, bottom], _, _] = drawn.seen["strip"][4]
    photo, low, high = (cell.picture for cell in top.cells)
    encoded = models(drawn, "split").encode(photo)
    np.testing.assert_array_equal(photo, sets.test_images(data, "cats256", 1)[0][1])
    np.testing.assert_allclose(bottom.cells[0].picture, picture_of(encoded), atol=1e-5)
    np.testing.assert_allclose(low + high - 0.5, bottom.cells[0].picture, atol=1e-5)
    np.testing.assert_allclose(low, picture_of(encoded[:6]), atol=1e-5)
    large = high.repeat(4, axis=0).repeat(4, axis=1)
    outlines = pictures.overlay(encoded[6:], large)[32:96, 32:96]
    np.testing.assert_allclose(bottom.cells[2].picture, outlines, atol=1e-5)
    assert "6 for low" in top.cells[1].caption and "54 for high" in top.cells[2].caption


def test_cats_are_projected_on_every_basis(drawn, data):
    rows, _ = drawn.seen["strip"][5]
    images = [image for _, image in sets.test_images(data, "cats256", 3)]
    natural = eg.EigenGS.load(drawn.folder / "models" / "natural256-32x32-ycbcr-8-60-auto.npz")
    bases = [models(drawn, "auto"), natural, small_model("llvm")]
    for row, image in zip(rows, images, strict=True):
        np.testing.assert_array_equal(row.cells[0].picture, image)
        for cell, model in zip(row.cells[1:], bases, strict=True):
            expected = picture_of(model.encode(image, "projected"))
            np.testing.assert_allclose(cell.picture, expected, atol=1e-5)
            assert f"{psnr(expected, image, 'ycbcr'):.1f} dB" in cell.caption


@click.group(cls=Program)
def main():
    pass


main.add_command(cli_figures.figures)


def run(*arguments):
    return CliRunner().invoke(main, ["figures", *map(str, arguments)])


def test_without_data_photos_are_fitted(tmp_path):
    folder = tmp_path / "new" / "figures"
    result = run("-o", folder, "--iterations", 1, "--backend", "llvm")
    assert result.exit_code == 0, result.output
    assert result.stderr.count("\n") == 1
    for word in ("left out", "cross (cats256, natural256)", "no folder DATA"):
        assert word in result.stderr
    listed = json.loads((folder / "figures.json").read_text())
    paths = [figure["path"] for figure in listed["figures"]]
    assert paths == ["iterations-coffee.jpg", "colors.jpg"]
    assert all("--iterations 1" in figure["run"]["command"] for figure in listed["figures"])
    for path in paths:
        assert str(folder / path) in result.stdout
        assert Image.open(folder / path).width > 3 * CELL


@pytest.mark.parametrize("text", ["{", "[]", '{"figures": [{"name": "colors"}]}'])
def test_a_damaged_list_is_told(tmp_path, text):
    (tmp_path / "figures.json").write_text(text)
    with pytest.raises(ValueError, match=r"figures.json: is damaged; delete it"):
        figures.read_list(tmp_path / "figures.json")


def test_one_figure_alone(tmp_path):
    result = run("-o", tmp_path, "--iterations", 1, "--figure", "colors", "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert {path.name for path in tmp_path.iterdir()} == {"colors.jpg", "figures.json"}


def test_mistakes_cost_one_line(tmp_path):
    file = tmp_path / "file"
    file.touch()
    for arguments, words in (
        (["-o", file], ["file"]),
        (["-o", tmp_path, "--figure", "curves"], ["no figure can be drawn", "--figure colors"]),
        ([tmp_path, "-o", tmp_path, "--figure", "split"], ["no figure", "cats256", "no such sets"]),
        ([tmp_path / "gone", "-o", tmp_path], ["gone"]),
    ):
        result = run(*arguments)
        assert result.exit_code == 2
        assert "Traceback" not in result.output
        for word in words:
            assert word in result.stderr
    with pytest.raises(ValueError, match="'poses' is unknown; use one of iterations, colors"):
        figures.run(tmp_path, None, MACHINE, ["poses"])


def test_sets_need_images_to_train_on(tmp_path):
    for folder in ("cats512/test", "cars256/train", "cars256/test", "kodak"):
        (tmp_path / folder).mkdir(parents=True)
    told = []
    with pytest.raises(ValueError, match="no figure"):
        figures.run(tmp_path / "x", tmp_path, MACHINE, ["cross", "radii"], note=told.append)
    assert f": radii (cats256); cross (cats256, natural256): no such sets in {tmp_path}" in told[0]
    figures.run(tmp_path / "x", tmp_path, MACHINE, ["colors"], 1, note=told.append)
    assert len(told) == 1


def test_the_names_of_the_figures():
    assert cli_figures.NAMES == tuple(figures.STUDIES) == tuple(figures.USED)
    assert tuple(figures.NEEDED) == cli_figures.NAMES


def test_charts_need_matplotlib_before_the_work(data, tmp_path, monkeypatch):
    def missing(width, height):
        raise ValueError("charts need matplotlib")

    monkeypatch.setattr(figures.charts, "new_figure", missing)
    with pytest.raises(ValueError, match="need matplotlib"):
        figures.run(tmp_path / "x", data, MACHINE, ["radii"])
    assert not (tmp_path / "x").exists()


def test_a_strip_has_pictures_above_their_captions():
    red, wide = np.zeros((10, 10, 3)), np.full((50, 100, 3), 0.5)
    red[..., 0] = 2  # clamped
    plain = strip([Row("", [Cell("a", red), Cell("", wide)])])
    caption = 5 * LETTERS // 4
    assert plain.shape == (CELL + caption + 2 + GAP, 2 * (CELL + GAP), 3)
    np.testing.assert_allclose(plain[:CELL, :CELL], np.broadcast_to([1, 0, 0], (CELL, CELL, 3)))
    np.testing.assert_allclose(plain[: CELL // 2, CELL + GAP : -GAP], 0.5)
    below = plain[CELL : CELL + caption].min(axis=(0, 2))
    assert below[:CELL].min() < 0.5 and below[CELL:].min() == 1
    titled = strip([Row("b", [Cell("", red)])], credit="c")
    assert titled.shape[0] > plain.shape[0] + 5 * HEADING // 4
    assert titled[-GAP - caption :].min() < 0.5


def test_files_are_small(tmp_path):
    noise = np.random.default_rng(0).uniform(-0.5, 1.5, (64, 64, 3))
    save_strip(tmp_path / "a.png", noise)
    assert Image.open(tmp_path / "a.png").mode == "P"  # 256 colours
    smooth = np.linspace(0, 1, 64 * 64 * 3).reshape(64, 64, 3)
    for name in ("b.png", "b.jpg"):
        save_strip(tmp_path / name, smooth)
        saved = np.asarray(Image.open(tmp_path / name).convert("RGB")) / 255
        np.testing.assert_allclose(saved, smooth, atol=0.05)
