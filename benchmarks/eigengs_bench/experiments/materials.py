"""Materials: shared shapes against a set for each map, bitmaps and block compression.

A row has "bytes" of a file and "psnr", psnr_rgb of each map. Rows of Gaussians are of packed
files, and hold "npz_bytes" and "npz_psnr" of plain ones too. A bitmap has one file a map.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image as pillow

from eigengs_bench.experiments.block_codecs import codecs, coded
from eigengs_bench.harness.store import Job, Row, Task
from eigengs_bench.harness.timing import Image
from eigengs_dr.codec.packing import pack
from eigengs_dr.fitting.fit import fit
from eigengs_dr.gaussian.channels import usual_space
from eigengs_dr.image.color import rendered_as
from eigengs_dr.image.folder import image_files
from eigengs_dr.image.io import load_image, to_8bit
from eigengs_dr.image.metrics import psnr

FILE = "materials.jsonl"
SHARED, SEPARATE = "shared shapes", "a set for each map"
BUDGET = 0.5  # decibels that packing may lose

Maps = dict[str, Image]


def run(task: Task, folders: Sequence[Path], counts: Sequence[int]) -> list[Row]:
    """Measure each material, a folder of images with the names of its maps."""
    jobs = [job for folder in folders for job in _jobs(task, folder, counts)]
    return task.measure(FILE, jobs, "materials")


def _jobs(task: Task, folder: Path, counts: Sequence[int]) -> Iterator[Job]:
    maps = _load(folder)
    values = sum(image.size for image in maps.values())
    about = {"material": folder.name, "maps": list(maps), "values": values}
    fits = {"iterations": task.iterations, "budget": BUDGET}
    for name, (side, code) in codecs().items():
        yield {**about, "method": name}, partial(_blocks, maps, side, code)
    yield {**about, "method": "PNG"}, partial(_png, maps)
    for count in counts:
        label = {**about, **fits, "gaussians": count}
        yield {**label, "method": SHARED}, partial(_fit, task, maps, count)
        for name, image in maps.items():
            one = {**label, "method": SEPARATE, "map": name}
            yield one, partial(_fit, task, {name: image}, count)


def _load(folder: Path) -> Maps:
    """Read the images of a folder; grey data keep one channel."""
    found = {}
    for path in image_files(folder):
        data = rendered_as(usual_space(path.stem)) is None
        image = np.asarray(load_image(path, data))
        same = data and image.shape[2] == 3 and (image == image[..., :1]).all()
        found[path.stem] = image[..., :1] if same else image
    return found


def _fit(task: Task, maps: Maps, count: int) -> Row:
    fitted = fit(maps, count, task.iterations, backend=task.backend)
    with TemporaryDirectory() as folder:
        plain, packed = Path(folder) / "m.npz", Path(folder) / "m.egs"
        fitted.save(plain)
        receipt = pack(fitted, packed, maps, BUDGET)
        size = plain.stat().st_size
    return {
        "bytes": receipt.bytes,
        "psnr": receipt.psnr,
        "npz_bytes": size,
        "npz_psnr": {name: psnr(image, fitted.image[name]) for name, image in maps.items()},
        "seconds": fitted.seconds,
    }


def _blocks(maps: Maps, side: int, code: Any) -> Row:
    found = {name: coded(image, side, code) for name, image in maps.items()}
    return {
        "bytes": sum(size for size, _ in found.values()),
        "psnr": {name: psnr(maps[name], shown) for name, (_, shown) in found.items()},
    }


def _png(maps: Maps) -> Row:
    size = 0
    for image in maps.values():
        pixels, file = to_8bit(image).astype(np.uint8), io.BytesIO()
        pillow.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels).save(file, "PNG")
        size += len(file.getvalue())
    return {"bytes": size, "psnr": dict.fromkeys(maps, 100.0)}
