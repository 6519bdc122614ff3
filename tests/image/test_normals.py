"""Normal maps: vectors get the length 1 after the sum, in NumPy, in Dr.Jit, in fits and files."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.packed import few_groups
from _helpers.sets import random_scene
from eigengs_dr.backend.selection import select
from eigengs_dr.image.pixels import ImageError
from eigengs_dr.image.space import NORMAL


def bumps(side=24):
    """A normal map of waves, shape (side, side, 3), in codes."""
    y, x = np.mgrid[:side, :side] / side
    n = np.stack([0.4 * np.sin(9 * x + 2 * y), 0.4 * np.cos(7 * y), np.ones_like(x)], axis=2)
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    return (0.5 + 0.5 * n).astype(np.float32)


def lengths(codes):
    """Lengths of the vectors of codes."""
    return np.linalg.norm(2 * codes - 1, axis=2)


def test_unit_vectors_stay_and_others_get_the_length_1():
    np.testing.assert_allclose(NORMAL.decode_image(bumps()), bumps(), atol=1e-6)
    short = 0.5 + 0.3 * (bumps() - 0.5)
    np.testing.assert_allclose(NORMAL.decode_image(short), bumps(), atol=1e-6)
    assert np.isfinite(NORMAL.decode_image(np.full((1, 1, 3), 0.5))).all()


def test_a_rendering_is_the_sum_renormalised(backend):
    g = random_scene(3).on(backend, space="normal")
    summed = eg.render(replace(g, space="data")).numpy()
    np.testing.assert_allclose(eg.render(g).numpy(), NORMAL.decode_image(summed), atol=2e-6)
    np.testing.assert_allclose(eg.picture_of(g), NORMAL.decode_image(summed), atol=2e-6)


@pytest.mark.parametrize("mode", ["backward", "forward"])
def test_derivatives_of_the_length(backend, mode):
    dr = pytest.importorskip("drjit")
    Tensor = select(backend).TensorXf64
    random = np.random.default_rng(0)
    codes, along = random.uniform(0, 1, (2, 3, 4, 3))
    weight, step = random.normal(size=(3, 4, 3)), 1e-6
    sides = [np.sum(weight * NORMAL.decode_image(codes + d * along)) for d in (-step, step)]
    expected = (sides[1] - sides[0]) / (2 * step)
    x = Tensor(codes)
    dr.enable_grad(x)
    y = NORMAL.decode_image(x)
    if mode == "backward":
        dr.backward(dr.sum(y * Tensor(weight), axis=None))
        found = np.sum(dr.grad(x).numpy() * along)
    else:
        dr.set_grad(x, Tensor(along))
        dr.forward_to(y)
        found = np.sum(dr.grad(y).numpy() * weight)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@few_groups()
def test_a_fit_has_unit_normals_and_its_file_too(tmp_path):
    result = eg.fit(bumps(), 60, iterations=10, space="normal")
    np.testing.assert_allclose(lengths(result.image), 1, atol=1e-5)
    assert result.trace[-1]["psnr_ycbcr"] > 30
    few = result.gaussians[:8]
    few.save(tmp_path / "n.npz")
    eg.pack(few, tmp_path / "n.egs")
    for name, loss in (("n.npz", 1e-5), ("n.egs", 0.1)):
        loaded = eg.Gaussians.load(tmp_path / name)
        assert loaded.space == "normal"
        np.testing.assert_allclose(eg.render(loaded), eg.render(few), atol=loss)


def test_what_is_no_normal_map():
    with pytest.raises(ImageError, match="a normal map has three channels; use space 'data'"):
        eg.fit(bumps()[..., :1], 10, iterations=0, space="normal")
    with pytest.raises(ImageError, match=r"normals run from -.* not 0 to 1; pass \(n \+ 1\) / 2"):
        eg.fit(2 * bumps() - 1.5, 10, iterations=0, space="normal")
