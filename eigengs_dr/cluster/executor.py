"""Dask: connection to a cluster, and an executor that submits tasks as workers become free.

Dask copies, prints and drops the arguments and results of tasks in threads of its own. If those
were Dr.Jit arrays, these threads would use Dr.Jit at the same time as a task, and hang. So Dask
only sees bytes: the thread of the task unpickles and frees the values.

A cluster is not changed: what a task needs of its process is set for the duration of the task.
Dask loads this module in the workers of ``local`` before their first task.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import re
import signal
import threading
import traceback
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import dask
from distributed import (
    CancelledError,
    Client,
    Future,
    LocalCluster,
    Worker,
    as_completed,
    get_worker,
)
from distributed.comm import CommClosedError
from distributed.protocol.pickle import dumps, loads
from distributed.scheduler import KilledWorker
from threadpoolctl import threadpool_limits

from ..backend.interrupts import defer_interrupts, terminate_as_interrupt
from ..backend.recording import exclusive
from . import ClusterError, Done, Function, Task, Value

CONNECT_TIMEOUT = "distributed.comm.timeouts.connect"
"""Dask setting of the time limit for connecting to the scheduler, and for the first worker."""

LOCAL_SETTINGS = {
    "distributed.deploy.lost-worker-timeout": "52w",
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 27,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}
"""Dask settings for the workers of ``local``. By default, Dask closes the nanny of a worker that is
not back 15 s after it ended, and the cluster stays smaller for good. With its 64 KiB instead of the
thresholds, every large array gets new pages from the kernel, and a fit of 256x256 pixels takes a
tenth longer."""

PACKAGES = ("eigengs-dr", "drjit", "numpy")
"""Packages that determine the bits of results."""


@contextmanager
def connect(cluster: str) -> Iterator[Client]:
    """Connect to a cluster during a block, in which nothing is logged: errors take one line.

    Parameters
    ----------
    cluster : str
        ``local`` or ``local:N``: N single-threaded processes on this machine, by default one per
        core. ``tcp://HOST:PORT``: the address of a scheduler. Otherwise the file of a scheduler,
        which ``dask scheduler --scheduler-file FILE`` writes.

    Yields
    ------
    distributed.Client
        It is closed after the block, and so are the workers of ``local``.

    Raises
    ------
    ClusterError
        If the scheduler does not answer.
    ValueError
        If `cluster` is none of these.
    KeyboardInterrupt
        After Ctrl-C or SIGTERM while the workers start.
    """
    logging.disable()
    try:
        if match := re.fullmatch(r"local(?::([1-9]\d*))?", cluster):
            with dask.config.set(LOCAL_SETTINGS):
                with defer_interrupts() as interrupted:  # Dask leaves workers that are starting
                    workers = local_cluster(int(match[1] or 0) or dask.system.CPU_COUNT)
                with workers, Client(workers) as client:
                    if interrupted():
                        raise KeyboardInterrupt
                    yield client
        else:
            with _client_of(cluster) as client:
                yield client
    finally:
        logging.disable(logging.NOTSET)


def _client_of(cluster: str) -> Client:
    """Return a client of a scheduler by its address, or by its file."""
    if "://" not in cluster and not Path(cluster).is_file():
        raise ValueError(
            f"cluster {cluster!r} is unknown; use local, local:N, tcp://HOST:PORT, or the file of "
            "a scheduler"
        )
    address = cluster
    if "://" not in cluster:
        try:
            address = json.loads(Path(cluster).read_bytes())["address"]
            if not isinstance(address, str):
                raise TypeError
        except (ValueError, KeyError, TypeError, RecursionError):
            raise ValueError(
                f"cluster {cluster!r} is not the file of a scheduler, as 'dask scheduler "
                "--scheduler-file FILE' writes it"
            ) from None
    try:
        return Client(address)
    except OSError as error:
        raise ClusterError(f"{cluster}: no scheduler answers; start it first") from error


def local_cluster(workers: int) -> LocalCluster:
    """Start single-threaded worker processes on this machine.

    They are spawned, never forked, because Dr.Jit's threads do not survive a fork.
    """
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        preload=[*dask.config.get("distributed.worker.preload"), __name__],
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )


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


class ClusterExecutor:
    """The `eigengs_dr.cluster.Executor` of a Dask client.

    Parameters
    ----------
    client : distributed.Client

    Attributes
    ----------
    workers : int
        Number of workers when the executor was created, at least 1.

    Raises
    ------
    ClusterError
        If there is no worker within `CONNECT_TIMEOUT`, or one has other versions of `PACKAGES`.
    """

    def __init__(self, client: Client) -> None:
        self.client = client
        self.address = client.scheduler.address if client.scheduler else "?"
        with self._cluster_errors():
            try:
                client.wait_for_workers(1, timeout=dask.config.get(CONNECT_TIMEOUT))
            except asyncio.TimeoutError:  # since Python 3.11, TimeoutError
                raise ClusterError(
                    f"the scheduler {self.address} has no workers; start some"
                ) from None
            versions: Any = client.get_versions(packages=PACKAGES)
        for address, worker in versions["workers"].items():
            _compare(address, worker["packages"], versions["client"]["packages"])
        self.workers = max(1, len(versions["workers"]))

    def map(
        self, function: Function[Task, Value], tasks: Iterable[Task], shared: Any = None
    ) -> Generator[Done, None, None]:
        """Call ``function(task, shared)`` for every task; see `Executor.map`.

        Each worker has one task at a time, so that a worker that ends loses no other.
        """
        waiting, submitted = iter(tasks), dict[Future, Task]()
        ended = as_completed(loop=self.client.loop)
        with self._cluster_errors(), terminate_as_interrupt():
            # A task instead of `scatter`: the scheduler repeats it if its workers are lost.
            constant = self.client.submit(bytes, dumps((function, shared)), pure=False)
            try:
                while True:
                    for task in islice(waiting, self.workers - len(submitted)):
                        future = self.client.submit(_run_task, dumps(task), constant, pure=False)
                        submitted[future] = task
                        ended.add(future)
                    if not submitted:
                        return
                    future = next(ended)
                    yield _done(submitted.pop(future), future)
                    future.release()
            finally:
                if submitted and self.client.status == "running":
                    self.client.cancel(list(submitted))

    @contextmanager
    def _cluster_errors(self) -> Iterator[None]:
        """Convert errors about a lost cluster to a `ClusterError` of one line."""
        try:
            yield
        except (CancelledError, CommClosedError) as error:
            raise ClusterError(
                f"the scheduler {self.address} is gone; start it, and the same call continues the "
                "run"
            ) from error


def _compare(address: str, worker: dict[str, str | None], client: dict[str, str | None]) -> None:
    """Raise `ClusterError` if the versions of a worker are not those of the client."""
    for name in PACKAGES:
        if worker[name] != client[name]:
            raise ClusterError(
                f"worker {address} has {name} {worker[name]}, but this process has "
                f"{client[name]}; install equal versions"
            )


def _done(task: object, future: Future) -> Done:
    """Return the result of a task; waits if it runs again because its worker was lost."""
    try:
        return Done(task, loads(future.result()))
    except KilledWorker:
        times = dask.config.get("distributed.scheduler.allowed-failures") + 1
        reason = f"its worker ended {times} times during the work"
        return Done(task, None, f"{reason}; it may need more memory than a worker has")


def _run_task(task: bytes, shared: bytes) -> bytes:
    """Call the function of a run for one task, on a worker, with the worker's number of threads.

    Dr.Jit's pool ignores OMP variables and uses every core, so two workers would use each core
    twice. It keeps freed memory for reuse, so that a worker that Dask pauses because of its memory,
    by default at 80 % of its limit, would never continue.
    """
    import drjit as dr

    worker = get_worker()
    with _unprofiled(worker), exclusive(), threadpool_limits(worker.state.nthreads):
        before = dr.thread_count()
        dr.set_thread_count(worker.state.nthreads)
        try:
            function, constant = loads(shared)
            return dumps(function(loads(task), constant))
        except BaseException as error:
            _clear_frames(error)
            raise
        finally:
            dr.set_thread_count(before)
            dr.flush_malloc_cache()


def _clear_frames(error: BaseException | None) -> None:
    """Free the arrays in the frames of an error, which Dask would free in its own thread."""
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__cause__ or error.__context__


@contextmanager
def _unprofiled(worker: Worker) -> Iterator[None]:
    """Hide this thread from Dask's profiler during a block.

    The profiler accesses the frames of all tasks a hundred times per second. If a function returns
    at that moment, the profiler keeps its variables, so that Dask's thread frees Dr.Jit arrays.
    """
    thread = threading.get_ident()
    with worker.active_threads_lock:
        key = worker.active_threads.pop(thread)
    try:
        yield
    finally:
        with worker.active_threads_lock:
            worker.active_threads[thread] = key
