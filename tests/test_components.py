"""How few components are enough: for a family, for images held out, for one image."""

import itertools
import json
import warnings

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scenes import family, small_basis, small_model
from scipy.linalg import cho_factor, cho_solve
from test_training import SMALL, random_fields

import eigengs_dr as eg
from eigengs_dr.cli.main import main
from eigengs_dr.eigenbasis import model_file as modelfile
from eigengs_dr.eigenbasis.components.split import SPLIT_COST, split_reason, wants_split
from eigengs_dr.eigenbasis.training import TrainOptions, train
from eigengs_dr.eigenbasis.truncation import (
    curve_from_eigenvalues,
    curve_from_residuals,
    min_ranks_per_channel,
    residual_energy,
)
from eigengs_dr.image.folder import to_planes
from eigengs_dr.storage import npz as archive

SIDE, RANKS = 16, (5, 3, 1)

splits = pytest.mark.parametrize("split", [False, True])


def low_rank(count, noise, seed):
    """RGB images that vary along few directions a channel, the same for every seed, and noise."""
    fixed, drawn = np.random.default_rng(0), np.random.default_rng(seed)
    images = np.full((count, SIDE, SIDE, 3), 0.5)
    for c, rank in enumerate(RANKS):
        rows = np.linalg.qr(fixed.normal(size=(SIDE**2, rank)))[0].T.reshape(rank, SIDE, SIDE)
        images[..., c] += np.tensordot(drawn.normal(0, 0.5, (count, rank)), rows, 1)
    return (images + noise * drawn.normal(size=images.shape)).astype(np.float32)


