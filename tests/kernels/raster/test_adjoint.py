"""The adjoint of derivatives in pairs of 16 bits."""

import numpy as np

from _helpers.sets import random_scene
from eigengs_dr.raster.adjoint import adjoint
from eigengs_dr.raster.kernels import residual
from eigengs_dr.raster.parameters import kernel_radius, kernel_shape, pack_parameters
from eigengs_dr.raster.render import bin_gaussians


def test_pairs(backend):
    """The adjoint of a derivative in pairs is that of the rounded derivative."""
    gaussians = random_scene(6).on(backend)
    lists, radius = bin_gaussians(gaussians), kernel_radius(gaussians.cutoff)
    packed = pack_parameters([*kernel_shape(gaussians), *gaussians.color])
    background = list(gaussians.background)
    delta, squares = residual(packed, background, lists, radius, None)
    pairs, same_squares = residual(packed, background, lists, radius, None, pairs=True)
    np.testing.assert_array_equal(squares, same_squares)
    rounded = delta.numpy()
    assert pairs.numpy().nbytes == rounded.nbytes // 2
    rounded = ((rounded.view(np.uint32) + 0x8000) & 0xFFFF0000).view(np.float32)
    np.testing.assert_allclose(rounded, delta.numpy(), rtol=2**-8)
    of_pairs = adjoint(packed, pairs, 3, lists, radius)
    of_rounded = adjoint(packed, type(delta)(rounded), 3, lists, radius)
    np.testing.assert_array_equal(np.array(of_pairs), np.array(of_rounded))
