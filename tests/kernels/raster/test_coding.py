"""Rows in words of 16 bits a number: what they lose, and which sets keep floats."""

import numpy as np
import pytest

from _helpers.sets import SIZE, random_scene
from eigengs_dr.raster.evaluate import inverted
from eigengs_dr.raster.lookup.coding import encode_rows
from eigengs_dr.raster.parameters import KernelParameters
from eigengs_dr.raster.render import decode_parameters

HALF, SHORT = 2.0**-11, 2.0**-10
"""Largest relative errors of 10 and of 9 bits of mantissa: half of the last bit, beside 1."""


def coded(gaussians, is_filtered=False):
    """What decodes the rows of a set, their words, and the parameters that were encoded."""
    p = decode_parameters(gaussians)
    stored = inverted(p.shape) if is_filtered else p.shape
    found = encode_rows(p.shape, stored, p.color, (gaussians.width, gaussians.height))
    return found and (*found, KernelParameters(stored, p.color, p.background))


def numbers(rows):
    return np.stack([np.array(row, np.float64) for row in rows])


@pytest.mark.parametrize(
    ("is_filtered", "channels", "magnitudes"),
    [(False, 1, (-3, 0)), (True, 3, (-2, 5.3)), (False, 6, (-18, -12))],
)
def test_numbers_lose_what_their_bits_say(backend, is_filtered, channels, magnitudes):
    """Also light above 65,504, the largest of plain halves, and colours below all of theirs."""
    scene, rng = random_scene(3, 60, channels=channels), np.random.default_rng(5)
    color = rng.choice([-1, 1], scene.color.shape)
    color = color * 10 ** rng.uniform(*magnitudes, scene.color.shape)
    gaussians = scene._replace(color=np.float32(color)).on(backend)
    coding, words, given = coded(gaussians, is_filtered)
    assert len(words) == coding.words == 2 + (1 + channels + 1) // 2
    shape, color = (numbers(rows) for rows in coding.decode(words))
    (x, y, a, b, c), exact = numbers(given.shape), numbers(given.color)
    for found, mean, step in zip(shape[:2], (x, y), coding.step, strict=True):
        # Half a step, and the rounding of the product and of the sum in single precision.
        np.testing.assert_allclose(found, mean, atol=step / 2 + 2 * np.spacing(np.float32(64)))
    np.testing.assert_allclose(shape[2:5:2], (a, c), rtol=SHORT)
    np.testing.assert_allclose(shape[3], b, rtol=HALF, atol=2.0**-26 * max(a.max(), c.max()))
    np.testing.assert_allclose(color, exact, rtol=HALF)


def test_what_is_held(backend):
    """Not double precision, nor too much light; but no light at all, and means outside."""
    scene = random_scene(1, 60)
    assert coded(scene.on(backend, bits=64)) is None
    assert coded(scene._replace(color=np.float32(3e9 + scene.color)).on(backend)) is None
    assert coded(scene._replace(color=0 * scene.color).on(backend)) is not None
    scene.mean[:2] = np.array([[-1.5, 0.3], [2.5, -0.7]]) * SIZE
    for one in (scene, scene.permuted([0])):
        coding, words, given = coded(one.on(backend))
        shape, _ = coding.decode(words)
        np.testing.assert_allclose(numbers(shape[:2]), numbers(given.shape[:2]), atol=1e-3)
