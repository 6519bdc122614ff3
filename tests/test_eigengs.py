"""EigenGS: shared Gaussians of a family, images encoded at once."""

from contextlib import nullcontext

import numpy as np
import pytest
from scenes import family, small_basis, small_model
from train_natural import DEMO, crops

import eigengs_dr as eg
from eigengs_dr.eigenbasis.components.shape_training import ROUND, samples, train_shapes
from eigengs_dr.eigenbasis.components.solve import fit_components, psnr_components
from eigengs_dr.eigenbasis.components.split import wants_split
from eigengs_dr.eigenbasis.registry import load_basis
from eigengs_dr.fitting.solvers.conjugate_gradient import solve
from eigengs_dr.fitting.solvers.normal_equations import NormalEquations
from eigengs_dr.image.folder import to_planes
from eigengs_dr.image.io import ImageError
from eigengs_dr.image.resize import resample

SIDE, SPLATS = 32, 100

splits = pytest.mark.parametrize("split", [False, True])


@pytest.fixture(scope="module")
def others():
    """Images of the family that were not trained on."""
    return family(8, seed=1)


def fidelity(pictures, images):
    return np.mean([eg.psnr(p, i, "ycbcr") for p, i in zip(pictures, images, strict=True)])


def rendered(model, images, *options):
    return [eg.render(model.encode(image, *options)).numpy() for image in images]


# --- Fit ---------------------------------------------------------------------------------------


@splits
def test_components_are_rendered(backend, split):
    """Every component is what its weights make of the splats, the mean image too."""
    model, basis = small_model(backend, split), small_basis()
    assert model.components == (12, 6, 6)
    assert len(model.gaussians) == SPLATS
    mean = eg.render(model.gaussians).numpy()
    expected = basis.reconstruct([np.zeros(k) for k in model.components])
    assert eg.psnr(mean, expected, "ycbcr") > 50
    # A tenth of 100 splats is few for the first components.
    assert model.figures["psnr_components"] > (30 if split else 40)
    none = [np.zeros(k, np.float32) for k in model.components]
    for channel, j in ((0, 0), (0, 11), (2, 3)):
        only = [w.copy() for w in none]
        only[channel][j] = 1
        shown = eg.render(model.reconstruct(tuple(only))).numpy() - mean
        wanted = basis.reconstruct(only) - basis.reconstruct(none)
        share = 0.2 if split and j < model.low_components else 0.03
        assert np.square(shown - wanted).sum() < share * np.square(wanted).sum()


def test_weights_are_the_best(backend):
    """No change of the weights lowers the error: it is orthogonal to all splats."""
    model, basis = small_model(backend), small_basis()
    equations = NormalEquations(model.gaussians)
    for weights, planes in zip(model.weights, basis.components, strict=True):
        correlations = equations.correlate(planes)
        gradient = equations.product(weights.T.astype(float)) - correlations
        assert np.abs(gradient).max() < 2e-3 * np.abs(correlations).max()


def test_psnr_components_is_the_weighted_error(backend):
    model, basis = small_model(backend), small_basis()
    error = 0.0
    for c, values in enumerate(basis.eigenvalues):
        weights = model.weights[c]
        shapes = model.gaussians.to_arrays()
        for j, value in enumerate(values):
            only = eg.Gaussians.from_arrays(
                shapes["mean"],
                shapes["factor"],
                weights[j, :-1, None],
                weights[j, -1:],
                size=(SIDE, SIDE),
                space="data",
                backend=backend,
            )
            plane = eg.render(only).numpy()[..., 0]
            error += value * np.square(plane - basis.components[c][j]).sum()
    found = psnr_components(NormalEquations(model.gaussians), basis, model.weights)
    assert found == pytest.approx(-10 * np.log10(error / basis.mean.size), abs=0.05)


@splits
def test_split_keeps_sides_apart(backend, split):
    model = small_model(backend, split)
    low, first = model.low, model.low_components
    assert (low, first) == ((10, 6) if split else (0, 0))
    for weights in model.weights:
        assert not weights[:first, low:-1].any() or not split
        assert not weights[first:, :low].any()
        assert np.abs(weights).max(axis=1).min() > 0
    areas = 1 / np.prod(model.gaussians.to_arrays()["factor"][:, [0, 2]], axis=1)
    if split:
        assert areas[:low].min() > 5 * areas[low:].max()


