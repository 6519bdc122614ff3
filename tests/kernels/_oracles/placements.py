"""What every placement of splats has to keep to."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp


def check_placement(mean, factor, count, size):
    """Check shapes and bounds of what a placement returns."""
    width, height = size
    assert mean.shape == (count, 2)
    assert factor.shape == (count, 3)
    assert np.isfinite(mean).all()
    assert np.isfinite(factor).all()
    assert ((mean >= 0) & (mean <= [width, height])).all()
    assert (factor[:, [0, 2]] > 0).all()


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
