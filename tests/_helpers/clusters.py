"""Tasks for workers, which import this module by its name, and pictures for them."""

import os
import signal
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


def state():
    """What a worker was set up with."""
    import multiprocessing

    import drjit as dr
    from threadpoolctl import threadpool_info

    return {
        "threads": dr.thread_count(),
        "blas": {pool["num_threads"] for pool in threadpool_info()},
        "interrupt": signal.getsignal(signal.SIGINT) == signal.SIG_IGN,
        "start": multiprocessing.get_start_method(),
    }


def patch_write(replacement):
    """Replace the function that writes results, in this process."""
    from eigengs_dr.collection import run
    from eigengs_dr.gaussian.file import write

    run.write = lambda *arguments: replacement(write, *arguments)


def mend_writes():
    """Write results again, in this process."""
    from eigengs_dr.collection import run
    from eigengs_dr.gaussian.file import write

    run.write = write


def slow_writes():
    """Let every write of a result take long, in this process."""

    def slow(write, *arguments):
        time.sleep(0.5)
        write(*arguments)

    patch_write(slow)


class DieInWrite(WorkerPlugin):
    """Let a worker end while it writes one result, with half a file."""

    def __init__(self, name):
        self.file = name

    def setup(self, worker):
        def die(write, path, *arguments):
            if path.name == self.file:
                path.with_name(".eigengs_dr-0123456789abcdef.npz").write_bytes(b"half")
                os.kill(os.getpid(), signal.SIGKILL)
            write(path, *arguments)

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
