"""Posters recovered from photos: the benchmark runs, and coefficients find a family's member."""

import json

import numpy as np
import pytest

from _helpers.benchmarks import family, run, small_model

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
dr = pytest.importorskip("drjit")

from eigengs_bench.experiments import inverse  # noqa: E402
from eigengs_bench.experiments import inverse_scene as scenery  # noqa: E402
from eigengs_bench.experiments.inverse_scene import COEFFICIENTS, METHODS, coefficients  # noqa: E402
from eigengs_bench.names import CONDITIONS  # noqa: E402
from eigengs_dr.eigenbasis.eigengs import EigenGS  # noqa: E402
from eigengs_dr.image.color import to_linear  # noqa: E402
from eigengs_dr.image.io import load_image, save_image  # noqa: E402
from eigengs_dr.plugins import register_plugins  # noqa: E402
from eigengs_dr.raster.render import picture_of  # noqa: E402

TINY = scenery.Condition(cameras=(scenery.FRONT,), side=24, samples=64)


@pytest.fixture(autouse=True)
def variant():
    """The one that the benchmark sets, and then that before."""
    before = mi.variant()
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("the llvm backend is not there")
    mi.set_variant("llvm_ad_rgb")
    register_plugins()
    yield
    if before:
        mi.set_variant(before)


@pytest.fixture(scope="module")
def basis(tmp_path_factory):
    path = tmp_path_factory.mktemp("inverse") / "basis.npz"
    small_model("llvm").save(path)
    return path


def a_member():
    """An image of the family, and within the reach of its components."""
    model = small_model("llvm")
    return picture_of(model.encode(family()[0], "projected"))


def test_the_command_runs_everything(monkeypatch, basis, tmp_path):
    tiny = {
        name: condition._replace(side=16, samples=4)
        for name, condition in scenery.CONDITIONS.items()
    }
    assert tuple(tiny) == CONDITIONS
    monkeypatch.setattr(inverse, "CONDITIONS", tiny)
    photo, report = tmp_path / "photo.png", tmp_path / "report.json"
    save_image(photo, a_member())
    chosen = ("hidden", "grazing")
    arguments = [word for name in chosen for word in ("--condition", name)]
    arguments += ["--basis", basis, "--steps", 3, "--report", report, "--backend", "llvm"]
    pictures = ["--chart", tmp_path / "chart.png", "--strip", tmp_path / "strip.png"]
    told = run("bench", "inverse", photo, *arguments, *pictures)
    assert told.exit_code == 0, told.output
    found = json.loads(report.read_text())
    rows = {(row["condition"], row["method"]): row for row in found["results"]}
    assert set(rows) == {(condition, method) for condition in chosen for method in METHODS}
    for (condition, method), row in rows.items():
        assert (row["hidden"] is not None) == (condition == "hidden")
        trace = found["traces"][condition][method]
        assert trace["steps"] == [0, 1, 2, 3] and trace["seconds"] == sorted(trace["seconds"])
        assert trace["psnr_ycbcr"][-1] == row["psnr_ycbcr"]
        never = row["goal_steps"] is None
        assert never == (max(trace["psnr_ycbcr"]) < inverse.GOAL)
    for condition in chosen:
        assert f"{condition}, Gaussians from grey" in told.stdout
        assert load_image(tmp_path / f"strip-{condition}.png").shape[0] > 500
    assert (tmp_path / "chart.png").stat().st_size > 10_000
    wrong = run("bench", "inverse", photo, "--chart", tmp_path / "a.gif")
    assert wrong.exit_code == 2 and "must end in .png or .svg or .pdf" in wrong.stderr


def recovered(basis, method, steps, condition=TINY):
    model = EigenGS.load(basis, "llvm")
    photos, texture = scenery.photograph(condition, a_member())
    truth = scenery.head_on(texture, 32, 32)
    return inverse.recover(condition, photos, METHODS[method](model, basis, steps), truth, steps)


def test_coefficients_find_a_member_of_the_family(basis):
    found = recovered(basis, "coefficients", 12).psnr_ycbcr
    assert found[-1] > found[0] + 6


def test_gaussians_go_on_from_the_coefficients(basis, monkeypatch):
    monkeypatch.setattr(scenery, "FIRST_STAGE", 0.2)  # 4 of 20 steps
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
    unknown = coefficients(EigenGS.load(basis, "llvm"), basis)
    scene = scenery.scene_of(TINY, unknown.texture)
    parameters = mi.traverse(scene)

    def brightness(first):
        start = np.zeros(unknown.scale.shape, np.float32)
        start[0, 0] = first
        value = mi.TensorXf(start)
        dr.enable_grad(value)
        unknown.put({COEFFICIENTS: value}, parameters)
        parameters.update()
        return value, dr.mean(mi.render(scene, params=parameters, spp=256, seed=1), axis=None)

    value, mean = brightness(0.0)
    dr.backward(mean)
    low, high = (float(brightness(x)[1].array[0]) for x in (-0.05, 0.05))
    assert dr.grad(value).numpy()[0, 0] == pytest.approx((high - low) / 0.1, rel=0.1)


def test_pictures_are_upright_and_coded():
    """Row 0 above, column 0 left; photos of a poster that is white above on the left are so."""
    image = a_member()
    texture = scenery.bitmap(to_linear(image))
    np.testing.assert_allclose(scenery.head_on(texture, 32, 32), image, atol=0.05)
    image = np.zeros((32, 32, 3), np.float32)
    image[:16, :16] = 1
    photos, _ = scenery.photograph(TINY, image)
    quarter = photos.numpy().mean(axis=2)[4:20, 4:20]
    assert quarter[:7, :7].mean() > 5 * max(quarter[9:, :7].mean(), quarter[:7, 9:].mean())
