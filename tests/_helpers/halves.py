"""A picture with a smooth half and a busy half."""

import numpy as np

SIDE = 32


def picture(seed=0):
    """A smooth half and a busy one, RGB."""
    y, x = np.indices((SIDE, SIDE)) / SIDE
    image = np.stack([0.4 + 0.2 * x, 0.5 + 0.2 * y, 0.6 - 0.2 * x], axis=-1)
    noise = np.random.default_rng(seed).uniform(-0.2, 0.2, (SIDE, SIDE // 2, 3))
    image[:, : SIDE // 2] += noise
    return image.astype(np.float32)
