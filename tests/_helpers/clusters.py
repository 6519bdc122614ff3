"""Placements that act on workers, which import this module by its name, and pictures for them."""

import os
import resource
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

import eigengs_dr as eg

from .command import smooth_pixels

QUICK = {"gaussians": 20, "iterations": 2}
"""Options of a fit that takes milliseconds."""


def folder_of_photos(folder, count, width=32, height=24):
    """Write different pictures of one size, and return the folder."""
    folder.mkdir()
    for number in range(count):
        pixels = np.roll(smooth_pixels(width, height), 3 * number, axis=1)
        Image.fromarray(pixels).save(folder / f"{number:02d}.png")
    return folder


def files_of(folder):
    """The bytes of the arrays of every result, by name."""
    contents = {}
    for path in sorted(Path(folder).glob("[!.]*.npz")):
        with np.load(path) as arrays:
            contents[path.name] = {key: arrays[key].tobytes() for key in arrays}
    return contents


@dataclass(frozen=True)
class FirstCall:
    """A placement that begins by a call, with a path, in the process that fits."""

    function: Callable
    path: Path | None = None
    has_colors = False

    def __call__(self, objective, count, cutoff, seed):
        self.function(self.path)
        return eg.DEFAULT.place(objective, count, cutoff, seed)


def die(path):
    os.kill(os.getpid(), signal.SIGKILL)


class Deadly(np.ndarray):
    """An image that ends every process that it is sent to."""

    def __reduce__(self):
        return die, (None,)


def fill_disk(mark):
    """Let this process write no more than some bytes to a file, at the first try alone."""
    size = resource.RLIM_INFINITY if mark.exists() else 100
    mark.touch()
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def note_task(path):
    """Write down what a task has of its process."""
    import drjit as dr
    from distributed import get_worker
    from threadpoolctl import threadpool_info

    watched = threading.get_ident() in get_worker().active_threads
    blas = max(pool["num_threads"] for pool in threadpool_info())
    path.write_text(f"{dr.thread_count()} thread of Dr.Jit, {blas} of BLAS, watched: {watched}")


class Witness:
    """A value that writes down whether it was freed by the thread that made it."""

    def __init__(self, path):
        self.path, self.thread = path, threading.get_ident()

    def __del__(self):
        same = threading.get_ident() == self.thread
        self.path.write_text(f"by {'the thread of the task' if same else 'another thread'}")


def fail_with(path):
    """Fail while a variable, and one of the cause, hold something."""
    witness = Witness(path)
    try:
        int("a")
    except ValueError as error:
        raise RuntimeError("failed on purpose") from error
    return witness


def worker_state(dask_worker):
    """What belongs to this worker, and to its process."""
    import dask
    import drjit as dr
    from threadpoolctl import threadpool_info

    memory = dask_worker.memory_manager
    return {
        "threads": dr.thread_count(),
        "blas": {pool["num_threads"] for pool in threadpool_info()},
        "interrupt": signal.getsignal(signal.SIGINT),
        "plugins": sorted(dask_worker.plugins),
        "config": repr(dask.config.config),
        "limits": [
            memory.memory_limit,
            memory.memory_pause_fraction,
            memory.memory_spill_fraction,
            memory.memory_target_fraction,
        ],
    }


def held_types(dask_worker):
    """Types of what Dask holds on this worker."""
    return {type(value).__name__ for value in dask_worker.data.values()}


def claim_version(folder, name, version):
    """Let this process say that a package has another version."""
    from distributed import versions

    metadata = Path(folder) / f"{name}-{version}.dist-info" / "METADATA"
    metadata.parent.mkdir(exist_ok=True)
    metadata.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    sys.path.insert(0, folder)
    versions._version_cached.cache_clear()


def leave_version(folder):
    from distributed import versions

    sys.path.remove(folder)
    versions._version_cached.cache_clear()
