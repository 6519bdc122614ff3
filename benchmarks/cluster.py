"""Times of a cluster on this machine, one part a call: ``python benchmarks/cluster.py fits``.

- ``fits``: images a second one by one, in one process, and on two workers of one thread
- ``overhead``: one worker of one thread against one process of one thread
- ``tasks``: seconds of a task that does nothing, by the bytes that it takes and returns
- ``pca``: the eigenbasis of crops on one worker and on two, with the memory of each; of the images
  in a folder with ``--images``
- ``weights``: a model of 20,000 Gaussians, and that many components of 512x512, here and by workers

Each part prints JSON. Compile the kernels by a first run, and take the median of several.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import eigengs_dr as eg
from eigengs_dr.backend.executor import executor_for
from eigengs_dr.backend.selection import select
from eigengs_dr.cluster.executor import connect, limit_threads

PHOTOS = ("coffee", "astronaut", "chelsea", "rocket")
FIT = {"gaussians": 5000, "iterations": 100, "backend": "llvm"}


def crops(folder: Path, count: int, side: int = 256) -> list[Path]:
    """Write crops of photos as JPEG files."""
    random, files = np.random.default_rng(0), []
    photos = [eg.sample(name) for name in PHOTOS]
    for number in range(count):
        photo = photos[number % len(photos)]
        y, x = (random.integers(0, n - side + 1) for n in photo.shape[:2])
        files.append(folder / f"{number:06d}.jpg")
        eg.save_image(files[-1], photo[y : y + side, x : x + side])
    return files


def timed(run: Any) -> float:
    """Return the seconds of a call."""
    started = time.perf_counter()
    run()
    return time.perf_counter() - started


def fits(folder: Path, count: int) -> dict[str, float]:
    """Measure images a second; workers are started before."""
    files = crops(folder, count)
    select("llvm")
    eg.fit_many(files[:8], folder / "warm", **FIT)

    def one_by_one() -> None:
        for path in files:
            result = eg.fit(eg.load_image(path), **FIT)
            result.gaussians.save(folder / f"{path.stem}.npz")

    rates = {"one by one": count / timed(one_by_one)}
    rates["fit_many"] = count / timed(lambda: eg.fit_many(files, folder / "here", **FIT))
    with connect("local:2") as client:
        eg.fit_many(files[:8], folder / "warm2", client=client, **FIT)
        seconds = timed(lambda: eg.fit_many(files, folder / "far", client=client, **FIT))
        rates["two workers"] = count / seconds
    return rates


def overhead(folder: Path, count: int) -> dict[str, float]:
    """Measure one worker against one process, both of one thread."""
    files = crops(folder, count)
    select("llvm")
    limit_threads(1)
    eg.fit_many(files[:8], folder / "warm", **FIT)
    here = timed(lambda: eg.fit_many(files, folder / "here", **FIT))
    with connect("local:1") as client:
        eg.fit_many(files[:8], folder / "warm2", client=client, **FIT)
        far = timed(lambda: eg.fit_many(files, folder / "far", client=client, **FIT))
    return {"one process": here, "one worker": far, "overhead": far / here - 1}


def echo(task: NDArray[Any], shared: None) -> NDArray[Any]:
    """Return the task."""
    return task


def tasks(folder: Path, count: int) -> dict[str, float]:
    """Measure milliseconds a task, for tasks of some bytes, on two workers."""
    found = {}
    with connect("local:2") as client:
        executor = executor_for(client)
        for size in (0, 10**4, 10**6, 10**7):
            number = max(10, min(count, 10**8 // (size + 1)))
            arrays = [np.zeros(size, np.uint8)] * number
            list(executor.map(echo, arrays[:10]))
            found[f"{size} bytes"] = (
                1e3 / number * timed(lambda a=arrays: list(executor.map(echo, a)))
            )
    return found


def peak() -> float:
    """Return the peak of memory of this process, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def pca(folder: Path, count: int) -> dict[str, Any]:
    """Measure an eigenbasis of 300 components on one worker and on two."""
    files = sorted(ARGUMENTS.images.iterdir())[:count] if ARGUMENTS.images else crops(folder, count)
    found: dict[str, Any] = {"images": len(files)}
    bases = []
    for workers in (1, 2):
        (states := folder / f"states{workers}").mkdir()
        options = {"checkpoint": states}
        with connect(f"local:{workers}") as client:
            executor_for(client)

            def run(client: Any = client, options: dict[str, Any] = options) -> None:
                bases.append(eg.Eigenbasis.from_images(files, client=client, **options))

            found[f"{workers} workers"] = timed(run)
            found[f"{workers} workers MB"] = list(client.run(peak).values())
        shutil.rmtree(states)
    first, second = bases
    pairs = zip(first.components, second.components, strict=True)
    found["largest difference"] = max(float(np.abs(a - b).max()) for a, b in pairs)
    return found


def weights(folder: Path, count: int) -> dict[str, float]:
    """Measure the fit of a model here, on one worker and on two."""
    random = np.random.default_rng(0)
    images = random.random((count + 1, 64, 64, 3), np.float32).repeat(8, 1).repeat(8, 2)
    basis = eg.Eigenbasis.from_images(images, (512, 512), count)
    fit = partial(eg.EigenGS.fit, basis, gaussians=20_000, frequency_aware=False)
    first = partial(eg.EigenGS.fit, basis.truncated(20), gaussians=20_000, frequency_aware=False)
    first()
    found = {"here": timed(fit)}
    for workers in (1, 2):
        with connect(f"local:{workers}") as client:
            first(client=client)
            found[f"{workers} workers"] = timed(partial(fit, client=client))
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("part")
    parser.add_argument("count", type=int, nargs="?", default=64)
    parser.add_argument("--images", type=Path)
    ARGUMENTS = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = globals()[ARGUMENTS.part](Path(folder), ARGUMENTS.count)
        print(json.dumps({ARGUMENTS.part: result, "count": ARGUMENTS.count}))
