"""Two pixels, what Pillow says of a file, and the arrays of a file."""

import numpy as np
from PIL import Image

BYTES = np.array([[[0, 51, 102], [255, 204, 153]]], np.uint8)


def property_of(path, name):
    """Open a file with Pillow itself and ask it for its mode or format."""
    with Image.open(path) as file:
        return getattr(file, name)


def members_of(path):
    """The arrays of an .npz file, without its format and version."""
    with np.load(path, allow_pickle=False) as file:
        return {key: file[key] for key in file if key not in ("format", "version")}
