"""The alternatives on a laptop: a package of Gaussians, codecs, and a smaller bitmap.

A row has the figures of `judge` for a picture, the "seconds" it took, the "bytes" of its file,
"memory", the bytes of the parameters that a renderer reads, and "number" of Gaussians or texels.
The seconds count where the job is "timed": nothing else ran on the machine.

A package that fits Gaussians has its own virtual environment in the folder of the rows, and draws
its own picture.
"""

import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from venv import EnvBuilder

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image as pillow

import eigengs_dr as eg
from eigengs_bench import report as fr
from eigengs_bench.clock import Image, judge
from eigengs_bench.images import images_of
from eigengs_bench.names import PEERS
from eigengs_bench.rate import CODECS, WARM_UP, fit_and_pack
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.image.io import save_image, to_8bit

OURS, PACKED, TEXELS = "eigengs_dr", "eigengs_dr, packed", "texels"
# With the build of PyTorch that it was measured with.
REQUIREMENTS = ("splatthis==0.3.2", "torch==2.13.0")
# A third of the steps, and all steps, of its default profile, which is also its most costly one.
SPLATTHIS = {"170 steps": "70,50,33,17", "500 steps": "200,150,100,50"}
CODED = {"JPEG": ("JPEG 4:2:0", "JPEG 4:4:4"), "AVIF": ("AVIF 4:4:4",)}
BETTER = {
    "splatthis": "writes SVG, CSS and PowerPoint",
    "JPEG": "any program shows it; takes milliseconds",
    "AVIF": "fewer bytes at equal PSNR, in the mean of Kodak",
    "texels": "higher MS-SSIM at equal memory; quick lookups; no fit",
}


def run(
    task: Task,
    names: Sequence[str],
    peers: Sequence[str],
    photos: Sequence[str],
    gaussians: int,
    timed: bool,
) -> list[Row]:
    """Measure images of sets, all or some by name, with this package and with the peers."""
    shared: Row = {"gaussians": gaussians, "timed": timed}
    jobs = (
        ({"set": name, "image": photo, **shared, **label}, work)
        for name in names
        for photo, image in images_of(task, name, sys.maxsize if photos else None)
        if not photos or photo in photos
        for label, work in _jobs(task, image, gaussians, peers or PEERS)
    )
    return task.measure("peers", list(jobs))


def _jobs(task: Task, image: Image, count: int, peers: Sequence[str]) -> Iterator[Job]:
    packed = cache(partial(_packed, task, image, count))
    for steps in sorted({min(100, task.iterations), task.iterations}):
        work = partial(_fit, task, image, count, steps)
        yield {"peer": OURS, "setting": f"{steps:,} steps"}, work
    yield {"peer": PACKED, "setting": f"{task.iterations:,} steps"}, packed
    if "splatthis" in peers:
        for setting, stages in SPLATTHIS.items():
            work = partial(_splatthis, task.folder / "peers", image, count, stages)
            yield {"peer": "splatthis", "setting": setting}, work
    if TEXELS in peers:
        yield {"peer": TEXELS, "setting": "equal memory"}, partial(_texels, image, count)
    for title in (title for peer in peers for title in CODED.get(peer, ())):
        work = partial(_coded_as_small, packed, image, title)
        yield {"peer": title, "setting": "equal bytes"}, work


# ---------------------------------------------------------------------------------------------
#  This package
# ---------------------------------------------------------------------------------------------


def memory_of(count: int) -> int:
    """Return the bytes of a set of three channels: mean, factor and colour, and a background."""
    return 4 * (8 * count + 3)


def _fit(task: Task, image: Image, count: int, steps: int) -> Row:
    fit = partial(eg.fit, image, count, backend=task.backend)
    fit(iterations=min(WARM_UP, steps))
    result = fit(iterations=steps)
    memory = {"memory": memory_of(count), "number": count}
    return {"seconds": result.seconds, **memory, **judge(result.image, image)}


def _packed(task: Task, image: Image, count: int) -> Row:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "fit.egs"
        size, seconds = fit_and_pack(task, image, count, path)
        picture = eg.picture_of(eg.Gaussians.load(path, task.backend))
    return {"seconds": seconds, "bytes": size, "number": count, **judge(picture, image)}


# ---------------------------------------------------------------------------------------------
#  The peers
# ---------------------------------------------------------------------------------------------


def environment(folder: Path, requirements: Sequence[str]) -> Path:
    """Make a virtual environment with some packages, if it is missing; return its programs.

    `ValueError` with the last line of pip if a package cannot be installed.
    """
    programs, done = folder / ("Scripts" if os.name == "nt" else "bin"), folder / "packages.txt"
    listed = "\n".join(requirements)
    if not done.exists() or done.read_text() != listed:
        EnvBuilder(clear=True, with_pip=True).create(folder)
        python = str(programs / "python")
        command = [python, "-m", "pip", "install", "--quiet", *requirements]
        process = subprocess.run(command, capture_output=True, text=True, check=False)
        if process.returncode:
            words = (process.stderr.strip() or "pip failed").splitlines()[-1]
            raise ValueError(f"{folder}: {' '.join(requirements)} cannot be installed: {words}")
        done.write_text(listed)
    return programs


def _pixels(file: Path | io.BytesIO) -> Image:
    """Decode an 8-bit picture."""
    return np.asarray(pillow.open(file).convert("RGB")).astype(np.float32) / np.float32(255)


