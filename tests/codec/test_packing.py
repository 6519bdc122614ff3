"""Packing: the steps that a budget allows."""

import math
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.packed import SPACES, few_groups, small_fit
from _helpers.sets import COUNT, SIZE, random_scene
from eigengs_dr.codec import egs as packed
from eigengs_dr.codec import packing, rounding
from eigengs_dr.codec.rounding import Attempt, largest_within
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import picture_of

ALLOWED = packing.MSE_WITHOUT_IMAGE * (10 ** (packing.BUDGET / 10) - 1)
"""Mean squared error that rounding may add to a set without an image."""


@pytest.fixture(scope="module")
def receipts(tmp_path_factory):
    """Receipts and files of two budgets."""
    folder = tmp_path_factory.mktemp("packed")
    files = {budget: folder / f"{budget}.egs" for budget in (0.5, 3.0)}
    gaussians, image = small_fit()
    receipts = {0.5: eg.pack(gaussians, files[0.5], image)}
    with few_groups():
        receipts[3.0] = eg.pack(gaussians, files[3.0], image, 3.0)
    return {budget: (receipt, files[budget]) for budget, receipt in receipts.items()}


@pytest.mark.parametrize("budget", [0.5, 3.0])
def test_the_budget_holds_and_is_used(receipts, budget):
    gaussians, image = small_fit()
    receipt, file = receipts[budget]
    found = eg.Gaussians.load(file)
    before, after = (eg.psnr(picture_of(g), image, "ycbcr") for g in (gaussians, found))
    assert before - after == pytest.approx(receipt.psnr_drop, abs=1e-3)
    assert 0.7 * budget < before - after <= budget + 1e-3
    assert receipt.psnr == pytest.approx(after, abs=1e-3)
    assert packed.read_egs(file).psnr == np.float32(receipt.psnr)
    assert receipt.bytes == file.stat().st_size
    assert receipt.bits_per_pixel == 8 * receipt.bytes / 32**2
    np.testing.assert_array_equal(picture_of(found), picture_of(receipt.gaussians))


@few_groups()
def test_files_are_small_and_equal_for_equal_arguments(receipts, path):
    gaussians, image = small_fit()
    (_, file), (_, smaller) = receipts.values()
    assert smaller.stat().st_size < 0.9 * file.stat().st_size
    eg.pack(gaussians, path, image, 3.0)
    assert path.read_bytes() == smaller.read_bytes()
    saved = path.with_suffix(".npz")
    gaussians.save(saved)
    assert file.stat().st_size < saved.stat().st_size / 4


def test_a_caller_whose_numpy_raises(path):
    flat = eg.fit(np.full((32, 32, 3), 0.5, np.float32), 10, iterations=0)
    eg.pack(flat, path)
    before = path.read_bytes()
    with np.errstate(all="raise"):
        eg.pack(flat, path)
    assert path.read_bytes() == before


@few_groups()
def test_without_an_image_the_rendering_is_kept(path):
    gaussians, _ = small_fit()
    receipt = eg.pack(gaussians, path)
    pictures = [picture_of(g) for g in (eg.Gaussians.load(path), gaussians)]
    error = np.mean(np.square(np.subtract(*map(rgb_to_ycbcr, pictures))))
    assert 0.5 * ALLOWED < error <= 1.001 * ALLOWED
    assert receipt.psnr == pytest.approx(-10 * np.log10(error), abs=1e-2)
    assert math.isnan(packed.read_egs(path).psnr)


@few_groups()
def test_light_is_compared_as_it_is_shown(path):
    image = small_fit()[1] ** 3  # dark
    gaussians = eg.fit(image, 60, iterations=40, space="linear", backend="llvm").gaussians
    found = eg.pack(gaussians, path, image).gaussians
    before, after = (eg.psnr(picture_of(g), image, "data") for g in (gaussians, found))
    assert 0.7 * packing.BUDGET < before - after <= packing.BUDGET + 1e-3


def test_sections_hold_the_splats_in_their_order(path):
    gaussians, image = small_fit()
    eg.pack(gaussians, path, image, sections=[10, 30, 60])
    assert packed.section_counts(path) == [10, 30, 60]
    first = eg.Gaussians.load(path, sections=1).to_arrays()["mean"]
    before = gaussians.to_arrays()["mean"][:10]
    nearest = np.linalg.norm(first[:, None] - before, axis=2).min(axis=1)
    assert nearest.max() < 3


@pytest.mark.parametrize(("space", "channels"), SPACES)
@few_groups()
def test_all_spaces_and_channels(backend, path, space, channels):
    gaussians = random_scene(3, channels=channels).on(backend, space=space)
    receipt = eg.pack(gaussians, path)
    assert 0 < receipt.psnr_drop <= packing.BUDGET + 1e-3
    found = eg.Gaussians.load(path, backend)
    assert (found.space, found.channels, len(found)) == (space, channels, COUNT)


