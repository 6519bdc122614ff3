"""Adaptive placement: its density, its pieces and its shapes, beside mathematics in float64."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.footprints import matrices
from _helpers.sets import few
from _oracles.objectives import objective_of
from eigengs_dr.codec.range_coder import hilbert_encode
from eigengs_dr.fitting.place import (
    MAX_STRETCH,
    RELATIVE_SIZE,
    Adaptive,
    Grid,
    Random,
    blurred,
    centroids_along_curve,
    density_from_hessian,
    hilbert_curve,
    normalized,
    shapes_from_hessian,
)
from eigengs_dr.paper.gaussianimage import RandomColors


@st.composite
def images_and_counts(draw):
    """Images down to one pixel, of noise, few values or one value, and any number of splats."""
    height, width, channels = draw(
        st.tuples(st.integers(1, 24), st.integers(1, 24), st.sampled_from([1, 3]))
    )
    kinds = [st.floats(0, 1, width=32), st.sampled_from([0.0, 1.0]), st.just(0.5)]
    elements = draw(st.sampled_from(kinds))
    image = draw(hnp.arrays(np.float32, (height, width, channels), elements=elements))
    return image, draw(st.integers(1, height * width))


@few
@given(drawn=images_and_counts())
@pytest.mark.parametrize("place", [Adaptive(), Grid(), Random(), RandomColors()], ids=repr)
def test_every_placement_on_any_image(place, drawn):
    """A set, its cutoff, and whether it has colours."""
    image, count = drawn
    found = place(objective_of(image, "llvm", "data"), count, 4.0, 1)
    arrays = found.to_arrays()
    assert len(found) == count and all(np.isfinite(array).all() for array in arrays.values())
    assert ((arrays["mean"] >= 0) & (arrays["mean"] <= image.shape[1::-1])).all()
    assert (arrays["factor"][:, [0, 2]] > 0).all()
    assert (found.cutoff, found.space, found.channels) == (4, "data", image.shape[2])
    assert arrays["color"].any() == place.has_colors


# --- Density ------------------------------------------------------------------------------------


def density_of(image, count):
    """Gaussians per pixel (H, W)."""
    spacing = float(np.sqrt(image.shape[0] * image.shape[1] / count))
    return normalized(density_from_hessian(np.moveaxis(image, 2, 0), spacing)[1], count)


@pytest.mark.parametrize("count", [1, 10, 100, 400])
def test_density_sums_to_the_count(count):
    y, x = np.indices((40, 40)) / 40
    image = np.stack([np.sin(7 * x * x + y), np.cos(9 * y), x * y], axis=-1).astype(np.float32)
    assert density_of(image, count).sum(dtype=float) == pytest.approx(count, rel=1e-5)


def test_second_derivatives_of_a_parabola():
    """2 and 6 along the axes, 1 across: H H, in both channels."""
    y, x = np.indices((30, 40))
    image = np.stack([x * x + 3 * y * y + x * y] * 2).astype(np.float32) / 64
    energy, density = density_from_hessian(image, 4.0)
    hessian = np.array([[2.0, 1], [1, 6]]) / 64
    squared = 2 * hessian @ hessian
    noise = (0.2 / 4.0**2) ** 2 / 2
    inner = np.s_[10:20, 10:30]
    expected = squared[0, 0] + noise, squared[1, 1] + noise, squared[0, 1]
    for entry, value in zip(energy, expected, strict=True):
        np.testing.assert_allclose(entry[inner], value, rtol=1e-3)
    trace = np.trace(squared) + 2 * noise
    np.testing.assert_allclose(density[inner], trace ** (2 / 3), rtol=1e-3)


# --- Pieces of a curve --------------------------------------------------------------------------

sides = {"height": st.integers(1, 90), "width": st.integers(1, 90)}


@few
@given(**sides)
def test_the_curve_is_that_of_the_bits_of_places(height, width):
    x, y = hilbert_curve(width, height)
    assert len({*zip(x.tolist(), y.tolist(), strict=True)}) == height * width
    bits = max(2, (max(height, width) - 1).bit_length())
    place = hilbert_encode(np.stack([x, y], 1), bits)
    assert (np.diff(place.astype(np.int64)) > 0).all()


@few
@given(**sides, part=st.floats(0, 1), shift=st.sampled_from([0, 0.3]))
def test_pieces_have_equal_mass(height, width, part, shift):
    """Also where a pixel holds several of them; with all cuts but the ends moved back."""
    density = np.random.default_rng(height).uniform(0, 1, (height, width)) ** 4
    count = max(1, round(part * height * width))
    mean = centroids_along_curve(density.astype(np.float32), count, shift)
    assert ((mean >= 0) & (mean <= [width, height])).all()
    share = np.ones(count) / count
    if count > 1:
        share[0] -= shift / count
        share[-1] += shift / count
    y, x = np.indices(density.shape)
    center = [(density * (v + 0.5)).sum() / density.sum() for v in (x, y)]
    np.testing.assert_allclose(share @ mean, center, rtol=1e-5)


# --- Shapes -------------------------------------------------------------------------------------


def test_shapes_are_those_of_eigenvectors():
    """The long axis lies along the smallest second derivative; the area follows the density."""
    random = np.random.default_rng(5)
    energy = random.uniform(0.5, 1, (3, 20, 24)).astype(np.float32) - [[[0]], [[0]], [[0.75]]]
    density = random.uniform(0.01, 0.1, (20, 24)).astype(np.float32)
    y, x = np.indices(density.shape).reshape(2, -1)
    mean = np.stack([x, y], 1) + 0.5
    factor = shapes_from_hessian(mean, density, energy.astype(np.float32), 5.0)
    xx, yy, xy = blurred(energy.astype(np.float32), 2.0)[:, y, x].astype(float)
    values, axes = np.linalg.eigh(np.moveaxis(np.array([[xx, xy], [xy, yy]]), 2, 0))
    ratio = 1 + (MAX_STRETCH - 1) * (values[:, 1] - values[:, 0]) / values.sum(axis=1)
    variance = RELATIVE_SIZE**2 / density[y, x]
    # Eigenvalues ascend: the first axis lies along the smallest second derivative.
    own = np.stack([variance * ratio, variance / ratio], 1)
    sigma = axes * own[:, None] @ axes.transpose(0, 2, 1)
    np.testing.assert_allclose(matrices(*factor.T), sigma, rtol=1e-4, atol=1e-4 * sigma.max())
