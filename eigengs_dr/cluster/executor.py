"""The executor of a Dask client: tasks drawn as workers become free, and what may go wrong."""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from typing import Any

import dask
from distributed import Client, Future
from distributed.scheduler import KilledWorker

from ..backend.executor import ClusterError, Done, Function
from ..backend.feedback import terminate_as_interrupt
from .worker import WorkerSetup, versions

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
        Its workers are set up by `eigengs_dr.cluster.worker.WorkerSetup`.

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
