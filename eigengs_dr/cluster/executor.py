"""Dask: a client from words, the executor of a client, and what a worker needs.

Tasks are drawn as workers become free. Before its first task a worker needs threads, a GPU and
memory of its own: Dr.Jit's pool ignores OMP variables and takes every core, so two workers would
use each core twice.
"""

from __future__ import annotations

import ctypes
import logging
import os
import re
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import dask
from distributed import CancelledError, Client, Future, LocalCluster, Worker, WorkerPlugin, wait
from distributed.scheduler import KilledWorker
from threadpoolctl import threadpool_limits

from .. import __version__
from ..backend.executor import ClusterError, Done, Function
from ..backend.feedback import defer_interrupts, terminate_as_interrupt

CONNECT_SECONDS = 30.0
"""Time for the scheduler to answer."""

PATIENCE = {"distributed.deploy.lost-worker-timeout": "52w"}
"""Setting of Dask for workers of this machine. After that time, 15 s by default, from any end of a
worker, Dask looks whether the worker is there. If it starts slowly, or has just ended once more,
Dask ends the nanny that is about to restart it, and the cluster stays smaller for ever."""

LARGE_TASKS = {"distributed.admin.large-graph-warning-threshold": "1GiB"}
"""Setting of Dask: tasks hold images, and Dask warns of large tasks."""


@contextmanager
def connect(cluster: str) -> Iterator[Client]:
    """Connect to a cluster during a block.

    Parameters
    ----------
    cluster : str
        ``local`` or ``local:N``: N processes of one thread on this machine, by default one for each
        core. ``tcp://HOST:PORT``: the address of a scheduler. Else the file of a scheduler, which
        ``dask scheduler --scheduler-file FILE`` writes.

    Yields
    ------
    distributed.Client
        It is closed after the block; so are the workers of ``local``.

    Raises
    ------
    ClusterError
        If the scheduler does not answer.
    ValueError
        If the word is none of these.
    KeyboardInterrupt
        After Ctrl-C or SIGTERM while the workers start.
    """
    # The lines that Dask writes about lost connections come on top of ours.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if match := re.fullmatch(r"local(?::([1-9]\d*))?", cluster):
            with defer_interrupts() as interrupted:  # Dask does not end what begins to start
                workers = local_cluster(int(match[1] or 0) or dask.system.CPU_COUNT)
                client = stack.enter_context(Client(stack.enter_context(workers)))
            if interrupted():
                raise KeyboardInterrupt
        else:
            is_address = "://" in cluster
            if not is_address and not Path(cluster).is_file():
                raise ValueError(
                    f"cluster {cluster!r} is unknown; use local, local:N, tcp://HOST:PORT, or the "
                    "file of a scheduler"
                )
            place = {"address" if is_address else "scheduler_file": cluster}
            try:
                client = stack.enter_context(Client(**place, timeout=CONNECT_SECONDS))
            except OSError as error:
                raise ClusterError(f"{cluster}: no scheduler answers; start it first") from error
        yield client


def local_cluster(workers: int, **settings: object) -> LocalCluster:
    """Start worker processes of one thread on this machine.

    Parameters
    ----------
    workers : int
        Number of processes. They are spawned, never forked: Dr.Jit's threads do not survive that.
    settings : object
        More arguments of `distributed.LocalCluster`.
    """
    options = {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL, **settings}
    return LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, **options)


AHEAD = 2
"""Tasks under way for each worker: one that runs, and one that waits there."""

NO_WORKER_SECONDS = 60.0
"""Time without any worker after which a run ends. A nanny restarts a worker in some seconds."""