def test_auto_splits_large_images_alone(backend, monkeypatch):
    assert wants_split(small_basis(), SPLATS, "auto", backend) == (False, {})
    monkeypatch.setattr("eigengs_dr.eigenbasis.components.split.SPLIT_FROM", SIDE)
    decision, figures = wants_split(small_basis(), SPLATS, "auto", backend)
    assert set(figures) == {"psnr_whole", "psnr_split"}
    assert decision == (figures["psnr_split"] > figures["psnr_whole"] - 0.2)
    examples = small_basis().examples
    whole = rendered(small_model(backend), examples)
    planes = to_planes(np.concatenate(whole), "ycbcr") - to_planes(
        np.concatenate(examples), "ycbcr"
    )
    assert figures["psnr_whole"] == pytest.approx(
        -10 * np.log10(np.square(planes).mean()), abs=0.02
    )


def test_one_seed_one_model(backend):
    again = eg.EigenGS.fit(small_basis(), SPLATS, frequency_aware=False, backend=backend)
    for one, two in zip(again.weights, small_model(backend).weights, strict=True):
        np.testing.assert_array_equal(one, two)


def test_paper_preset(backend):
    """Joint training fits the components better with every round; the mean comes solved."""
    few, more = (
        eg.EigenGS.fit(small_basis(), SPLATS, preset="eigengs", steps=steps, backend=backend)
        for steps in (20, 300)
    )
    assert more.figures["psnr_components"] > few.figures["psnr_components"] + 1
    mean = eg.render(more.gaussians).numpy()
    nothing = small_basis().reconstruct([np.zeros(k) for k in more.components])
    assert eg.psnr(mean, nothing, "ycbcr") > 35
    split = eg.EigenGS.fit(small_basis(), SPLATS, True, preset="eigengs", steps=20, backend=backend)
    assert split.low == 10
    assert not split.weights[0][6:, :10].any()


def test_a_tenth_of_the_splats_is_low(backend):
    assert eg.EigenGS.fit(small_basis(), 17, True, backend=backend).low == 2
    assert eg.EigenGS.fit(small_basis(), 1, True, backend=backend).low == 0


@pytest.mark.parametrize(("split", "expected"), [(30.0, True), (29.9, True), (29.7, False)])
def test_what_the_split_may_cost(backend, monkeypatch, split, expected):
    figures = iter([30.0, split])
    monkeypatch.setattr("eigengs_dr.eigenbasis.components.split.SPLIT_FROM", SIDE)
    monkeypatch.setattr(
        "eigengs_dr.eigenbasis.components.split.psnr_from_mse", lambda mse: next(figures)
    )
    assert wants_split(small_basis(), SPLATS, "auto", backend)[0] == expected


def test_sides_start_apart(backend):
    """Each side of the paper's training draws a start of its own."""
    seen = []
    fit_components(
        small_basis(), 20, True, "eigengs", 1, 0, backend, save=lambda s: seen.append(s[-1])
    )
    assert not np.array_equal(seen[0]["rows"][0, :5, :2], seen[1]["rows"][0, :5, :2])


def test_oblong_family(backend):
    """Width and height are not exchanged anywhere."""
    images = family(20, 48)[:, 10:30]
    basis = eg.Eigenbasis.from_images(images, (48, 20), 8)
    for split in (False, True):
        model = eg.EigenGS.fit(basis, SPLATS, split, backend=backend)
        pca = fidelity([basis.reconstruct(basis.project(image)) for image in images], images)
        allowed = 3 if split else 0.5  # 10 splats for 4 components a channel
        assert fidelity(rendered(model, images, "projected"), images) > pca - allowed
        assert fidelity(rendered(model, images), images) > 32
        assert model.dense_mean(7, 9).shape == (9, 7, 3)


# --- Training of shapes ------------------------------------------------------------------------


def test_samples_are_those_of_the_pca_model():
    """Covariance ``sum_j lambda_j Psi_j Psi_j^T``: coefficients of variance lambda_j."""
    basis = small_basis()
    drawn = samples(basis.components, basis.eigenvalues, 0, 0, 1000)
    assert drawn.shape == (1000, SIDE, SIDE, 3)
    for c, (planes, values) in enumerate(zip(basis.components, basis.eigenvalues, strict=True)):
        found = np.tensordot(drawn[..., c], planes, ((1, 2), (1, 2)))
        np.testing.assert_allclose(found.var(axis=0), values, rtol=0.25)
        np.testing.assert_allclose(found.mean(axis=0), 0, atol=0.15 * np.sqrt(values.max()))
    first = np.tensordot(drawn[..., 0], basis.components[0][0])
    for c in (1, 2):  # channels are independent
        other = np.tensordot(drawn[..., c], basis.components[c][0])
        assert abs(np.corrcoef(first, other)[0, 1]) < 0.15
    np.testing.assert_array_equal(samples(basis.components, basis.eigenvalues, 0, 7, 9), drawn[7:9])


