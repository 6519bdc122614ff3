"""Dask: a client from words, the executor of a client, and what a worker needs.

Tasks are drawn as workers become free. Before its first task a worker needs threads, a GPU, a
kernel cache and a warm backend: Dr.Jit's pool ignores OMP variables and takes every core, so two
workers would use each core twice.
"""

from __future__ import annotations

import ctypes
import getpass
import logging
import os
import queue
import re
import signal
import stat
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, LocalCluster, Worker, WorkerPlugin
from distributed.scheduler import KilledWorker

from ..backend.executor import ClusterError, Done, Function
from ..backend.feedback import defer_interrupts, terminate_as_interrupt

CONNECT_SECONDS = 30.0
"""Time for the scheduler to answer."""


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
    match = re.fullmatch(r"local(?::([1-9]\d*))?", cluster)
    if match:
        with ExitStack() as stack:
            with defer_interrupts() as interrupted:  # Dask does not end what begins to start
                count = int(match[1] or 0) or _cores()
                client = stack.enter_context(Client(stack.enter_context(local_cluster(count))))
            if interrupted():
                raise KeyboardInterrupt
            yield client
        return
    try:
        client = _client(cluster)
    except OSError as error:
        raise ClusterError(f"{cluster}: no scheduler answers; start it first") from error
    with client:
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


def _client(cluster: str) -> Client:
    if "://" in cluster:
        return Client(cluster, timeout=CONNECT_SECONDS)
    if not Path(cluster).is_file():
        raise ValueError(
            f"cluster {cluster!r} is unknown; use local, local:N, tcp://HOST:PORT, or the file of "
            "a scheduler"
        )
    return Client(scheduler_file=cluster, timeout=CONNECT_SECONDS)


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


AHEAD = 2
"""Tasks under way for each worker: one that runs, and one that waits there."""

POLL_SECONDS = 0.5
"""Time between two looks at the cluster, while no task ends."""

NO_WORKER_SECONDS = 60.0
"""Time without any worker after which a run ends. A nanny restarts a worker in some seconds."""

PATIENCE = {"distributed.deploy.lost-worker-timeout": "52w"}
"""Setting of Dask for workers of this machine. After that time, 15 s by default, from any end of a
worker, Dask looks whether the worker is there. If it starts slowly, or has just ended once more,
Dask ends the nanny that is about to restart it, and the cluster stays smaller for ever."""

Numbered = tuple[int, Any]
"""A task with its place."""

LOST = "its worker ended {times} times during the work; it may need more memory than a worker has"

GONE = "the scheduler {address} is gone; start it, and the same call continues the run"


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
        self.client = client
        address = client.scheduler.address if client.scheduler else "?"
        self._gone = GONE.format(address=address)
        try:
            client.wait_for_workers(1, timeout=NO_WORKER_SECONDS)
        except TimeoutError:
            raise ClusterError(f"the scheduler {address} has no workers; start some") from None
        except Exception as error:
            raise ClusterError(self._gone) from error
        _check_versions(client)
        self._local = is_local(client)
        client.register_plugin(WorkerSetup(local=self._local))
        self.workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))

    def map(
        self,
        function: Function,
        tasks: Iterable[Any],
        shared: Any = None,
        at_once: int | None = None,
    ) -> Generator[Done, None, None]:
        """Call ``function(task, shared)`` for every task; see `Executor.map`.

        A worker that ends takes all of its tasks with it. So tasks that Dask gives up are tried
        again at the end, one at a time; a task is lost for its own fault only.
        """
        # A task, not `scatter`: the scheduler repeats it if the workers that hold it are lost.
        constant = self._submit(_identity, shared)
        suspects = deque[Numbered]()
        most = at_once or AHEAD * self.workers
        with dask.config.set(PATIENCE if self._local else {}), terminate_as_interrupt():
            with closing(self._run(function, enumerate(tasks), constant, most)) as ended:
                for numbered, done in ended:
                    if done.lost:  # perhaps by the fault of another task of that worker
                        suspects.append(numbered)
                    else:
                        yield done
            with closing(self._run(function, suspects, constant, 1)) as ended:
                for _, done in ended:
                    yield done

    def _run(
        self, function: Function, tasks: Iterable[Numbered], constant: Future, most: int
    ) -> Generator[tuple[Numbered, Done], None, None]:
        """Run tasks, `most` of them at once, and yield each with what became of it."""
        ended: queue.SimpleQueue[Future] = queue.SimpleQueue()
        under_way: dict[Future, Numbered] = {}
        waiting = iter(tasks)
        try:
            while True:
                while len(under_way) < most and (numbered := next(waiting, None)) is not None:
                    future = self._submit(function, numbered[1], constant)
                    under_way[future] = numbered
                    future.add_done_callback(ended.put)
                if not under_way:
                    return
                future = self._next(ended)
                if future.status == "lost":  # its worker ended with the result: it runs again
                    future.add_done_callback(ended.put)
                    continue
                numbered = under_way.pop(future)
                yield numbered, self._done(numbered[0], future)
                future.release()
        finally:
            if under_way and self.client.status == "running":
                self.client.cancel(list(under_way))

    def _submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        # The tasks of an image are as large as the image; Dask warns of large ones.
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GiB"}):
            return self.client.submit(function, *arguments, pure=False)

    def _next(self, ended: queue.SimpleQueue[Future]) -> Future:
        """Wait for the end of a task, as long as the cluster is there."""
        last_worker = time.monotonic()
        while True:
            try:
                return ended.get(timeout=POLL_SECONDS)
            except queue.Empty:
                pass
            if self.client.status != "running":
                raise ClusterError(self._gone)
            if self.client.scheduler_info(n_workers=0).get("n_workers", 1):
                last_worker = time.monotonic()
            elif time.monotonic() - last_worker > NO_WORKER_SECONDS:
                raise ClusterError(
                    "no worker is left; start some, and the same call continues the run"
                )

    def _done(self, index: int, future: Future) -> Done:
        """Return what became of a task."""
        if future.status == "finished":
            return Done(index, future.result())
        if future.status == "cancelled":
            raise ClusterError(self._gone)
        error = future.exception()
        if isinstance(error, KilledWorker):
            times = dask.config.get("distributed.scheduler.allowed-failures") + 1
            return Done(index, None, LOST.format(times=times))
        raise error