@pytest.fixture(scope="module")
def others():
    """Images of the family of `small_basis` that it was not made of."""
    return family(6, seed=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    random_fields(folder / "photos", 30)
    return folder, train(folder / "photos", folder / "model.npz", TrainOptions(**SMALL))


# ---------------------------------------------------------------- a family


def test_held_out_images_tell_the_rank():
    """Noise of the training images alone is no reason to keep components of it."""
    basis = eg.Eigenbasis.from_images(
        low_rank(60, 1e-3, seed=1), (SIDE, SIDE), components=20, color="rgb"
    )
    assert [len(c) for c in basis.components] == [20] * 3
    fall = basis.truncation_curve(low_rank(20, 0, seed=2))
    assert fall.rank_for_psnr(50) == RANKS
    assert (
        basis.truncated(fall.rank_for_psnr(50)).truncation_curve(low_rank(20, 0, seed=2)).psnr[-1]
        >= 50
    )
    energy = eg.Eigenbasis.from_images(
        low_rank(60, 1e-4, seed=1), (SIDE, SIDE), energy=0.999, color="rgb"
    )
    assert tuple(map(len, energy.components)) == RANKS


def test_fall_is_what_truncated_bases_reach(others):
    basis = small_basis()
    fall = basis.truncation_curve(others)
    assert fall.counts[-1].tolist() == [12, 6, 6] and len(fall.psnr) == 25
    for n in (0, 1, 7, 24):
        few = basis.truncated(fall.counts[n])
        shown = [few.reconstruct(few.project(image)) for image in others]
        reached = np.mean([eg.psnr(i, s, "ycbcr") for i, s in zip(others, shown, strict=True)])
        assert fall.psnr[n] == pytest.approx(reached, abs=1e-3)


def test_fall_of_the_training_images():
    images = family()
    full = eg.Eigenbasis.from_images(images, (32, 32), 39)
    basis, fall = small_basis(), small_basis().truncation_curve()
    for n in (0, 5, 24):
        few = basis.truncated(fall.counts[n])
        errors = [
            np.square(to_planes(i, "ycbcr") - to_planes(few.reconstruct(few.project(i)), "ycbcr"))
            for i in images
        ]
        assert fall.psnr[n] == pytest.approx(-10 * np.log10(np.mean(errors)), abs=1e-3)
    held = sum(values.sum() for values in basis.eigenvalues) / basis.variance.sum()
    assert fall.explained_variance_ratio()[0] == 0
    assert fall.explained_variance_ratio()[-1] == pytest.approx(held)
    assert full.truncation_curve().explained_variance_ratio()[-1] == pytest.approx(1, abs=1e-5)


spectra = st.lists(st.floats(0, 9), max_size=6).map(lambda v: np.array(sorted(v, reverse=True)))


@given(st.tuples(spectra, spectra, spectra))
@settings(max_examples=50, deadline=None)
def test_components_come_by_falling_eigenvalue(eigenvalues):
    fall = curve_from_eigenvalues(eigenvalues, np.array([v.sum() + 1 for v in eigenvalues]), 10)
    steps = np.diff(fall.counts, axis=0)
    assert (steps.sum(axis=1) == 1).all() and (steps >= 0).all()
    assert fall.counts[-1].tolist() == [len(v) for v in eigenvalues]
    gains = -np.diff(10 ** (-fall.psnr / 10)) * 10
    np.testing.assert_allclose(gains, np.sort(np.concatenate(eigenvalues))[::-1], atol=1e-9)


@given(
    st.tuples(*[hnp.arrays(float, st.integers(0, 4), elements=st.floats(0, 5)) for _ in "abc"]),
    st.floats(1, 30),
)
@settings(max_examples=60, deadline=None)
def test_no_fewer_components_do(gains, target):
    left = [residual_energy(values.sum() + 0.1, values) for values in gains]
    allowed = 7 * 10 ** (-target / 10)
    ways = itertools.product(*[range(len(rows)) for rows in left])
    enough = [w for w in ways if left[0][w[0]] + left[1][w[1]] + left[2][w[2]] <= allowed - 1e-9]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = min_ranks_per_channel(left, 7, target)
    if enough:
        assert sum(found) <= min(map(sum, enough))
        assert sum(rows[k] for rows, k in zip(left, found, strict=True)) <= allowed + 1e-9
    else:
        reached = sum(rows[k] for rows, k in zip(left, found, strict=True))
        assert reached <= allowed + 1e-9 or found == tuple(map(len, gains))


def test_components_that_add_nothing_are_left_out():
    none = np.zeros(1)
    assert min_ranks_per_channel([np.array([2, 1, 1, 0.5]), none, none], 10, 10) == (1, 0, 0)


def test_targets_out_of_reach_are_told(others):
    fall = small_basis().truncation_curve(others)
    with pytest.warns(UserWarning, match=r"90 dB are out of reach: all 12\+6\+6 components have"):
        assert fall.rank_for_psnr(90) == (12, 6, 6)
    for target in (0, -3, np.nan, np.inf):
        with pytest.raises(ValueError, match="target_psnr is"):
            fall.rank_for_psnr(target)
    with pytest.raises(ValueError, match="no images"):
        small_basis().truncation_curve([])


def test_no_components_at_all():
    fall = curve_from_residuals([np.zeros(0)] * 3, [np.array([2.0])] * 3, 6)
    assert fall.counts.tolist() == [[0, 0, 0]] and fall.psnr.tolist() == [0]
    assert eg.Eigenbasis.from_images(family(1), (32, 32), 0).truncation_curve().psnr.tolist() == [
        120
    ]


# ---------------------------------------------------------------- one image


def shown(model, coefficients):
    return eg.render(model.reconstruct(coefficients)).numpy()


@splits
@pytest.mark.parametrize("target", [21, 23])
def test_encode_meets_a_bound_with_the_fewest(backend, others, split, target):
    model = small_model(backend, split)
    for image in others:
        found = model.project(image, target)
        assert eg.psnr(image, shown(model, found), "ycbcr") >= target - 1e-3
        counts = [len(w) for w in found]
        assert sum(counts) < sum(model.components)
        for c in np.flatnonzero(counts):
            fewer = [k - (i == c) for i, k in enumerate(counts)]
            best = truncated(model, fewer).project(image)
            assert eg.psnr(image, shown(model, best), "ycbcr") < target + 1e-3
        np.testing.assert_allclose(
            np.concatenate(found),
            np.concatenate(truncated(model, counts).project(image)),
            atol=1e-4,
        )


def truncated(model, counts):
    weights = tuple(w[:k] for w, k in zip(model.weights, counts, strict=True))
    values = tuple(v[:k] for v, k in zip(model.eigenvalues, counts, strict=True))
    return eg.EigenGS(model.gaussians, weights, values, model.mean_image, model.low)


def test_an_image_of_a_subspace_needs_no_more(backend):
    model = small_model(backend)
    only = (np.array([0.0, 0.9], np.float32), np.zeros(0), np.array([0.5], np.float32))
    image = shown(model, only)
    found = model.project(image, 55)
    assert [len(w) for w in found] == [2, 0, 1]
    np.testing.assert_allclose(np.concatenate(found), np.concatenate(only), atol=2e-3)
    assert [len(w) for w in model.project(shown(model, (only[1],) * 3), 55)] == [0, 0, 0]


@splits
@pytest.mark.parametrize("mean", ["gaussians", "dense"])
def test_encode_is_as_before_without_a_target(backend, others, split, mean):
    """The same bits as least squares on all components, written out."""
    model = small_model(backend, split)
    planes = to_planes(others[0], "ycbcr").reshape(3, 32, 32)
    if mean == "dense":
        planes = planes - model.mean_image
    seen = model.equations.correlate(planes)
    arrays = model.gaussians.to_arrays()
    start = np.vstack([arrays["color"], arrays["background"]]).astype(np.float64)
    if mean == "gaussians":
        seen = seen - model.equations.product(start)
    columns = []
    for c, weights in enumerate(model.weights):
        rows = weights.astype(np.float64)
        gram = rows @ model.equations.product(rows.T)
        gram += np.eye(len(gram)) * (1e-9 * np.trace(gram) / len(gram) + 1e-30)
        right = np.einsum("jn,n->j", weights, seen[:, c].astype(np.float32))
        a = cho_solve(cho_factor(gram, lower=True), right).astype(np.float32)
        columns.append(np.einsum("j,jn->n", a, weights))
    curve_from_eigenvalues = np.stack(columns, axis=1).astype(np.float64)
    if mean == "gaussians":
        curve_from_eigenvalues = start + curve_from_eigenvalues
    found = model.encode(others[0], "projected", mean).to_arrays()
    np.testing.assert_array_equal(found["color"], curve_from_eigenvalues[:-1].astype(np.float32))
    np.testing.assert_array_equal(
        found["background"], curve_from_eigenvalues[-1].astype(np.float32)
    )


def test_encode_with_a_dense_mean(backend, others):
    model, image = small_model(backend), others[0]
    left = eg.render(model.encode(image, "projected", "dense", target_psnr=24)).numpy()
    nothing = eg.render(model.encode(0 * image, "projected", "dense", target_psnr=1)).numpy()
    assert left.shape == nothing.shape
    planes = to_planes(left, "ycbcr").reshape(3, 32, 32) + model.mean_image
    error = planes - to_planes(image, "ycbcr").reshape(3, 32, 32)
    assert -10 * np.log10(np.square(error).mean()) >= 24 - 1e-3


def test_wrong_or_unmet_targets(backend, others):
    model = small_model(backend)
    with pytest.raises(ValueError, match="colors 'projected'"):
        model.encode(others[0], target_psnr=24)
    for target in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="target_psnr is"):
            model.project(others[0], target)
    with pytest.warns(UserWarning, match=r"out of reach: all 12\+6\+6 components have 2\d\."):
        found = model.project(others[0], 60)
    np.testing.assert_allclose(
        np.concatenate(found), np.concatenate(model.project(others[0])), atol=1e-5
    )


