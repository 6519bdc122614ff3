"""Rate against distortion: packed fits beside JPEG, JPEG 2000, WebP and AVIF of as many bytes.

A row has "points": setting (the number of Gaussians, or the quality), bytes, bits_per_pixel,
psnr_rgb, psnr_ycbcr, ssim, ms_ssim, seconds of encoding and decode_seconds; the point of a packed
fit also fit_seconds, which are among the seconds, and unpacked_rgb, the PSNR before.
"""

import io
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image as pillow

from eigengs_bench.harness.datasets import images_of
from eigengs_bench.harness.store import Job, Row, Task
from eigengs_bench.harness.timing import Image, decibels
from eigengs_dr.codec.packing import pack
from eigengs_dr.fitting.fit import fit
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.io import to_8bit
from eigengs_dr.image.metrics import ms_ssim, ssim
from eigengs_dr.raster.render import picture_of

FILE, OURS = "rate.jsonl", "packed Gaussians"

PIXELS = (256, 128, 64, 32, 16, 8)  # pixels a Gaussian of the fits that are packed
# Decibels that packing may lose: of some numbers below it and some above,
# these had the best PSNR at equal size on training photos, by little.
BUDGET = 0.8
WARM_UP = 6  # untimed steps before a fit, that compile its programs
QUALITIES = (2, 5, 10, 15, 20, 30, 40, 50, 60, 70, 80, 85, 90, 95)
RATIOS = (200, 120, 80, 60, 48, 40, 32, 26, 20, 16, 13, 10, 8, 6)


class Codec(NamedTuple):
    """Pillow's name and options of a codec, at a slow and good setting of the encoder.

    The settings are qualities, or ratios of the sizes of the pixels and the file.
    """

    kind: str
    options: dict[str, Any]
    settings: tuple[int, ...] = QUALITIES

    def set_to(self, setting: int) -> dict[str, Any]:
        """Return the options of a file with a setting."""
        if self.settings is RATIOS:
            return {**self.options, "quality_mode": "rates", "quality_layers": [setting]}
        return {**self.options, "quality": setting}


CODECS = {
    "JPEG 4:2:0": Codec("JPEG", {"optimize": True, "subsampling": 2}),
    "JPEG 4:4:4": Codec("JPEG", {"optimize": True, "subsampling": 0}),
    "JPEG 2000": Codec("JPEG2000", {"irreversible": True, "mct": 1}, RATIOS),
    "WebP": Codec("WEBP", {"method": 6}),
    # Slower settings take up to 20 s a photo, for 1 % more bits at equal PSNR.
    "AVIF": Codec("AVIF", {"speed": 4, "max_threads": 1}),
}


def run(task: Task, names: Sequence[str]) -> list[Row]:
    """Measure on each image a packed fit of each size, and the codecs."""
    jobs = [job for name in names for job in _jobs(task, name, images_of(task, name))]
    return task.measure(FILE, jobs, "rate")


def _jobs(task: Task, name: str, images: list[tuple[str, Image]]) -> Iterator[Job]:
    settings = {"iterations": task.iterations, "budget": BUDGET, "seed": task.seed}
    for photo, image in images:
        about = {"set": name, "image": photo}
        for pixels in PIXELS:
            count = max(1, image.shape[0] * image.shape[1] // pixels)
            label = {**about, "codec": OURS, "gaussians": count, **settings}
            yield label, partial(_packed, task, image, count)
        for title, codec in CODECS.items():
            yield {**about, "codec": title}, partial(_coded, image, codec)


def _packed(task: Task, image: Image, count: int) -> Row:
    made = partial(fit, image, count, seed=task.seed, backend=task.backend)
    made(iterations=min(WARM_UP, task.iterations))
    started = time.perf_counter()
    fitted = made(iterations=task.iterations)
    between = time.perf_counter()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "fit.egs"
        receipt = pack(fitted.gaussians, path, image, BUDGET)
        seconds = {"seconds": time.perf_counter() - started, "fit_seconds": between - started}
        picture_of(Gaussians.load(path, task.backend))  # compiles
        loaded = time.perf_counter()
        shown = picture_of(Gaussians.load(path, task.backend))
        seconds["decode_seconds"] = time.perf_counter() - loaded
    point = _point(count, receipt.bytes, shown, image)
    before = decibels(fitted.image, image, "rgb")
    return {"points": [{**point, **seconds, "unpacked_rgb": before}]}


def _coded(image: Image, codec: Codec) -> Row:
    source, points = pillow.fromarray(to_8bit(image).astype(np.uint8)), []
    for setting in codec.settings:
        file = io.BytesIO()
        started = time.perf_counter()
        source.save(file, codec.kind, **codec.set_to(setting))
        coded = time.perf_counter()
        pixels = np.asarray(pillow.open(file).convert("RGB"))
        seconds = {"seconds": coded - started, "decode_seconds": time.perf_counter() - coded}
        shown = pixels.astype(np.float32) / 255
        points.append({**_point(setting, len(file.getvalue()), shown, image), **seconds})
    return {"points": points}


def _point(setting: int, size: int, shown: NDArray[Any], image: Image) -> Row:
    return {
        "setting": setting,
        "bytes": size,
        "bits_per_pixel": 8 * size / (image.shape[0] * image.shape[1]),
        "psnr_rgb": decibels(shown, image, "rgb"),
        "psnr_ycbcr": decibels(shown, image, "ycbcr"),
        "ssim": ssim(shown, image),
        "ms_ssim": ms_ssim(shown, image),
    }