def _identity(value: Any) -> Any:
    return value


def is_local(client: Client) -> bool:
    """Whether the client made its workers itself, on this machine."""
    return client.cluster is not None and type(client.cluster).__name__ == "LocalCluster"


def _check_versions(client: Client) -> None:
    """Raise ClusterError if a worker has other versions than this process."""
    here = versions()
    try:
        found = client.run(versions)
    except ModuleNotFoundError as error:
        raise ClusterError(
            f"the workers have no {error.name}; install eigengs-dr {here['eigengs_dr']} there"
        ) from None
    for address, there in found.items():
        for name, version in here.items():
            if there[name] != version:
                raise ClusterError(
                    f"worker {address} has {name} {there[name]}, but this process has {version}; "
                    "install equal versions"
                )


VERSIONS = ("eigengs_dr", "drjit", "numpy")
"""Packages whose versions must be equal everywhere, for equal bits."""


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's ``mallopt``."""


class WorkerSetup(WorkerPlugin):
    """Set up a worker process for this package.

    Parameters
    ----------
    local : bool
        Whether the workers run on the machine of the client, and end with it. They then leave
        Ctrl-C to the client, and share its kernel cache.
    """

    name = "eigengs-dr"

    def __init__(self, local: bool) -> None:
        self.local = local

    def setup(self, worker: Worker) -> None:
        """Set the process up; Dask calls this function once in every worker."""
        if self.local and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all processes
        if not self.local:
            use_own_kernel_cache()
        choose_gpu(worker.name)
        # Dr.Jit keeps memory for reuse, so a worker that Dask pauses at 80 % would never go on.
        worker.memory_manager.memory_pause_fraction = False
        worker.memory_manager.memory_spill_fraction = False
        worker.memory_manager.memory_target_fraction = False
        limit_threads(worker.state.nthreads)
        keep_freed_memory()
        warm_up()


def versions() -> dict[str, str | None]:
    """Return the versions of `VERSIONS` in this process."""
    from importlib.metadata import version

    import eigengs_dr

    found = {name: version(name) for name in VERSIONS[1:]}
    return {"eigengs_dr": eigengs_dr.__version__, **found}


def limit_threads(count: int) -> None:
    """Let Dr.Jit and BLAS of this process use some threads.

    Parameters
    ----------
    count : int
        The number of threads of the Dask worker.
    """
    import drjit as dr
    from threadpoolctl import threadpool_limits

    threadpool_limits(count)
    if dr.has_backend(dr.JitBackend.LLVM):
        dr.set_thread_count(count)


def keep_freed_memory() -> None:
    """Let the C library reuse freed memory, where it is glibc.

    Dask starts workers with ``MALLOC_TRIM_THRESHOLD_=65536``. Every large array then gets new pages
    from the kernel, and a fit of 256x256 pixels takes a tenth longer.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, 1 << 25)
        mallopt(M_TRIM_THRESHOLD, 1 << 27)


def use_own_kernel_cache(temporary: Path | None = None) -> None:
    """Keep compiled kernels on the disk of this machine: home folders of clusters are remote.

    A variable ``DRJIT_CACHE_DIR`` that is set stays. The folder outlives the worker.

    Parameters
    ----------
    temporary : Path, optional
        Where the folder is made; by default the folder of the system for temporary files. There
        other users may have made one of its name, with code that Dr.Jit would run: a folder that
        others own or may write is left alone, and this worker gets a new one.
    """
    if "DRJIT_CACHE_DIR" in os.environ:
        return
    user = os.getuid() if hasattr(os, "getuid") else getpass.getuser()
    folder = Path(temporary or tempfile.gettempdir()) / f"eigengs-dr-kernels-{user}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    private = stat.S_ISDIR(found.st_mode)
    if hasattr(os, "getuid"):  # on Windows each user has an own folder of temporary files
        private &= found.st_uid == os.getuid() and not found.st_mode & 0o022
    if not private:
        folder = Path(tempfile.mkdtemp(prefix="eigengs-dr-kernels-", dir=temporary))
    os.environ["DRJIT_CACHE_DIR"] = str(folder)


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


def warm_up() -> None:
    """Import what fits import, and start the backend, before the first task is timed."""
    from eigengs_dr.backend.selection import BackendError, select
    from eigengs_dr.collection import fit_many  # noqa: F401

    with suppress(BackendError):  # the first task says what is missing
        types = select()
        types.Float(1.0).numpy()