# ---------------------------------------------------------------- the split


def test_the_split_tells_why(backend, monkeypatch):
    basis = small_basis()

    def reason(count, asked):
        decision, figures = wants_split(basis, count, asked, backend)
        text = split_reason(basis, count, asked, figures)
        assert len(text) < 64 and text.isascii()
        return decision, text

    assert reason(100, True) == (True, "as asked")
    assert reason(100, False) == (False, "as asked")
    assert reason(1, True) == (False, "too few Gaussians or components to split")
    assert reason(100, "auto") == (False, "32 pixels a side; auto measures from 512 on")
    monkeypatch.setattr("eigengs_dr.eigenbasis.components.split.SPLIT_FROM", 32)
    decision, text = reason(100, "auto")
    whole, split = (float(text.split(word)[1].split(" dB")[0]) for word in ("whole ", "split "))
    assert decision == (split > whole - SPLIT_COST)
    assert text.endswith("may cost 0.2")
    model = eg.EigenGS.fit(basis, 100, backend=backend)
    assert (model.low > 0, model.split_reason) == (decision, text)


# ---------------------------------------------------------------- files


def members(model):
    return modelfile.to_members(model)


def test_models_keep_how_the_error_falls(trained):
    folder, result = trained
    loaded = eg.EigenGS.load(folder / "model.npz")
    np.testing.assert_array_equal(
        loaded.truncation_curve().psnr, result.basis.truncation_curve().psnr
    )
    np.testing.assert_array_equal(loaded.held_out, result.model.held_out)
    assert loaded.split_reason == "32 pixels a side; auto measures from 512 on"
    assert len(loaded.held_out) == 19
    assert loaded.held_out[-1] == pytest.approx(result.figures["psnr_pca"], abs=1e-3)