class ClusterExecutor:
    """The `eigengs_dr.backend.executor.Executor` of a Dask client.

    Parameters
    ----------
    client : distributed.Client
        Its workers are set up by `eigengs_dr.cluster.executor.WorkerSetup`.

    Attributes
    ----------
    workers : int
        Number of workers when the executor was made, at least 1.

    Raises
    ------
    ClusterError
        If no worker comes within `NO_WORKER_SECONDS`, or a worker has other versions.
    """

    def __init__(self, client: Client) -> None:
        address = client.scheduler.address if client.scheduler else "?"
        self._gone = (
            f"the scheduler {address} is gone; start it, and the same call continues the run"
        )
        self.client, local = client, type(client.cluster).__name__ == "LocalCluster"
        self._settings = LARGE_TASKS | (PATIENCE if local else {})
        try:
            client.wait_for_workers(1, timeout=NO_WORKER_SECONDS)
        except TimeoutError:
            raise ClusterError(f"the scheduler {address} has no workers; start some") from None
        except Exception as error:
            raise ClusterError(self._gone) from error
        try:
            client.register_plugin(WorkerSetup(local, versions()))
        except ModuleNotFoundError as error:
            raise ClusterError(
                f"the workers have no {error.name}; install eigengs-dr {__version__} there"
            ) from None
        self.workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))

    def map(
        self, function: Function, tasks: Iterable[Any], shared: Any = None
    ) -> Generator[Done, None, None]:
        """Call ``function(task, shared)`` for every task; see `Executor.map`.

        A worker that ends takes all of its tasks with it. So tasks that Dask gives up are tried
        again at the end, one at a time; a task is lost for its own fault only.
        """
        suspects: deque[Any] = deque()
        with dask.config.set(self._settings), terminate_as_interrupt():
            # A task, not `scatter`: the scheduler repeats it if the workers that hold it are lost.
            constant = self.client.submit(_identity, shared, pure=False)
            with closing(self._run(function, tasks, constant, AHEAD * self.workers)) as ended:
                for done in ended:
                    if done.lost:  # perhaps by the fault of another task of that worker
                        suspects.append(done.task)
                    else:
                        yield done
            with closing(self._run(function, suspects, constant, 1)) as ended:
                yield from ended

    def _run(
        self, function: Function, tasks: Iterable[Any], constant: Future, most: int
    ) -> Generator[Done, None, None]:
        """Run tasks, `most` of them at once."""
        under_way: dict[Future, Any] = {}
        waiting = iter(tasks)
        try:
            while True:
                for task in islice(waiting, most - len(under_way)):
                    under_way[self.client.submit(function, task, constant, pure=False)] = task
                if not under_way:
                    return
                for future in self._ended(under_way):
                    yield self._done(under_way.pop(future), future)
                    future.release()
        finally:
            if under_way and self.client.status == "running":
                self.client.cancel(list(under_way))

    def _ended(self, futures: Iterable[Future]) -> Iterable[Future]:
        """Wait for the end of a task, as long as the cluster is there."""
        while True:
            try:
                ended: Iterable[Future] = wait(
                    list(futures), timeout=NO_WORKER_SECONDS, return_when="FIRST_COMPLETED"
                ).done
                return ended
            except CancelledError as error:
                raise ClusterError(self._gone) from error
            except TimeoutError:
                pass
            try:
                self.client.wait_for_workers(1, timeout=NO_WORKER_SECONDS)
            except TimeoutError:
                raise ClusterError(
                    "no worker is left; start some, and the same call continues the run"
                ) from None

    def _done(self, task: Any, future: Future) -> Done:
        """Return what became of a task; one whose worker ended with the result runs again."""
        try:
            return Done(task, future.result())
        except CancelledError as error:
            raise ClusterError(self._gone) from error
        except KilledWorker:
            times = dask.config.get("distributed.scheduler.allowed-failures") + 1
            reason = f"its worker ended {times} times during the work"
            return Done(task, None, f"{reason}; it may need more memory than a worker has")


def _identity(value: Any) -> Any:
    return value


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's ``mallopt``."""


class WorkerSetup(WorkerPlugin):
    """Set up a worker process for this package.

    Parameters
    ----------
    local : bool
        Whether the workers run on the machine of the client, and end with it. They then leave
        Ctrl-C to the client.
    wanted : dict of str to str
        The versions of the client, from `versions`.
    """

    name = "eigengs-dr"

    def __init__(self, local: bool, wanted: dict[str, str]) -> None:
        self.local, self.wanted = local, wanted

    def setup(self, worker: Worker) -> None:
        """Set the process up; Dask calls this function once in every worker."""
        here = versions()
        for name, wanted in self.wanted.items():
            if here[name] != wanted:
                raise ClusterError(
                    f"worker {worker.address} has {name} {here[name]}, but this process has "
                    f"{wanted}; install equal versions"
                )
        if self.local and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all processes
        choose_gpu(worker.name)
        import drjit as dr  # it looks for GPUs

        # Dr.Jit keeps memory for reuse, so a worker that Dask pauses at 80 % would never go on.
        worker.memory_manager.memory_pause_fraction = False
        worker.memory_manager.memory_spill_fraction = False
        worker.memory_manager.memory_target_fraction = False
        threadpool_limits(worker.state.nthreads)
        if dr.has_backend(dr.JitBackend.LLVM):
            dr.set_thread_count(worker.state.nthreads)
        keep_freed_memory()


def versions() -> dict[str, str]:
    """Return the versions that must be equal everywhere, for equal bits."""
    return {"eigengs_dr": __version__, "drjit": version("drjit"), "numpy": version("numpy")}


def keep_freed_memory() -> None:
    """Let the C library reuse freed memory, where it is glibc.

    Dask starts workers with ``MALLOC_TRIM_THRESHOLD_=65536``. Every large array then gets new pages
    from the kernel, and a fit of 256x256 pixels takes a tenth longer.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, 1 << 25)
        mallopt(M_TRIM_THRESHOLD, 1 << 27)


def choose_gpu(name: Any) -> None:
    """Give each worker of a machine one of its GPUs, unless CUDA_VISIBLE_DEVICES is set.

    Parameters
    ----------
    name : Any
        Name of the worker. Workers of a `distributed.LocalCluster` are called 0, 1, 2.
    """
    count = len(list(Path("/proc/driver/nvidia/gpus").glob("*")))
    if count > 1 and isinstance(name, int):
        os.environ.setdefault("CUDA_VISIBLE_DEVICES", str(name % count))