def test_training_shapes_pays(backend):
    seen = []
    model = eg.EigenGS.fit(
        small_basis(),
        SPLATS,
        steps=4 * ROUND,
        backend=backend,
        progress=lambda done, total, row: seen.append((done, total)),
    )
    assert model.figures["psnr_components"] > model.figures["psnr_untrained"] + 0.3
    assert seen == [(ROUND * i, 4 * ROUND) for i in range(5)]


def test_training_goes_on(backend):
    """From a round on as if it had not stopped."""
    basis = small_basis()
    arguments = (basis.components, basis.eigenvalues, SPLATS, 0, 2 * ROUND + 5, backend)
    whole = list(train_shapes(*arguments))
    assert [int(state["step"]) for state in whole] == [0, ROUND, 2 * ROUND, 2 * ROUND + 5]
    rest = list(train_shapes(*arguments, state=whole[1]))
    assert len(rest) == 2
    for key in ("mean", "factor"):
        np.testing.assert_array_equal(rest[-1][key], whole[-1][key])


# --- Encode ------------------------------------------------------------------------------------


@splits
def test_projection_is_that_of_pca(backend, split, others):
    model, basis = small_model(backend, split), small_basis()
    pca = fidelity([basis.reconstruct(basis.project(image)) for image in others], others)
    assert fidelity(rendered(model, others, "projected"), others) > pca - 0.1
    if split:  # few large splats render the first components with an error that others see
        return
    for found, expected in zip(model.project(others[0]), basis.project(others[0]), strict=True):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found[:3], expected[:3], atol=0.1 * scale)


@splits
def test_projection_is_idempotent(backend, split, others):
    """An image of the span is its own projection, and `reconstruct` undoes `project`."""
    model = small_model(backend, split)
    coefficients = model.project(others[0])
    shown = eg.render(model.reconstruct(coefficients)).numpy()
    for again, first in zip(model.project(shown.clip(-0.5, 1.5)), coefficients, strict=True):
        np.testing.assert_allclose(again, first, atol=2e-3 * np.abs(first).max())


def test_projection_is_the_closest_point(backend, others):
    model = small_model(backend)
    best = model.project(others[0])

    def distance(coefficients):
        shown = to_planes(eg.render(model.reconstruct(coefficients)).numpy(), "ycbcr")
        return np.square(shown - to_planes(others[0], "ycbcr")).sum()

    least = distance(best)
    for channel, j in ((0, 0), (0, 7), (1, 2), (2, 5)):
        for step in (-0.05, 0.05):
            moved = [w.copy() for w in best]
            moved[channel][j] += step
            assert distance(moved) > least


@splits
def test_exact_colours_are_those_of_conjugate_gradients(backend, split, others):
    model = small_model(backend, split)
    encoded = model.encode(others[0])
    target = np.moveaxis(to_planes(others[0], "ycbcr").reshape(3, SIDE, SIDE), 0, 2)
    iterated = solve(encoded, target, 100).gaussians
    exact, slow = (eg.psnr(eg.render(g), others[0], "ycbcr") for g in (encoded, iterated))
    # With the split, small splats fit what large ones leave: on so smooth an image, that costs.
    assert slow - (3 if split else 0.02) < exact < slow + 0.1
    assert fidelity(rendered(model, others), others) > fidelity(
        rendered(model, others, "projected"), others
    )


@pytest.mark.parametrize("colors", ["exact", "projected"])
def test_dense_mean(backend, colors, others):
    """The paper's form: Gaussians plus the mean image as pixels."""
    model = small_model(backend)
    planes = [
        to_planes(eg.render(model.encode(others[0], colors, mean)).numpy(), "ycbcr")
        for mean in ("gaussians", "dense")
    ]
    dense = model.dense_mean(SIDE, SIDE).reshape(-1, 3).T
    np.testing.assert_allclose(planes[0], planes[1] + dense, atol=0.02)


def test_fewer_components(backend, others):
    model = small_model(backend)
    coefficients = model.project(others[0])
    errors = [
        eg.psnr(eg.render(model.reconstruct([w[:m] for w in coefficients])), others[0], "ycbcr")
        for m in (0, 2, 6, 12)
    ]
    assert errors == sorted(errors)