def edge_cases():
    scene = random_scene(7)
    return {
        "one splat": scene.permuted([0]),
        "two splats": scene.permuted([0, 1]),
        "equal splats": scene.permuted([0] * COUNT),
        "at the corners": scene._replace(
            mean=np.array([[0, 0], [SIZE[0], 0], [0, SIZE[1]], SIZE] * (COUNT // 4), float)
        ),
        "outside": scene._replace(mean=scene.mean * 5 - 30),
        "black": scene._replace(color=0 * scene.color),
        "needles": scene._replace(factor=np.array([[0.001, 0.0, 4.0]] * COUNT)),
        "an image of one pixel": scene._replace(size=(1, 1)),
    }


@pytest.mark.parametrize("name", edge_cases())
@few_groups()
def test_edge_cases(backend, path, name):
    gaussians = edge_cases()[name].on(backend)
    receipt = eg.pack(gaussians, path)
    error = np.square(picture_of(eg.Gaussians.load(path)) - picture_of(gaussians)).mean()
    assert error <= 1.001 * ALLOWED
    assert receipt.psnr_drop <= packing.BUDGET + 1e-3
    assert len(receipt.gaussians) == len(gaussians)


@few_groups()
def test_mistakes_leave_the_old_file(path):
    gaussians, image = small_fit()
    path.write_text("old")
    for words, arguments in {
        "max_psnr_drop is 0": (None, 0),
        "no rounding is fine enough": (None, 1e-16),
        "max_psnr_drop is 10000.*at most 100 dB": (None, 1e4),
        "max_psnr_drop is nan": (None, math.nan),
        r"shape \(16, 32, 3\)": (image[:16],),
        "sections are": (None, 0.5, [50, 49]),
        "sections are ": (None, 0.5, [0, 100]),
    }.items():
        with pytest.raises(ValueError, match=words):
            eg.pack(gaussians, path, *arguments)
    far = replace(gaussians, mean=gaussians.mean + 1e9)
    with pytest.raises(ValueError, match=r"bounded\(\)"):
        eg.pack(far, path)
    assert path.read_text() == "old"
    # `pack` writes no .npz file, and `save` no .egs file.
    for call, name in ((eg.pack, path.with_suffix(".npz")), (eg.Gaussians.save, path)):
        with pytest.raises(ValueError, match=str(name)):
            call(gaussians, name)
    assert not path.with_suffix(".npz").exists()


def test_a_set_without_error_loses_a_finite_number_of_decibels(path):
    image = np.full((16, 16, 3), 0.5, np.float32)
    exact = eg.fit(image, 4, iterations=0, space="rgb", backend="llvm").gaussians
    assert eg.psnr(eg.picture_of(exact), image) == math.inf
    receipt = eg.pack(exact, path, image)
    assert 0 <= receipt.psnr_drop <= 0.5
    assert receipt.psnr > 89


# --- The search of the largest step --------------------------------------------------------------


def noisy_attempts(crossing, noise, seed):
    """An attempt whose error crosses the limit somewhere, and what was tried."""
    tried = {}

    def attempt(octaves):
        luck = np.random.default_rng((seed, len(tried))).normal()
        tried[octaves] = 4 ** (octaves - crossing) * math.exp(noise * luck)
        return Attempt(tried[octaves], None, 0.0)

    return attempt, tried


@pytest.mark.parametrize("crossing", [-7.3, -0.5, 0.0, 1.3, 3.99])
def test_without_noise_it_ends_at_the_limit(crossing):
    attempt, tried = noisy_attempts(crossing, 0, 0)
    octaves, best = largest_within(attempt)
    assert crossing - 0.2 < octaves <= crossing + 1e-9
    assert best.excess == tried[octaves] >= rounding.ACCEPTED_SHARE
    assert len(tried) <= 7 + abs(crossing)


@pytest.mark.parametrize(("noise", "least"), [(0.02, 0.95), (0.15, 0.85), (0.5, 0.7)])
def test_with_noise_it_never_exceeds_the_limit(noise, least):
    used = []
    for seed in range(60):
        attempt, tried = noisy_attempts(0.4 * math.sin(seed), noise, seed)
        octaves, best = largest_within(attempt)
        assert best.excess == tried[octaves] <= 1
        assert octaves == max(k for k, excess in tried.items() if excess <= 1)
        assert len(tried) <= rounding.MAX_ATTEMPTS + 4
        used.append(best.excess)
    assert np.mean(used) > least


def test_an_error_that_no_step_changes():
    assert largest_within(lambda octaves: Attempt(1.5, None, 0.0)) is None
    octaves, _ = largest_within(lambda octaves: Attempt(0.0, None, 0.0))
    assert octaves == rounding.MAX_OCTAVES
