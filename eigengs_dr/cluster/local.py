"""Workers on this machine that a run starts for itself, with the settings that Dr.Jit needs.

Dask loads this module in the workers before their first task.
"""

from __future__ import annotations

import logging
import os
import signal
from pathlib import Path

import dask
from distributed import LocalCluster, Worker

MALLOC_SETTING = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 27,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}
"""Dask setting that makes glibc reuse freed memory. Dask's value of the first variable is 64 KiB.
Every large array then gets new pages from the kernel, and a fit of 256x256 pixels takes a tenth
longer."""


def local_cluster(workers: int, **settings: object) -> LocalCluster:
    """Start single-threaded worker processes on this machine.

    Parameters
    ----------
    workers : int
        Number of processes. They are spawned, never forked, because Dr.Jit's threads do not survive
        a fork.
    settings : object
        Further arguments of `distributed.LocalCluster`.
    """
    preload = [*dask.config.get("distributed.worker.preload"), __name__]
    options = {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL, **settings}
    options |= {"n_workers": workers, "threads_per_worker": 1, "processes": True}
    with dask.config.set(MALLOC_SETTING):
        return LocalCluster(preload=preload, **options)


def dask_setup(worker: Worker) -> None:
    """Set up the process of a worker; Dask calls this function before the first task."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all processes
    gpus = len(list(Path("/proc/driver/nvidia/gpus").glob("*")))
    if gpus > 1 and isinstance(worker.name, int):  # as the workers of a `LocalCluster` are named
        os.environ.setdefault("CUDA_VISIBLE_DEVICES", str(worker.name % gpus))
    # Dr.Jit keeps memory for reuse during a task, so neither pausing nor spilling to disk helps. At
    # 95 % of its limit a worker is restarted. A configuration would not reach the new process.
    worker.memory_manager.memory_pause_fraction = False
    worker.memory_manager.memory_spill_fraction = False
    worker.memory_manager.memory_target_fraction = False