@pytest.mark.parametrize("size", [(32, 32), (64, 64), (48, 20), (17, 90)])
def test_any_size_and_aspect(backend, size, others):
    """The splats are those of the image at the model's own size, scaled."""
    model = small_model(backend)
    image = resample(others[0], *size).clip(0, 1)
    encoded = model.encode(image)
    assert (encoded.width, encoded.height) == size
    assert eg.render(encoded).shape == (size[1], size[0], 3)
    small = model.encode(resample(image, SIDE, SIDE))
    np.testing.assert_allclose(encoded.to_arrays()["color"], small.to_arrays()["color"], atol=1e-3)
    assert eg.psnr(eg.render(encoded), image, "ycbcr") > 25


def test_grey_and_bytes(backend):
    model = small_model(backend)
    grey = (family(1)[0][..., 1] * 255).astype(np.uint8)
    same = np.repeat(grey[..., None], 3, axis=2)
    one, two = (eg.render(model.encode(image)).numpy() for image in (grey, same))
    np.testing.assert_array_equal(one, two)


def test_wrong_arguments(backend):
    model = small_model(backend)
    with pytest.raises(ValueError, match="coefficients have shapes"):
        model.reconstruct(model.project(family(1)[0])[:2])
    with pytest.raises(ValueError, match="coefficients have shapes"):
        model.reconstruct([np.zeros(13)] * 3)
    with pytest.raises(ValueError, match="colors 'best' is unknown; use one of exact, projected"):
        model.encode(family(1)[0], "best")
    with pytest.raises(ValueError, match="mean 'none' is unknown"):
        model.encode(family(1)[0], mean="none")
    with pytest.raises(ImageError):
        model.encode(np.zeros((4, 4, 5)))


# --- Odd families ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["one", "identical", "grey", "two"])
@splits
def test_few_or_equal_images(backend, kind, split):
    images = {
        "one": family(1),
        "identical": np.repeat(family(1), 5, axis=0),
        "grey": np.repeat(family(10)[..., :1], 3, axis=3),
        "two": family(2),
    }[kind]
    with (
        pytest.warns(UserWarning, match="components a channel") if kind != "grey" else nullcontext()
    ):
        basis = eg.Eigenbasis.from_images(images, (SIDE, SIDE), 5 if kind == "grey" else 20)
    model = eg.EigenGS.fit(basis, SPLATS, split, backend=backend)
    for options in (("projected",), ("exact",), ("projected", "dense")):
        picture = eg.render(model.encode(images[0], *options)).numpy()
        assert np.isfinite(picture).all()
    assert fidelity(rendered(model, images[:1], "projected"), images[:1]) > 28


