"""Pictures that are read by strips of rows."""

import numpy as np
import pytest

from _helpers.sets import random_scene
from eigengs_dr.raster.render import picture_of, picture_rows


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
@pytest.mark.parametrize("size", [(22, 17), (16, 16), (1, 1)])
def test_rows_are_those_of_the_picture(backend, space, size):
    gaussians = random_scene(size=size).on(backend, space=space)
    read, picture = picture_rows(gaussians), picture_of(gaussians)
    for first in range(0, size[1], 5):
        rows = slice(first, min(first + 5, size[1]))
        np.testing.assert_array_equal(read(rows), picture[rows])
