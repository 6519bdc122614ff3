"""Levels of detail: prefixes of a set that make the image too."""

import json
from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from click.testing import CliRunner
from scenes import random_scene

import eigengs_dr as eg
from eigengs_dr.cli import main
from eigengs_dr.color import rgb_to_ycbcr
from eigengs_dr.descent import first
from eigengs_dr.growth import worth
from eigengs_dr.levels import fit_levels, level_counts
from eigengs_dr.packing import UNSEEN
from eigengs_dr.presets import PRESETS
from eigengs_dr.rendering import picture_of, render
from eigengs_dr.starting import begin

SIDE = 48


@pytest.fixture(scope="module")
def image():
    return eg.sample("coffee")[100 : 100 + SIDE, 200 : 200 + SIDE]


@pytest.fixture(scope="module")
def result(image):
    return fit_levels(image, 256, levels=3, iterations=150)


def reached(gaussians, image):
    return eg.psnr(picture_of(gaussians), image, space="ycbcr")


@pytest.mark.parametrize(
    ("count", "levels", "expected"),
    [(5000, 4, [78, 312, 1250, 5000]), (7, 1, [7]), (4, 2, [1, 4]), (17, 3, [1, 4, 17])],
)
def test_counts(count, levels, expected):
    assert level_counts(count, levels) == expected


@pytest.mark.parametrize(("count", "levels"), [(3, 2), (5, 0), (63, 4), (9, 10**9)])
def test_too_many_levels_are_refused(count, levels):
    with pytest.raises(ValueError, match=f"levels is {levels}; {count} Gaussians make 1 to"):
        level_counts(count, levels)


def test_first_is_a_slice_and_differentiable(backend):
    gaussians = random_scene().on(backend)
    part = first(gaussians, 7)
    np.testing.assert_array_equal(render(part).numpy(), render(gaussians[:7]).numpy())
    dr.enable_grad(gaussians.color)
    dr.backward(dr.sum(first(gaussians, 7).color, axis=None))
    grad = dr.grad(gaussians.color).numpy()
    assert (grad[:, :7] == 1).all() and (grad[:, 7:] == 0).all()


def test_all_levels_make_the_image(image, result):
    """Beside fits of their own, levels lose little; of a plain fit, as many are no image."""
    plain = eg.fit(image, 256, iterations=150).gaussians
    order = np.argsort(-worth(plain, rgb_to_ycbcr(image)))
    for count in level_counts(256, 3)[:-1]:
        own = reached(eg.fit(image, count, iterations=150).gaussians, image)
        level = reached(result.gaussians[:count], image)
        assert level > own - 3
        assert level > reached(plain[order[:count]], image) + 5
    assert reached(result.gaussians, image) > reached(plain, image) - 3


def test_any_number_between_is_better_than_the_level_before(image, result):
    counts = level_counts(256, 3)
    for low, high in pairwise(counts):
        part = reached(result.gaussians[: (low + high) // 2], image)
        assert reached(result.gaussians[:low], image) < part


def test_a_level_is_sorted_by_worth(image, result):
    target = rgb_to_ycbcr(image)
    before = 0
    for count in level_counts(256, 3):
        value = worth(result.gaussians[:count], target)[before:]
        assert (np.diff(value) <= 1e-4 * value.max()).all()
        before = count


def test_the_picture_is_that_of_the_whole_set(image, result):
    np.testing.assert_array_equal(result.image, picture_of(result.gaussians))
    best = max(row["psnr_ycbcr"] for row in result.trace)
    assert reached(result.gaussians, image) == pytest.approx(best, abs=1e-3)


def test_one_seed_gives_one_result(image):
    a, b = (fit_levels(image, 64, 2, iterations=5) for _ in range(2))
    np.testing.assert_array_equal(a.image, b.image)


def test_one_level_is_a_set_like_any(image):
    assert len(fit_levels(image, 10, 1, iterations=2).gaussians) == 10


@pytest.mark.parametrize("color", ["linear", "rgb", "data"])
def test_other_colours(image, color):
    found = fit_levels(image, 64, 2, iterations=5, color=color)
    assert found.gaussians.space == color
    assert np.isfinite(picture_of(found.gaussians[:16])).all()


def test_packed_levels_are_read_one_by_one(image, result, tmp_path):
    counts = level_counts(256, 3)
    sections = np.diff(counts, prepend=0).tolist()
    receipt = eg.pack(result.gaussians, tmp_path / "a.egs", image, 1.0, sections)
    for k, count in enumerate(counts, 1):
        part = eg.Gaussians.load(tmp_path / "a.egs", sections=k)
        assert len(part) == count
        lost = reached(result.gaussians[:count], image) - reached(part, image)
        assert lost <= 1.0 + 1e-3
    assert receipt.lost == pytest.approx(lost, abs=1e-3)
    assert receipt.lost > 0.3
    plain = eg.pack(result.gaussians, tmp_path / "b.egs", image, 1.0)
    assert plain.bytes < receipt.bytes < 1.5 * plain.bytes


def test_packed_levels_without_an_image_keep_what_they_have_of_the_whole(result, tmp_path):
    counts = level_counts(256, 3)
    eg.pack(result.gaussians, tmp_path / "a.egs", None, 0.5, np.diff(counts, prepend=0).tolist())
    whole = rgb_to_ycbcr(picture_of(result.gaussians))

    def error(part):
        return np.square(rgb_to_ycbcr(picture_of(part)) - whole).mean() + UNSEEN

    for k, count in enumerate(counts, 1):
        part = eg.Gaussians.load(tmp_path / "a.egs", sections=k)
        assert error(part) <= 1.001 * 10**0.05 * error(result.gaussians[:count])


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_commands(image, tmp_path):
    photo, fitted, small = (tmp_path / name for name in ("a.png", "a.npz", "a.egs"))
    eg.save_image(photo, image)
    base = ["fit", photo, "-o", fitted, "--quiet", "--iterations", 10]
    done = run(*base, "--gaussians", 64, "--levels", 2)
    assert done.exit_code == 0, done.stderr
    assert run("pack", fitted, "-o", small, "--levels", 2, "--quiet").exit_code == 0
    told = json.loads(run("info", small, "--json").stdout)
    assert told["sections"] == [16, 48]
    out = tmp_path / "b.png"
    assert run("render", fitted, "-o", out, "--first", 16).exit_code == 0
    refused = run("render", fitted, "-o", out, "--first", 65)
    assert refused.exit_code == 2
    assert "--first is 65; the file has 64 Gaussians" in refused.stderr
    expected = picture_of(eg.Gaussians.load(fitted)[:16]).clip(0, 1)
    assert np.abs(eg.load_image(out) - expected).max() < 0.003

    for extra in (["--target-psnr", 30], ["--init", "grid"], ["--levels", 9]):
        refused = run(*base, "--gaussians", 64, "--levels", 2, *extra)
        assert refused.exit_code == 2
        assert "levels" in refused.stderr and len(refused.stderr.splitlines()) == 1


def test_levels_keep_the_background(image):
    """What is added later does not change the levels before: one background serves all."""
    found = fit_levels(image, 64, 2, iterations=0).gaussians
    alone = begin(image, 16, "auto", "natural", PRESETS["default"]).gaussians
    np.testing.assert_allclose(
        found.to_arrays()["background"], alone.to_arrays()["background"], atol=1e-6
    )


def test_as_many_as_fit_takes_by_default(image):
    small = image[:4, :4]
    assert len(fit_levels(small, levels=2, iterations=0).gaussians) == 16