def test_rgb(backend, others):
    model = small_model(backend, color="rgb")
    assert model.gaussians.space == "rgb"
    basis = small_basis("rgb")
    pca = fidelity([basis.reconstruct(basis.project(image)) for image in others], others)
    assert fidelity(rendered(model, others, "projected"), others) > pca - 0.1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gaussians": 0}, "gaussians is 0; a basis of 32x32 takes 1 to 1024"),
        ({"gaussians": 1025}, "gaussians is 1025"),
        ({"gaussians": 2.5}, "gaussians is 2.5"),
        ({"frequency_aware": "yes"}, "frequency_aware is 'yes'; use 'auto', True or False"),
        ({"preset": "best"}, "preset 'best' is unknown; use one of default, eigengs"),
        ({"steps": -1}, "steps is -1"),
        ({"preset": "eigengs", "steps": 0}, "steps is 0"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_fit_refuses(options, words):
    with pytest.raises(ValueError, match=words):
        eg.EigenGS.fit(small_basis(), **{"gaussians": SPLATS, **options})


# --- Files and names ---------------------------------------------------------------------------


@splits
def test_save_and_load(backend, split, others, tmp_path):
    """Half precision costs nothing that can be seen."""
    model = small_model(backend, split)
    model.save(tmp_path / "model.npz")
    again = eg.EigenGS.load(tmp_path / "model.npz", backend=backend)
    assert (again.low, again.low_components) == (model.low, model.low_components)
    assert again.gaussians.space == model.gaussians.space
    for one, two in zip(again.weights, model.weights, strict=True):
        np.testing.assert_allclose(one, two, atol=6e-4 * np.abs(two).max())
    for one, two in zip(again.eigenvalues, model.eigenvalues, strict=True):
        np.testing.assert_array_equal(one, two)
    for colors in ("exact", "projected"):
        first, second = (fidelity(rendered(m, others, colors), others) for m in (model, again))
        assert second == pytest.approx(first, abs=0.01)


def test_half_precision_of_extreme_weights(backend, tmp_path):
    """Scaled by component: neither tiny nor huge ones are lost."""
    basis, model = small_basis(), small_model(backend)
    weights = tuple(w * s for w, s in zip(model.weights, (1e-9, 1e3, 0), strict=True))
    odd = eg.EigenGS(model.gaussians, weights, basis.eigenvalues, basis.mean)
    odd.save(tmp_path / "odd.npz")
    for one, two in zip(eg.EigenGS.load(tmp_path / "odd.npz").weights, weights, strict=True):
        np.testing.assert_allclose(one, two, atol=6e-4 * np.abs(two).max())


def test_shipped_basis(backend):
    """ "natural" is there, small, and encodes the photo that it was not trained on."""
    model = load_basis("natural", backend)
    assert model is load_basis("natural", backend)
    assert len(model.gaussians) == 5000
    image = eg.sample(DEMO)
    projected, exact = (eg.render(model.encode(image, c)).numpy() for c in ("projected", "exact"))
    assert eg.psnr(projected, image, "ycbcr") > 22
    assert eg.psnr(exact, image, "ycbcr") > 27


def test_shipped_basis_is_small():
    from eigengs_dr.eigenbasis.registry import SHIPPED

    assert SHIPPED["natural"].stat().st_size <= 4_000_000


def test_crops_of_the_shipped_basis():
    one, two = (list(crops(13, seed=0)) for _ in range(2))
    assert {crop.shape for crop in one} == {(256, 256, 3)}
    np.testing.assert_array_equal(one, two)


def test_bases_by_name_and_file(backend, tmp_path):
    model = small_model(backend)
    model.save(tmp_path / "small.npz")
    assert load_basis(model) is model
    assert len(load_basis(tmp_path / "small.npz", backend).gaussians) == SPLATS
    with pytest.raises(ValueError, match="basis 'nature' is neither a file nor one of: natural"):
        load_basis("nature")


# --- Fit from a basis --------------------------------------------------------------------------


def test_fit_starts_from_the_exact_colours(backend, others):
    model = small_model(backend)
    result = eg.fit(others[0], iterations=0, init="eigen", basis=model, backend=backend)
    expected = eg.render(model.encode(others[0])).numpy()
    assert eg.psnr(result.image, others[0]) == pytest.approx(eg.psnr(expected, others[0]), abs=0.02)
    assert len(result.gaussians) == SPLATS
    assert result.mean_image is None


def test_fit_at_another_size_solves_again(backend, others):
    model, image = small_model(backend), resample(others[0], 60, 44).clip(0, 1)
    result = eg.fit(image, iterations=0, init="eigen", basis=model, backend=backend)
    encoded = eg.psnr(eg.render(model.encode(image)), image, "ycbcr")
    assert result.trace[0]["psnr_ycbcr"] >= encoded - 1e-3


def test_fit_by_the_paper(backend, others):
    """Projected colours beside the dense mean image, refined from there."""
    model = small_model(backend)
    result = eg.fit(others[0], iterations=100, preset="eigengs", basis=model, backend=backend)
    shown = model.encode(others[0], "projected", "dense")
    start = (
        to_planes(eg.render(shown).numpy(), "ycbcr") + model.dense_mean(SIDE, SIDE).reshape(-1, 3).T
    )
    error = np.square(start - to_planes(others[0], "ycbcr")).mean()
    assert result.trace[0]["psnr_ycbcr"] == pytest.approx(-10 * np.log10(error), abs=0.01)
    assert result.trace[-1]["psnr_ycbcr"] > result.trace[0]["psnr_ycbcr"] + 1
    whole = eg.render(result.gaussians).numpy() + result.mean_image
    np.testing.assert_array_equal(whole, result.image)
    assert eg.psnr(result.image, others[0], "ycbcr") == max(r["psnr_ycbcr"] for r in result.trace)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gaussians": 50}, "gaussians is 50, but the basis has 100"),
        ({"color": "rgb"}, "color is 'rgb', but the basis is in 'ycbcr'"),
        ({"basis": "nothing"}, "basis 'nothing' is neither a file nor one of: natural"),
        ({"basis": "natural"}, "more than an image of 32x32 has pixels"),
        ({"preset": "eigengs", "init": "grid"}, "preset 'eigengs' starts from a basis"),
    ],
)
def test_fit_refuses_another_basis(backend, options, words, others):
    options = {"basis": small_model(backend), "init": "eigen", **options}
    with pytest.raises(ValueError, match=words):
        eg.fit(others[0], backend=backend, **options)


def test_fit_components_default_state(backend):
    """Without training, what `save` sees is the grid."""
    seen = []
    fit_components(
        small_basis(), SPLATS, True, "default", 0, 0, backend, save=lambda s: seen.append(len(s))
    )
    assert seen == [1, 2]
