"""The density that an error asks for, and placement by it."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.halves import SIDE, picture
from _helpers.sets import SIZE, random_scene
from _oracles.objectives import objective_of
from _oracles.tiles import to_map, to_tiles
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.place import Grid
from eigengs_dr.fitting.placement.redistribution import (
    ERROR_EXPONENT,
    Owners,
    redistribute,
    target_density,
)
from eigengs_dr.raster.render import render


def rounds(side, backend, spacing=5):
    """Round Gaussians in the centres of squares."""
    y, x = (v.ravel() for v in np.mgrid[spacing / 2 : side : spacing, spacing / 2 : side : spacing])
    sharpness = np.full(len(x), 1 / (0.7 * spacing))
    return eg.Gaussians.from_arrays(
        np.stack([x, y], 1),
        np.stack([sharpness, 0 * x, sharpness], 1),
        np.zeros((len(x), 1)),
        size=(side, side),
        space="data",
        backend=backend,
    )


def density_for(gaussians, error, bending, backend):
    (error, grid), (bending, _) = to_tiles(error, backend), to_tiles(bending, backend)
    return to_map(target_density(Owners.of(gaussians), error, bending), grid)


def test_parts_are_those_of_the_weights(backend):
    """A sum over pixels and an average over Gaussians, by all weights in double precision."""
    scene = random_scene(channels=1)
    owners = Owners.of(scene.on(backend))
    weights = np.exp(-0.5 * np.square(scene.distances()))
    weights[scene.distances() > 3] = 0
    total = weights.sum(axis=0)
    parts = weights / np.where(total > 1e-6, total, np.inf)
    rng = np.random.default_rng(0)
    maps, values = rng.uniform(0, 1, (2, *SIZE[::-1])), rng.uniform(1, 2, len(weights))
    tiles = [to_tiles(m, backend)[0] for m in maps]
    for found, expected in zip(owners.collect(*tiles), maps, strict=True):
        np.testing.assert_allclose(
            found.numpy(), (parts * expected).sum((1, 2)), rtol=0.1, atol=0.1
        )
    inner = scene.off_edge(3.0) & (total > 0.1)
    values = types_in(select(backend)).Float(values)
    found = to_map(owners.average(values), owners.lists.grid)
    expected = np.einsum("n,nhw->hw", values, parts)
    np.testing.assert_allclose(found[inner], expected[inner], rtol=1e-4)
    assert (found > 0.99).all()  # also where there is no Gaussian


@pytest.mark.parametrize("times", [1.0, 0.1, 100.0])
def test_density_follows_the_error_by_its_power(backend, times):
    """Far from the border of two halves, densities differ by ``times^(1 / (q + 1))``.

    Of equal errors nothing is gained by moving any.
    """
    error = np.ones((80, 80))
    error[:, 40:] = times
    density = density_for(rounds(80, backend), error, np.ones((80, 80)), backend)
    ratio = density[20:60, 60].mean() / density[20:60, 20].mean()
    np.testing.assert_allclose(ratio, times ** (1 / (ERROR_EXPONENT + 1)), rtol=1e-3)


def test_in_a_part_density_follows_the_bending(backend):
    """One Gaussian owns all pixels."""
    bending = np.ones((32, 32))
    bending[:, 4:8] = 5
    one = eg.Gaussians.from_arrays(
        [[16, 16]], [[0.05, 0, 0.05]], [[0]], size=(32, 32), space="data", backend=backend
    )
    density = density_for(one, np.ones((32, 32)), bending, backend)
    np.testing.assert_allclose(density / density[0, 0], bending, rtol=1e-3)


@pytest.mark.parametrize("side", [32, 150])
def test_rearranged_has_the_count_and_goes_where_the_error_is(side):
    """Also where splats are so far apart that they are placed on a smaller image."""
    image = np.kron(picture(), np.ones((-(-side // SIDE), -(-side // SIDE), 1)))[:side, :side]
    objective = objective_of(image.astype(np.float32))
    start = replace(eg.DEFAULT, place=Grid()).place_and_solve(objective, 64)
    result = redistribute(start, objective, 50)
    left = result.mean.numpy()[0] < side / 2
    assert len(result) == 50
    assert left.mean() > 0.6  # half of the area, most of the error
    assert np.isfinite(render(result).numpy()).all()
