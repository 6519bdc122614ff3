"""Training of the shared shapes."""

import numpy as np

import eigengs_dr as eg
from _helpers.families import SIDE, SPLATS, small_basis, small_model
from eigengs_dr.eigenbasis.components.bands import frequency_bands
from eigengs_dr.eigenbasis.components.shape_training import RESTART_STEPS, samples, train_shapes


def test_samples_are_those_of_the_pca_model():
    """Covariance ``sum_j lambda_j Psi_j Psi_j^T``: coefficients of variance lambda_j."""
    [band] = frequency_bands(small_basis(), SPLATS, False)
    drawn = samples(band, 0, 0, 1000)
    assert drawn.shape == (1000, SIDE, SIDE, 3)
    for c, (planes, values) in enumerate(zip(band.components, band.eigenvalues, strict=True)):
        found = np.tensordot(drawn[..., c], planes, ((1, 2), (1, 2)))
        np.testing.assert_allclose(found.var(axis=0), values, rtol=0.25)
        np.testing.assert_allclose(found.mean(axis=0), 0, atol=0.15 * np.sqrt(values.max()))
    first = np.tensordot(drawn[..., 0], band.components[0][0])
    for c in (1, 2):  # channels are independent
        other = np.tensordot(drawn[..., c], band.components[c][0])
        assert abs(np.corrcoef(first, other)[0, 1]) < 0.15
    np.testing.assert_array_equal(samples(band, 0, 7, 9), drawn[7:9])


def test_training_shapes_pays(backend):
    seen = []
    model = eg.EigenGS.fit(
        small_basis(),
        SPLATS,
        iterations=4 * RESTART_STEPS,
        backend=backend,
        progress=lambda done, total, row: seen.append((done, total)),
    )
    name = "psnr_components"
    assert model.figures[name] > small_model(backend).figures[name] + 0.3
    assert seen == [(RESTART_STEPS * i, 4 * RESTART_STEPS) for i in range(5)]


def test_training_goes_on(backend):
    """From a round on as if it had not stopped."""
    [band] = frequency_bands(small_basis(), SPLATS, False)
    arguments = (band, 0, 2 * RESTART_STEPS + 5, backend)
    whole = list(train_shapes(*arguments))
    assert [int(state["step"]) for state in whole] == [
        0,
        RESTART_STEPS,
        2 * RESTART_STEPS,
        2 * RESTART_STEPS + 5,
    ]
    rest = list(train_shapes(*arguments, state=whole[1]))
    assert len(rest) == 2
    for key in ("mean", "factor"):
        np.testing.assert_array_equal(rest[-1][key], whole[-1][key])
