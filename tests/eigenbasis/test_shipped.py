"""Models by name, by file and in another process."""

import pickle

import numpy as np

import eigengs_dr as eg
from _helpers.families import small_model
from _helpers.sets import check_equal
from eigengs_dr.eigenbasis.eigengs import SHIPPED, EigenGS
from train_natural import DEMO, crops


def test_shipped_basis(backend):
    """ "natural" is there, small, and encodes the photo that it was not trained on."""
    model = EigenGS.load("natural", backend)
    assert model is not EigenGS.load("natural", backend)
    assert len(model.gaussians) == 5000
    image = eg.sample(DEMO)
    projected, exact = (eg.render(model.encode(image, c)).numpy() for c in ("projected", "exact"))
    assert eg.psnr(projected, image, "ycbcr") > 22
    assert eg.psnr(exact, image, "ycbcr") > 27


def test_crops_that_the_shipped_basis_is_trained_on():
    one, two = (list(crops(13, seed=0)) for _ in range(2))
    assert {crop.shape for crop in one} == {(256, 256, 3)}
    np.testing.assert_array_equal(one, two)


def test_shipped_basis_is_small():
    assert SHIPPED["natural"].stat().st_size <= 4_000_000


def test_a_model_travels_as_arrays(backend):
    """A worker of a cluster gets the same bits."""
    model = small_model(backend)
    assert model.encoder
    again = pickle.loads(pickle.dumps(model))
    check_equal(again.gaussians, model.gaussians.to_arrays())
    for first, second in zip(model.weights, again.weights, strict=True):
        np.testing.assert_array_equal(first, second)
