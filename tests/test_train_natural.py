"""The pictures of the basis that ships."""

import numpy as np

from train_natural import crops


def test_crops_of_the_shipped_basis():
    one, two = (list(crops(13, seed=0)) for _ in range(2))
    assert {crop.shape for crop in one} == {(256, 256, 3)}
    np.testing.assert_array_equal(one, two)
