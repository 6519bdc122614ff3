"""Sample photos that are part of scikit-image."""

import importlib.util
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .io import ImageError, load_image

SAMPLES = {
    "astronaut": "astronaut.png",
    "brick": "brick.png",
    "camera": "camera.png",
    "chelsea": "chelsea.png",
    "coffee": "coffee.png",
    "coins": "coins.png",
    "grass": "grass.png",
    "gravel": "gravel.png",
    "hubble": "hubble_deep_field.jpg",
    "moon": "moon.png",
    "motorcycle": "motorcycle_left.png",
    "retina": "retina.jpg",
    "rocket": "rocket.jpg",
}
"""Files inside the scikit-image wheel, by name; its other photos need a download."""


def sample(name: str) -> NDArray[np.float32]:
    """Load a photo that is part of scikit-image, without a download.

    Parameters
    ----------
    name : str
        One of `SAMPLES`, for instance ``"astronaut"``, ``"chelsea"`` (a cat) or ``"coffee"``.

    Returns
    -------
    ndarray of float32, shape (H, W, 3)
        RGB in [0, 1]; grey photos have three equal channels.

    Raises
    ------
    ImageError
        If the name is unknown, or scikit-image is not installed.
    """
    if name not in SAMPLES:
        raise ImageError(f"sample {name!r} is unknown; use one of {', '.join(SAMPLES)}")
    # find_spec finds the folder without the slow import of scikit-image.
    package = importlib.util.find_spec("skimage")
    if package is None or package.origin is None:
        raise ImageError("scikit-image, which holds the samples, is missing; install scikit-image")
    return load_image(Path(package.origin).parent / "data" / SAMPLES[name])
