"""`eg.pack`: small files within a budget of decibels, their sections, and damaged ones."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.color import rgb2ycbcr

import eigengs_dr as eg
from _helpers.errors import check_refused
from _helpers.packed import few_groups, small_fit
from _helpers.sets import COUNT, SIZE, few, random_scene

BUDGET = 0.5
"""Decibels that a set may lose by default."""

ALLOWED = 1e-4 * (10 ** (BUDGET / 10) - 1)
"""Mean squared error that rounding may add without an image: that of a set of 40 dB."""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.egs"


def error_of(one, other):
    """Mean squared error of the pictures of two sets, in YCbCr."""
    pictures = [rgb2ycbcr(np.float64(eg.picture_of(g))) / 255 for g in (one, other)]
    return np.mean(np.square(np.subtract(*pictures)))


# --- The budget ---


@pytest.fixture(scope="module")
def receipts(tmp_path_factory):
    """Receipts and files of two budgets."""
    folder, (gaussians, image) = tmp_path_factory.mktemp("packed"), small_fit()
    files = {budget: folder / f"{budget}.egs" for budget in (0.5, 3.0)}
    with few_groups():
        return {
            budget: (eg.pack(gaussians, file, image, budget), file)
            for budget, file in files.items()
        }


@pytest.mark.parametrize("budget", [0.5, 3.0])
def test_the_budget_holds_and_is_used(receipts, budget):
    gaussians, image = small_fit()
    receipt, file = receipts[budget]
    found = eg.Gaussians.load(file)
    before, after = (eg.psnr(eg.picture_of(g), image, "ycbcr") for g in (gaussians, found))
    assert before - after == pytest.approx(receipt.psnr_drop, abs=1e-3)
    assert 0.7 * budget < before - after <= budget + 1e-3
    assert receipt.psnr == pytest.approx(after, abs=1e-3)
    assert receipt.bytes == file.stat().st_size
    assert receipt.bits_per_pixel == 8 * receipt.bytes / 32**2
    np.testing.assert_array_equal(eg.picture_of(found), eg.picture_of(receipt.gaussians))


@few_groups()
def test_files_are_small_and_equal_for_equal_arguments(receipts, path):
    """Also for a caller whose NumPy raises."""
    gaussians, image = small_fit()
    (_, file), (_, smaller) = receipts.values()
    assert smaller.stat().st_size < 0.9 * file.stat().st_size
    with np.errstate(all="raise"):
        eg.pack(gaussians, path, image, 3.0)
    assert path.read_bytes() == smaller.read_bytes()
    saved = path.with_suffix(".npz")
    gaussians.save(saved)
    assert file.stat().st_size < saved.stat().st_size / 4


@few_groups()
def test_without_an_image_the_rendering_is_kept(path):
    gaussians, _ = small_fit()
    receipt = eg.pack(gaussians, path)
    found = eg.Gaussians.load(path)
    error = error_of(found, gaussians)
    assert 0.5 * ALLOWED < error <= 1.001 * ALLOWED
    assert receipt.psnr == pytest.approx(-10 * np.log10(error), abs=1e-2)


@few_groups()
def test_light_is_compared_as_it_is_shown(path):
    image = small_fit()[1] ** 3  # dark
    gaussians = eg.fit(image, 60, iterations=0, space="linear", backend="llvm").gaussians
    found = eg.pack(gaussians, path, image).gaussians
    before, after = (eg.psnr(eg.picture_of(g), image, "data") for g in (gaussians, found))
    assert 0.7 * BUDGET < before - after <= BUDGET + 1e-3


@pytest.mark.parametrize(("space", "channels"), [("ycbcr", 3), ("linear", 3), ("data", 4)])
@few_groups()
def test_all_spaces_and_channels(backend, path, space, channels):
    gaussians = replace(random_scene(3, channels=channels).on(backend, space=space), cutoff=4.5)
    receipt = eg.pack(gaussians, path)
    assert 0 < receipt.psnr_drop <= BUDGET + 1e-3
    found = eg.Gaussians.load(path, backend)
    assert (found.space, found.channels, len(found)) == (space, channels, COUNT)
    assert found.cutoff == receipt.gaussians.cutoff == 4.5


def edge_cases():
    scene = random_scene(7)
    return {
        "one splat": scene.permuted([0]),
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
    assert receipt.psnr_drop <= BUDGET + 1e-3
    assert len(receipt.gaussians) == len(gaussians)
    found = eg.picture_of(eg.Gaussians.load(path))
    error = np.square(found - eg.picture_of(gaussians)).mean()
    assert error <= 1.001 * ALLOWED


def test_a_set_without_error_loses_a_finite_number_of_decibels(path):
    scene = random_scene()
    scene = scene._replace(color=0 * scene.color, background=np.full(3, 0.6))
    exact, image = scene.on("llvm"), np.full((SIZE[1], SIZE[0], 3), 0.6, np.float32)
    assert eg.psnr(eg.picture_of(exact), image) == math.inf
    receipt = eg.pack(exact, path, image)
    assert 0 <= receipt.psnr_drop <= 0.5
    assert receipt.psnr > 89


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


# --- Files ---


@few_groups()
def test_sections_hold_the_splats_in_their_order_and_are_read_alone(path):
    gaussians, image = small_fit()
    eg.pack(gaussians, path, image, sections=[10, 30, 60])
    assert [len(eg.Gaussians.load(path, sections=n)) for n in (1, 2, 3)] == [10, 40, 100]
    first = eg.Gaussians.load(path, sections=1).to_arrays()["mean"]
    before = gaussians.to_arrays()["mean"][:10]
    nearest = np.linalg.norm(first[:, None] - before, axis=2).min(axis=1)
    assert nearest.max() < 3
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert len(eg.Gaussians.load(path, sections=1)) == 10
    for wanted in (0, 4, 3, None):
        with pytest.raises(ValueError, match=r"x\.egs: .*(section|truncated)"):
            eg.Gaussians.load(path, sections=wanted)
    gaussians.save(path.with_suffix(".npz"))
    with pytest.raises(ValueError, match=r"x\.npz: has no sections"):
        eg.Gaussians.load(path.with_suffix(".npz"), sections=1)


def test_files_cut_off_anywhere(receipts, path):
    whole = receipts[3.0][1].read_bytes()
    for length in range(0, len(whole), 7):
        check_refused(path, whole[:length])
    check_refused(path, whole + b"\0", "data follow")
    check_refused(path, b"some text", "not a file of eigengs_dr")


@few
@given(st.data())
def test_files_with_damaged_bytes(receipts, tmp_path_factory, data):
    """The checksums find every change."""
    path, whole = tmp_path_factory.mktemp("any") / "x.egs", receipts[3.0][1].read_bytes()
    for _ in range(40):
        damaged = bytearray(whole)
        damaged[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
        check_refused(path, bytes(damaged))
