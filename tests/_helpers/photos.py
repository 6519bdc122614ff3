"""Photos to fit, and folders of pictures to train on."""

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

import eigengs_dr as eg


def random_fields(folder, count, seed=0, channels=3, size=32):
    """Fill a new folder with pictures of low-pass noise."""
    noise = np.random.default_rng(seed).normal(size=(count, size, size, channels))
    smooth = gaussian_filter(noise, (0, 3, 3, 0), mode="wrap")
    pixels = (127 + 45 * smooth / smooth.std()).clip(0, 255).astype(np.uint8)
    folder.mkdir()
    for i, image in enumerate(pixels):
        Image.fromarray(image.squeeze()).save(folder / f"{i:03}.png")
    return folder


def coffee(side):
    """A crop of a photo, RGB in [0, 1], shape (side, side, 3)."""
    return eg.sample("coffee")[100 : 100 + side, 200 : 200 + side]
