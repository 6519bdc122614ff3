"""Bases by name and by file."""

import pytest

import eigengs_dr as eg
from _helpers.families import SPLATS, small_model
from eigengs_dr.eigenbasis.registry import load_basis
from train_natural import DEMO


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


def test_bases_by_name_and_file(backend, tmp_path):
    model = small_model(backend)
    model.save(tmp_path / "small.npz")
    assert load_basis(model) is model
    assert len(load_basis(tmp_path / "small.npz", backend).gaussians) == SPLATS
    with pytest.raises(ValueError, match="basis 'nature' is neither a file nor one of: natural"):
        load_basis("nature")
