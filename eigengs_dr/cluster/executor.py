"""Dask: a client from words, and the executor of a client. Tasks are drawn as workers become free.

What a cluster has is left as it is: its plugins, its configuration, the limits of its workers. What
a task needs, `eigengs_dr.cluster.worker` sets for the time of the task.
"""

from __future__ import annotations

import logging
import re
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import islice
from pathlib import Path
from pkgutil import resolve_name
from typing import Any
from uuid import uuid4

import dask
from dask.utils import funcname
from distributed import CancelledError, Client, Future, as_completed
from distributed.comm import CommClosedError
from distributed.protocol.pickle import dumps, loads
from distributed.scheduler import KilledWorker

from ..backend.executor import ClusterError, Done, Function, Task, Value
from ..backend.interrupts import defer_interrupts, terminate_as_interrupt
from ..version import __version__
from .local import local_cluster
from .worker import package_versions, run_task, share

CONNECT_SECONDS = 30.0
"""Time for the scheduler to answer."""

PATIENCE = {"distributed.deploy.lost-worker-timeout": "52w"}
"""Setting of Dask for the workers of ``local``. After that time, 15 s by default, from any end of a
worker, Dask looks whether the worker is there. If it starts slowly, or has just ended once more,
Dask ends the nanny that is about to restart it, and the cluster stays smaller for ever."""

LARGE_TASKS = {"distributed.admin.large-graph-warning-threshold": "1GiB"}
"""Setting of Dask: tasks hold images, and Dask warns of large tasks."""

_SUBMIT_LOCK = threading.Lock()
"""For `LARGE_TASKS`: of two threads, one would restore what the other has set."""

LOGGERS = ("distributed", "distributed.client", "distributed.gc", "tornado.application", "asyncio")
"""What says the same as our line, in many: that a connection was lost."""


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
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        if match := re.fullmatch(r"local(?::([1-9]\d*))?", cluster):
            stack.enter_context(dask.config.set(PATIENCE))
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


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask from writing lines during a block."""
    levels = {name: logging.getLogger(name).level for name in LOGGERS}
    try:
        for name in LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


AHEAD = 2
"""Tasks under way for each worker: one that runs, and one that waits there."""

NO_WORKER_SECONDS = 60.0
"""Time without any worker after which a run ends. A nanny restarts a worker in some seconds."""


class ClusterExecutor:
    """The `eigengs_dr.backend.executor.Executor` of a Dask client.

    Parameters
    ----------
    client : distributed.Client

    Attributes
    ----------
    workers : int
        Number of workers when the executor was made, at least 1.

    Raises
    ------
    ClusterError
        If no worker comes within `NO_WORKER_SECONDS`, or one lacks this version of the package.
    """

    def __init__(self, client: Client) -> None:
        self.client = client
        self.address = client.scheduler.address if client.scheduler else "?"
        with self._explained():
            self._require_worker(f"the scheduler {self.address} has no workers; start some")
            self._require_package()
            self.workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))

    def map(
        self, function: Function[Task, Value], tasks: Iterable[Task], shared: Any = None
    ) -> Generator[Done, None, None]:
        """Call ``function(task, shared)`` for every task; see `Executor.map`.

        A worker that ends takes all of its tasks with it. So tasks that Dask gives up are tried
        again at the end, one at a time; a task is lost for its own fault only.
        """
        suspects: deque[Task] = deque()
        with self._explained(), terminate_as_interrupt():
            # A task, not `scatter`: the scheduler repeats it if the workers that hold it are lost.
            constant = self._submit("share", share, dumps((function, shared)), package_versions())
            name = funcname(function)
            with closing(self._run(name, tasks, constant, AHEAD * self.workers)) as ended:
                for done in ended:
                    if done.lost:  # perhaps by the fault of another task of that worker
                        suspects.append(done.task)
                    else:
                        yield done
            with closing(self._run(name, suspects, constant, 1)) as ended:
                yield from ended

    def _run(
        self, name: str, tasks: Iterable[object], constant: Future, limit: int
    ) -> Generator[Done, None, None]:
        """Run tasks, `limit` of them at once."""
        under_way: dict[Future, object] = {}
        waiting = iter(tasks)
        ended = self._watch(under_way)
        try:
            while True:
                for task in islice(waiting, limit - len(under_way)):
                    future = self._submit(name, run_task, dumps(task), constant)
                    under_way[future] = task
                    ended.add(future)
                try:
                    future = next(ended)
                except StopIteration:
                    return
                except TimeoutError:  # after a time that counts from the first task
                    self._require_worker(
                        "no worker is left; start some, and the same call continues the run"
                    )
                    ended = self._watch(under_way)
                    continue
                yield _done(under_way.pop(future), future)
                future.release()
        finally:
            if under_way and self.client.status == "running":
                self.client.cancel(list(under_way))

    def _watch(self, futures: Iterable[Future]) -> as_completed:
        return as_completed(list(futures), loop=self.client.loop, timeout=NO_WORKER_SECONDS)

    def _submit(self, name: str, function: Callable, *arguments: object) -> Future:
        """Submit a task; Dask learns from those of the same name how long it takes."""
        with _SUBMIT_LOCK, dask.config.set(LARGE_TASKS):
            return self.client.submit(function, *arguments, key=f"{name}-{uuid4()}")

    def _require_worker(self, otherwise: str) -> None:
        """Wait until there is a worker."""
        try:
            self.client.wait_for_workers(1, timeout=NO_WORKER_SECONDS)
        except TimeoutError:
            raise ClusterError(otherwise) from None

    def _require_package(self) -> None:
        """Ask the workers by a function of Python: what they cannot load ends their connection."""
        answers = self.client.run(resolve_name, "eigengs_dr:__version__", on_error="return")
        for address, answer in answers.items():
            if isinstance(answer, ModuleNotFoundError):
                raise answer
            if isinstance(answer, str) and answer != __version__:
                raise ClusterError(
                    f"worker {address} has eigengs_dr {answer}, but this process has "
                    f"{__version__}; install equal versions"
                )

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Say in one line that the cluster is gone, or what its workers lack."""
        try:
            yield
        except (CancelledError, CommClosedError) as error:
            raise ClusterError(
                f"the scheduler {self.address} is gone; start it, and the same call continues the "
                "run"
            ) from error
        except ModuleNotFoundError as error:
            raise ClusterError(
                f"a worker has no {error.name}; install there what this process has"
            ) from None


def _done(task: object, future: Future) -> Done:
    """Return what became of a task; one whose worker ended with the result runs again."""
    try:
        return Done(task, loads(future.result()))
    except KilledWorker:
        times = dask.config.get("distributed.scheduler.allowed-failures") + 1
        reason = f"its worker ended {times} times during the work"
        return Done(task, None, f"{reason}; it may need more memory than a worker has")
