"""The photos that come with scikit-image."""

import numpy as np
import pytest

from _helpers.errors import one_line
from eigengs_dr.image.io import SAMPLES, ImageError, sample


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_need_no_download(name):
    image = sample(name)
    assert image.dtype == np.float32 and image.shape[2] == 3
    assert min(image.shape[:2]) >= 300
    assert image.min() >= 0 and image.max() <= 1 and np.ptp(image) > 0.4


def test_unknown_sample():
    with pytest.raises(ImageError, match="use one of astronaut, ") as error:
        sample("lena")
    one_line(error)
