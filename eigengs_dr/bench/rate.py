"""Rate against distortion: packed fits, and what JPEG and WebP make of as many bytes."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..codec.bit_allocation import pack
from ..fitting.fit import fit
from ..image.io import to_8bit
from ..image.metrics import ssim
from ..image.resize import center_crop
from ..image.samples import sample
from ..raster.render import picture_of
from .pareto import SAMPLE_NAMES, SAMPLE_SIDE, SAMPLES
from .rows import Job, Row
from .sets import test_images
from .trial import decibels, whole

Image = NDArray[np.float32]

OURS = "packed Gaussians"

PIXELS = (256, 128, 64, 32, 16, 8)
"""Pixels a splat of the fits that are packed."""

BUDGET = 0.8
"""Decibels that packing may lose: of fits of all numbers of splats, some below and some above,
these had the best PSNR at equal size on training photos, by little."""

WARM_UP = 6
"""Untimed steps before a fit, that compile its programs."""


class Codec(NamedTuple):
    """A codec of Pillow.

    Attributes
    ----------
    format : str
        Pillow's name.
    options : dict
        What it is told, beside the quality.
    qualities : tuple of int
    """

    format: str
    options: dict[str, Any]
    qualities: tuple[int, ...]


_QUALITIES = (2, 5, 10, 15, 20, 30, 40, 50, 60, 70, 80, 85, 90, 95)

CODECS = {
    "JPEG 4:2:0": Codec("JPEG", {"optimize": True, "subsampling": 2}, _QUALITIES),
    "JPEG 4:4:4": Codec("JPEG", {"optimize": True, "subsampling": 0}, _QUALITIES),
    "WebP": Codec("WEBP", {"method": 6}, _QUALITIES),
}
"""What packed fits are compared with, at the slowest and best setting of the encoder."""


def images_of(data: Path | None, name: str, count: int) -> list[tuple[str, Image]]:
    """Load the first images of a set; `SAMPLES` are photos of scikit-image and need no data.

    Raises
    ------
    ValueError
        If the set is not there.
    """
    if name == SAMPLES:
        names = SAMPLE_NAMES[:count]
        return [(photo, center_crop(sample(photo), SAMPLE_SIDE, SAMPLE_SIDE)) for photo in names]
    if data is None:
        raise ValueError(f"set {name!r} needs DATA, the folder that holds it")
    return test_images(data, name, count)


def jobs(
    name: str,
    images: list[tuple[str, Image]],
    iterations: int,
    budget: float = BUDGET,
    seed: int = 0,
    backend: str | None = None,
) -> Iterator[Job]:
    """Name the measurements on a set: for each image a packed fit of each size, and the codecs.

    A row has "points", a list of dictionaries: setting (the number of Gaussians, or the quality),
    bytes, bits_per_pixel, psnr_rgb, psnr_ycbcr, ssim and seconds, those of encoding; that of a
    packed fit also fit_seconds, which are among them, and unpacked_rgb, the PSNR before.
    """
    for photo, image in images:
        about = {"set": name, "image": photo}
        for pixels in PIXELS:
            count = max(1, image.shape[0] * image.shape[1] // pixels)
            settings = {"iterations": iterations, "budget": budget, "seed": seed}
            label = {**about, "codec": OURS, "gaussians": count, **settings}
            yield label, partial(_packed, image, count, iterations, budget, seed, backend)
        for title, codec in CODECS.items():
            yield {**about, "codec": title}, partial(_coded, image, codec)


def _packed(
    image: Image, count: int, iterations: int, budget: float, seed: int, backend: str | None
) -> Row:
    """Fit, pack, and look at what the file holds."""
    made = partial(fit, image, count, seed=seed, backend=backend)
    whole(made(iterations=min(WARM_UP, iterations)))
    started = time.perf_counter()
    fitted = whole(made(iterations=iterations))
    between = time.perf_counter()
    with TemporaryDirectory() as folder:
        receipt = pack(fitted.gaussians, Path(folder) / "fit.egs", image, budget)
    seconds = {
        "seconds": time.perf_counter() - started,
        "fit_seconds": between - started,
        "unpacked_rgb": decibels(fitted.image, image, "rgb"),
    }
    return {"points": [_point(count, receipt.bytes, picture_of(receipt.gaussians), image, seconds)]}


def _coded(image: Image, codec: Codec) -> Row:
    """Write an image in all qualities, and read what came of it."""
    from PIL import Image as pillow

    source, points = pillow.fromarray(to_8bit(image).astype(np.uint8)), []
    for quality in codec.qualities:
        file = io.BytesIO()
        started = time.perf_counter()
        source.save(file, codec.format, quality=quality, **codec.options)
        seconds = {"seconds": time.perf_counter() - started}
        shown = np.asarray(pillow.open(file).convert("RGB"), np.float32) / 255
        points.append(_point(quality, file.tell(), shown, image, seconds))
    return {"points": points}


def _point(
    setting: int, size: int, shown: NDArray[Any], image: Image, more: dict[str, float]
) -> Row:
    return {
        "setting": setting,
        "bytes": size,
        "bits_per_pixel": 8 * size / (image.shape[0] * image.shape[1]),
        "psnr_rgb": decibels(shown, image, "rgb"),
        "psnr_ycbcr": decibels(shown, image, "ycbcr"),
        "ssim": ssim(shown, image),
        **more,
    }