def _splatthis(folder: Path, image: Image, count: int, stages: str) -> Row:
    """Fit with splatthis, which measures its own seconds, without its imports."""
    program = environment(folder / "splatthis", REQUIREMENTS) / "splatthis"
    with TemporaryDirectory() as place:
        here = Path(place)
        source, drawing, preview = here / "image.png", here / "fit.svg", here / "preview.png"
        save_image(source, image)
        settings = ["--splats", count, "--stages", stages, "--artifacts-dir", here / "log"]
        words = [program, source, "-o", drawing, "--preview", preview, *settings]
        command = [str(word) for word in words]
        process = subprocess.run(command, capture_output=True, text=True, check=False)
        if process.returncode:
            raise ValueError(f"splatthis failed: {(process.stderr or '?').splitlines()[-1]}")
        log = json.loads((here / "log" / "run_manifest.json").read_text())
        picture = _pixels(preview)
        size = drawing.stat().st_size
    figures = {"seconds": log["total_time_sec"], "number": log["final_splat_count"], "bytes": size}
    # What its optimiser sees, before the splats are drawn as SVG.
    figures["own_psnr_rgb"] = log["final_metrics"]["psnr_srgb"]
    return {**figures, "requirements": list(REQUIREMENTS), **judge(picture, image)}


def _texels(image: Image, count: int) -> Row:
    """Fit an 8-bit bitmap that, with its pyramid, takes no more memory than a set.

    The texels are the least-squares solution under bilinear lookups, so no bitmap of this size is
    closer, but for rounding.
    """
    started = time.perf_counter()
    height, width = image.shape[:2]
    share = min(
        1.0, memory_of(count) / (4 * height * width)
    )  # 3 bytes, and a third for the pyramid
    rows, columns = (max(1, int(side * share**0.5)) for side in (height, width))
    up, across = bilinear(height, rows), bilinear(width, columns)
    inverse = np.linalg.pinv(up), np.linalg.pinv(across)
    texels = np.einsum("ry,yxc,kx->rkc", inverse[0], image, inverse[1], optimize=True)
    texels = np.round(255 * np.clip(texels, 0, 1)) / 255
    seconds = time.perf_counter() - started
    picture = np.einsum("yr,rkc,xk->yxc", up, texels, across, optimize=True).astype(np.float32)
    memory = {"memory": 4 * rows * columns, "number": rows * columns}
    return {"seconds": seconds, **memory, **judge(picture, image)}


def bilinear(size: int, count: int) -> NDArray[np.float64]:
    """Return the weights of texels at pixel centres along a side, shape (size, count)."""
    at = (np.arange(size) + 0.5) * count / size - 0.5
    first = np.floor(at)
    weights = np.zeros((size, count))
    for texel, weight in ((first, 1 - (at - first)), (first + 1, at - first)):
        np.add.at(weights, (np.arange(size), np.clip(texel, 0, count - 1).astype(int)), weight)
    return weights


def _coded_as_small(packed: Callable[[], Row], image: Image, title: str) -> Row:
    """Encode at the best quality whose file is no larger than that of a packed fit."""
    size = packed()["bytes"]
    source, codec = pillow.fromarray(to_8bit(image).astype(np.uint8)), CODECS[title]

    def encoded(quality: int) -> bytes:
        file = io.BytesIO()
        source.save(file, codec.kind, **codec.set_to(quality))
        return file.getvalue()

    low, high = 0, 100  # files of `low` fit, but for the worst quality, which counts as it is
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if len(encoded(middle)) <= size else (low, middle)
    started = time.perf_counter()
    content = encoded(low)
    seconds = time.perf_counter() - started
    picture = _pixels(io.BytesIO(content))
    return {"seconds": seconds, "bytes": len(content), "quality": low, **judge(picture, image)}


# ---------------------------------------------------------------------------------------------
#  Tables
# ---------------------------------------------------------------------------------------------


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out what each peer reaches, a table per set, what it does better, and those on a GPU."""
    points, tables = fr.frame_of(rows), []
    for name, part in points.groupby("set", sort=False):
        tables.append(_table(str(name), part))
    better = fr.table("What a peer does better", ("peer", "better"), BETTER.items(), "better")
    published = pd.read_csv(str(files("eigengs_bench") / "published_peers.csv"), dtype=str)
    gpu = fr.Table("Packages that need a CUDA GPU, by what they publish", published, "published")
    return fr.Section([*tables, better._replace(rows=()), gpu._replace(rows=())])


def _table(name: str, points: pd.DataFrame) -> fr.Table:
    cells: dict[str, tuple[str, Callable[[pd.Series], str]]] = {
        "parts": ("number", partial(_mean, decimals=0)),
        "s": ("seconds", partial(fr.median, decimals=3)),
        "bytes of file": ("bytes", partial(_mean, decimals=0)),
        "bytes in memory": ("memory", partial(_mean, decimals=0)),
        "psnr_rgb": ("psnr_rgb", _mean),
        "as it says": ("own_psnr_rgb", _mean),
        "psnr_ycbcr": ("psnr_ycbcr", _mean),
        "MS-SSIM": ("ms_ssim", partial(_mean, decimals=3)),
    }
    points = points.reindex(columns=[*points, *{key for key, _ in cells.values()} - {*points}])
    points["seconds"] = points.seconds.where(points.timed)
    timed = points[points.timed]  # instead of those of the same name that are not
    lines = pd.concat([timed, points[~points.timed]]).drop_duplicates(["image", "peer", "setting"])
    caption = (
        f"{name}, {fr.counted(points.image)}, {points.gaussians.iloc[0]:,} Gaussians and their "
        "alternatives; parts are Gaussians or texels; codecs have the bytes of the packed set, "
        "texels with their pyramid its memory"
    )
    return fr.grouped(caption, lines, ["peer", "setting"], cells)._replace(name=name)


def _mean(values: pd.Series, decimals: int = 1) -> str:
    """Write a mean; `MISSING` if a peer has no such figure."""
    return fr.number(values.mean(), decimals)