def test_files_of_version_1_are_read(trained, tmp_path):
    _, result = trained
    old = {key: members(result.model)[key] for key in modelfile.LAYOUT_V1}
    archive.write(tmp_path / "old.npz", modelfile.FORMAT, 1, old)
    loaded = eg.EigenGS.load(tmp_path / "old.npz")
    assert (
        loaded.truncation_curve() is None
        and len(loaded.held_out) == 0
        and loaded.split_reason == ""
    )
    for one, two in zip(
        loaded.weights, eg.EigenGS.load(saved(result, tmp_path)).weights, strict=True
    ):
        np.testing.assert_array_equal(one, two)
    loaded.save(tmp_path / "again.npz")
    assert eg.EigenGS.load(tmp_path / "again.npz").truncation_curve() is None
    told = said("info", tmp_path / "old.npz")
    assert "variance" not in told and "split_reason" not in told
    archive.write(tmp_path / "cut.npz", modelfile.FORMAT, 2, old)
    with pytest.raises(ValueError, match="key 'variance' is missing"):
        eg.EigenGS.load(tmp_path / "cut.npz")


def saved(result, folder):
    result.model.save(folder / "new.npz")
    return folder / "new.npz"


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("variance", lambda a: a[:2], "variance has shape"),
        ("variance", lambda a: 0 * a, "more than variance 0"),
        ("variance", lambda a: -a, "more than variance 0"),
        ("held_out", lambda a: a[:-1], "held_out has shape"),
        ("held_out", lambda a: a[::-1], "held_out must ascend"),
        ("held_out", lambda a: a + 1e6, "held_out must ascend"),
        ("held_out", lambda a: a - 1e6, "held_out must ascend"),
        ("split_reason", lambda a: np.array("\x1b[2J"), "not printed"),
        ("split_reason", lambda a: np.array("a\nb"), "not printed"),
        ("split_reason", lambda a: np.array("x" * 100), "over 64 characters"),
    ],
)
def test_hostile_values(trained, tmp_path, key, change, words):
    known = members(trained[1].model)
    path = tmp_path / "bad.npz"
    archive.write(path, modelfile.FORMAT, 2, {**known, key: change(known[key])})
    with pytest.raises(ValueError, match=words) as caught:
        eg.EigenGS.load(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


# ---------------------------------------------------------------- training, and what is told


def said(*arguments):
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_train_to_a_target(trained, tmp_path):
    folder, full = trained
    target = float(full.model.held_out[8]) - 1e-6
    result = train(folder / "photos", tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=target))
    counts = result.basis.truncation_curve().counts[-1]
    assert counts.tolist() == full.basis.truncation_curve().counts[8].tolist()
    np.testing.assert_allclose(result.model.held_out, full.model.held_out[:9], atol=1e-6)
    assert result.figures["psnr_pca"] == pytest.approx(target, abs=1e-3)
    assert result.figures["components"] == counts.tolist()


def test_train_without_images_for_a_target(tmp_path):
    photos = random_fields(tmp_path / "few", 5)
    with pytest.raises(ValueError, match="images that are held out"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        train(photos, tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=20))
    assert [path.name for path in tmp_path.iterdir()] == ["few"]
    with pytest.raises(ValueError, match="give one of them"):
        train(photos, tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=20, energy=0.9))
    with pytest.raises(ValueError, match="target_psnr is nan"):
        train(tmp_path / "gone", tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=np.nan))


def test_commands(trained, tmp_path):
    folder, full = trained
    report, model = tmp_path / "r.json", tmp_path / "m.npz"
    small = ["--size", "32x32", "--components", 6, "--gaussians", 60, "--target-psnr", 21]
    text = said("train", folder / "photos", "-o", model, "--report", report, *small)
    assert "not split (32 pixels a side; auto measures from 512 on)" in text
    figures = json.loads(report.read_text())
    assert (figures["target_psnr"], figures["split_reason"][:2]) == (21, "32")
    assert figures["psnr_held_out"][-1] >= 21 > figures["psnr_held_out"][-2]
    rows = json.loads(said("info", model, "--json"))["fall"]
    assert rows[0]["components"] == [0, 0, 0] and rows[0]["variance"] == 0
    assert rows[-1]["components"] == figures["components"]
    assert rows[-1]["psnr_held_out"] == pytest.approx(figures["psnr_held_out"][-1], abs=1e-3)
    table = said("info", folder / "model.npz").splitlines()[-7:]
    assert table[0].split() == ["components", "variance", "training", "held", "out"]
    assert [int(line.split()[0]) for line in table[1:]] == [0, 1, 2, 5, 10, 18]
    assert f"{full.model.held_out[-1]:.2f} dB" in table[-1]
    assert len({len(line) for line in table}) == 1
