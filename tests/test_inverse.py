"""Posters recovered from photos: the benchmark runs, and coefficients find a family's member."""

import json

import drjit as dr
import numpy as np
import pytest
from click.testing import CliRunner
from scenes import family, small_model

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")

import eigengs_dr as eg  # noqa: E402
from eigengs_dr.bench import inverse, poster, unknowns  # noqa: E402
from eigengs_dr.bench.unknowns import METHODS, Coefficients  # noqa: E402
from eigengs_dr.cli.main import main  # noqa: E402
from eigengs_dr.raster.render import picture_of  # noqa: E402

FIGURES = {"psnr_ycbcr", "psnr_rgb", "seconds", "goal_steps", "goal_seconds"}
TINY = poster.Condition(cameras=(poster.FRONT,), side=24, samples=64)


@pytest.fixture(autouse=True)
def variant():
    """The one that the benchmark sets, and then that before."""
    before = mi.variant()
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("the llvm backend is not there")
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    yield
    if before:
        mi.set_variant(before)


@pytest.fixture(scope="module")
def basis(tmp_path_factory):
    path = tmp_path_factory.mktemp("inverse") / "basis.npz"
    small_model("llvm").save(path)
    return path


@pytest.fixture
def small(monkeypatch):
    """Photos of so few pixels that only the arithmetic is tested."""
    tiny = {
        name: condition._replace(side=16, samples=4)
        for name, condition in poster.CONDITIONS.items()
    }
    monkeypatch.setattr(inverse, "CONDITIONS", tiny)


def a_member():
    """An image of the family, and within the reach of its components."""
    model = small_model("llvm")
    return picture_of(model.encode(family()[0], "projected"))


def test_the_command_runs_everything(small, basis, tmp_path):
    photo, report = tmp_path / "photo.png", tmp_path / "report.json"
    eg.save_image(photo, a_member())
    arguments = ["--basis", basis, "--steps", 3, "--report", report, "--backend", "llvm"]
    pictures = ["--chart", tmp_path / "chart.png", "--strip", tmp_path / "strip.png"]
    arguments = ["bench", "inverse", photo, *arguments, *pictures]
    told = CliRunner().invoke(main, list(map(str, arguments)))
    assert told.exit_code == 0, told.output
    found = json.loads(report.read_text())
    for condition in poster.CONDITIONS:
        for method in METHODS:
            key = f"{condition}_{method}"
            assert {f"{key}_{figure}" for figure in FIGURES} <= set(found)
            assert f"{condition} {method}" in told.output
            assert (f"{key}_psnr_ycbcr_hidden" in found) == (condition == "hidden")
            trace = found["traces"][condition][method]
            assert trace["steps"] == [0, 1, 2, 3]
            assert trace["seconds"] == sorted(trace["seconds"])
            assert trace["psnr_ycbcr"][-1] == found[f"{key}_psnr_ycbcr"]
        assert eg.load_image(tmp_path / f"strip-{condition}.png").shape[0] > 500
    assert (tmp_path / "chart.png").stat().st_size > 10_000


def recovered(basis, method, steps, condition=TINY):
    model = eg.EigenGS.load(basis, "llvm")
    photos, texture = poster.photograph(condition, a_member())
    truth = poster.head_on(texture, 32, 32)
    stages = METHODS[method](model, basis, steps)
    return inverse.recover(condition, photos, stages, truth, steps)


def test_coefficients_find_a_member_of_the_family(basis):
    found = recovered(basis, "coefficients", 12).psnr_ycbcr
    assert found[-1] > found[0] + 6


def test_gaussians_go_on_from_the_coefficients(basis, monkeypatch):
    monkeypatch.setattr(unknowns, "FIRST_STAGE", 0.2)  # 4 of 20 steps
    trace = recovered(basis, "both", 20)
    first = trace.psnr_ycbcr[trace.steps.index(4)]
    assert trace.steps[-1] == 20
    assert trace.psnr_ycbcr[-1] > first > trace.psnr_ycbcr[0] + 3
    # They start as what the coefficients stand for.
    assert trace.psnr_ycbcr[trace.steps.index(5)] > first - 2


def test_what_is_hidden_stays(basis):
    """No gradient reaches texels behind the board; those beside it change."""
    start, end = (
        recovered(basis, "texels256", 3, TINY._replace(hidden=True)).pictures[k] for k in (0, 3)
    )
    change = np.abs(end - start).max(axis=(0, 2))
    assert (change[18:] < 1e-3).all()
    assert (change[:15] > 1e-3).all()


def test_gradients_reach_the_coefficients(basis):
    """The derivative of a rendering is that of finite differences."""
    unknown = Coefficients(eg.EigenGS.load(basis, "llvm"), basis)
    scene = poster.scene_of(TINY, unknown.texture)
    parameters = mi.traverse(scene)

    def brightness(first):
        start = np.zeros(unknown.precisions.shape, np.float32)
        start[0, 0] = first
        value = mi.TensorXf(start)
        dr.enable_grad(value)
        unknown.put({unknown.key: value}, parameters)
        parameters.update()
        shown = mi.render(scene, params=parameters, spp=256, seed=1)
        return value, dr.mean(shown, axis=None)

    value, mean = brightness(0.0)
    dr.backward(mean)
    step = 0.05
    low, high = (float(brightness(x)[1].array[0]) for x in (-step, step))
    assert dr.grad(value).numpy()[0, 0] == pytest.approx((high - low) / (2 * step), rel=0.1)


def test_head_on_is_the_picture():
    """Row 0 above, column 0 left, coded as it was."""
    image = a_member()
    texture = poster.bitmap(eg.color.to_linear(image))
    np.testing.assert_allclose(poster.head_on(texture, 32, 32), image, atol=0.05)


def test_photos_are_upright():
    """A poster that is white on its left and black below is so from the front."""
    image = np.zeros((32, 32, 3), np.float32)
    image[:16, :16] = 1
    photos, _ = poster.photograph(TINY, image)
    quarter = photos.numpy().mean(axis=2)[4:20, 4:20]
    assert quarter[:7, :7].mean() > 5 * max(quarter[9:, :7].mean(), quarter[:7, 9:].mean())
