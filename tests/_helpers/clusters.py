"""Tasks for workers, which import this module by its name, and pictures for them."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
from PIL import Image

try:
    from distributed import WorkerPlugin
except ImportError:
    WorkerPlugin = object

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
    found = {}
    for path in sorted(Path(folder).glob("*.npz")):
        with np.load(path) as arrays:
            found[path.name] = {key: arrays[key].tobytes() for key in arrays}
    return found


def add(task, shared):
    """A task that needs nothing."""
    return task + shared


def process_of(task, shared):
    return os.getpid()


def fail(task, shared):
    raise ValueError(f"task {task}")


def die_once(task, shared):
    """End the process at the first try of one task; `shared` names a folder."""
    mark = Path(shared) / "died"
    if task == 1 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return task


def state(task=None, shared=None):
    """What belongs to this process: as a task, what it is meanwhile."""
    import multiprocessing

    import drjit as dr
    from threadpoolctl import threadpool_info

    return {
        "threads": dr.thread_count(),
        "blas": {pool["num_threads"] for pool in threadpool_info()},
        "interrupt": signal.getsignal(signal.SIGINT) == signal.SIG_IGN,
        "start": multiprocessing.get_start_method(),
        "malloc": os.environ.get("MALLOC_TRIM_THRESHOLD_"),
        "gpus": os.environ.get("CUDA_VISIBLE_DEVICES"),
    }


def worker_state(dask_worker):
    """What belongs to this worker, and to its process."""
    import dask

    memory = dask_worker.memory_manager
    return state() | {
        "plugins": sorted(dask_worker.plugins),
        "config": repr(dask.config.config),
        "pause": memory.memory_pause_fraction,
        "spill": memory.memory_spill_fraction,
        "target": memory.memory_target_fraction,
        "limit": memory.memory_limit,
    }


def held_types(dask_worker):
    """Types of what Dask holds on this worker."""
    return {type(value).__name__ for value in dask_worker.data.values()}


class Traveller:
    """A value that notes where it was pickled: processes, and whether in their main threads."""

    def __init__(self, *places):
        self.places = places

    def __reduce__(self):
        here = os.getpid(), threading.current_thread() is threading.main_thread()
        return Traveller, (*self.places, here)


def is_watched(task, shared):
    """Whether Dask's profiler takes the frames of this task."""
    from distributed import get_worker

    return threading.get_ident() in get_worker().active_threads


def travel(task, shared):
    return shared


class Witness:
    """A value that writes down whether it was freed in the main thread."""

    def __init__(self, path):
        self.path = path

    def __del__(self):
        Path(self.path).write_text(str(threading.current_thread() is threading.main_thread()))


def fail_with(task, shared):
    """Fail while a variable, and one of the cause, hold something."""
    witness = Witness(shared)
    try:
        int(task)
    except ValueError as error:
        raise OSError(f"task {task}") from error
    return witness


def replace_package(package):
    """Let this process have another package of this name, or none."""
    sys.kept_package, sys.modules["eigengs_dr"] = sys.modules["eigengs_dr"], package


def restore_package():
    sys.modules["eigengs_dr"] = sys.kept_package


def patch_write(replacement):
    """Replace the function that writes results, in this process."""
    from eigengs_dr.gaussian.file import write_set
    from eigengs_dr.many import run

    run.write_set = lambda *arguments: replacement(write_set, *arguments)


def mend_writes():
    """Write results again, in this process."""
    from eigengs_dr.gaussian.file import write_set
    from eigengs_dr.many import run

    run.write_set = write_set


def slow_writes():
    """Let every write of a result take long, in this process."""

    def slow(write_set, *arguments):
        time.sleep(0.5)
        write_set(*arguments)

    patch_write(slow)


class DieInWrite(WorkerPlugin):
    """Let a worker end while it writes one result, with half a file."""

    def __init__(self, name):
        self.file = name

    def setup(self, worker):
        def die(write_set, path, *arguments):
            if path.name == self.file:
                path.with_name(".eigengs_dr-0123456789abcdef.npz").write_bytes(b"half")
                os.kill(os.getpid(), signal.SIGKILL)
            write_set(path, *arguments)

        patch_write(die)


class Here:
    """An executor that runs tasks in this process, in an order as bad as a cluster's."""

    workers = 2

    def __init__(self, lost=()):
        self.lost = set(lost)
        self.tasks = []

    @property
    def names(self):
        """Names of the images of each task."""
        return [[source.name for source in task] for task in self.tasks]

    def map(self, function, tasks, shared=None):
        from eigengs_dr.backend.executor import Done

        for task in reversed(list(tasks)):
            self.tasks.append(task)
            if self.lost and self.lost & set(self.names[-1]):
                yield Done(task, None, "its worker ended 2 times")
            else:
                yield Done(task, function(task, shared))
