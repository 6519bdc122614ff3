"""Dask: connection to a cluster, and an executor that submits tasks as workers become free.

A cluster is not changed: neither its plugins and its configuration nor the limits of its workers.
`eigengs_dr.cluster.worker` sets what a task needs for the duration of the task.
"""

from __future__ import annotations

import asyncio
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
from ..backend.plain import read_json
from ..version import __version__
from .local import local_cluster
from .worker import package_versions, run_task, share

CONNECT_SECONDS = 30.0
"""Time limit for connecting to the scheduler."""

LOST_WORKER_SETTING = {"distributed.deploy.lost-worker-timeout": "52w"}
"""Dask setting for the workers of ``local``. This time after a worker ended, by default 15 s, Dask
checks whether the worker is back. If it starts slowly, or has just ended again, Dask closes the
nanny that is about to restart it, and the cluster stays smaller for good."""

LARGE_TASK_SETTING = {"distributed.admin.large-graph-warning-threshold": "1GiB"}
"""Dask setting that avoids warnings about large tasks, because tasks hold images."""

_SUBMIT_LOCK = threading.Lock()
"""Protects `LARGE_TASK_SETTING`: one thread would reset what another has set."""

SILENCED_LOGGERS = (
    "distributed",
    "distributed.client",
    "distributed.gc",
    "tornado.application",
    "asyncio",
)
"""Loggers that report a lost connection in many lines; this package reports it in one."""


@contextmanager
def connect(cluster: str) -> Iterator[Client]:
    """Connect to a cluster during a block.

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
    with ExitStack() as stack:
        stack.enter_context(_silenced_loggers())
        if match := re.fullmatch(r"local(?::([1-9]\d*))?", cluster):
            stack.enter_context(dask.config.set(LOST_WORKER_SETTING))
            with defer_interrupts() as interrupted:  # Dask does not stop workers that are starting
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
            if not is_address:
                _check_scheduler_file(cluster)
            location = {"address" if is_address else "scheduler_file": cluster}
            try:
                client = stack.enter_context(Client(**location, timeout=CONNECT_SECONDS))
            except OSError as error:
                raise ClusterError(f"{cluster}: no scheduler answers; start it first") from error
        yield client


def _check_scheduler_file(path: str) -> None:
    """Raise ValueError unless a file names an address; Dask would connect to None."""
    try:
        str(read_json(path)["address"])
    except (ValueError, KeyError, TypeError):
        raise ValueError(
            f"cluster {path!r} is not the file of a scheduler, as 'dask scheduler "
            "--scheduler-file FILE' writes it"
        ) from None


@contextmanager
def _silenced_loggers() -> Iterator[None]:
    """Silence Dask's loggers during a block."""
    levels = {name: logging.getLogger(name).level for name in SILENCED_LOGGERS}
    try:
        for name in SILENCED_LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


TASKS_PER_WORKER = 2
"""Number of submitted tasks per worker: one that runs, and one that waits there."""

NO_WORKER_SECONDS = 60.0
"""Time without any worker after which a run ends. A nanny restarts a worker within seconds."""


class ClusterExecutor:
    """The `eigengs_dr.backend.executor.Executor` of a Dask client.

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
        If there is no worker within `NO_WORKER_SECONDS`, or one lacks this version of the package.
    """

    def __init__(self, client: Client) -> None:
        self.client = client
        self.address = client.scheduler.address if client.scheduler else "?"
        with self._cluster_errors():
            self._require_worker(f"the scheduler {self.address} has no workers; start some")
            self._require_package()
            self.workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))

    def map(
        self, function: Function[Task, Value], tasks: Iterable[Task], shared: Any = None
    ) -> Generator[Done, None, None]:
        """Call ``function(task, shared)`` for every task; see `Executor.map`.

        If a worker crashes, all of its tasks are lost. Tasks that Dask gives up are therefore tried
        again at the end, one at a time, so that no task fails because of another.
        """
        suspects: deque[Task] = deque()
        with self._cluster_errors(), terminate_as_interrupt():
            # A task instead of `scatter`: the scheduler repeats it if its workers are lost.
            constant = self._submit("share", share, dumps((function, shared)), package_versions())
            name = funcname(function)
            with closing(
                self._run(name, tasks, constant, TASKS_PER_WORKER * self.workers)
            ) as ended:
                for done in ended:
                    if done.lost:  # perhaps because of another task of that worker
                        suspects.append(done.task)
                    else:
                        yield done
            with closing(self._run(name, suspects, constant, 1)) as ended:
                yield from ended

    def _run(
        self, name: str, tasks: Iterable[object], constant: Future, limit: int
    ) -> Generator[Done, None, None]:
        """Run tasks, at most `limit` of them at the same time."""
        submitted: dict[Future, object] = {}
        waiting = iter(tasks)
        ended = self._watch(submitted)
        try:
            while True:
                for task in islice(waiting, limit - len(submitted)):
                    future = self._submit(name, run_task, dumps(task), constant)
                    submitted[future] = task
                    ended.add(future)
                try:
                    future = next(ended)
                except StopIteration:
                    return
                except asyncio.TimeoutError:  # since Python 3.11, TimeoutError
                    # The time is counted from the first task.
                    self._require_worker(
                        "no worker is left; start some, and the same call continues the run"
                    )
                    ended = self._watch(submitted)
                    continue
                yield _done(submitted.pop(future), future)
                future.release()
        finally:
            if submitted and self.client.status == "running":
                self.client.cancel(list(submitted))

    def _watch(self, futures: Iterable[Future]) -> as_completed:
        return as_completed(list(futures), loop=self.client.loop, timeout=NO_WORKER_SECONDS)

    def _submit(self, name: str, function: Callable, *arguments: object) -> Future:
        """Submit a task. Dask estimates its duration from tasks of the same name."""
        with _SUBMIT_LOCK, dask.config.set(LARGE_TASK_SETTING):
            return self.client.submit(function, *arguments, key=f"{name}-{uuid4()}")

    def _require_worker(self, message: str) -> None:
        """Wait until there is a worker; raise an error with the message if there is none."""
        try:
            self.client.wait_for_workers(1, timeout=NO_WORKER_SECONDS)
        except asyncio.TimeoutError:
            raise ClusterError(message) from None

    def _require_package(self) -> None:
        """Check the version of the package on all workers.

        The call uses a function of the standard library, because a function that workers cannot
        load closes their connection.
        """
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
    def _cluster_errors(self) -> Iterator[None]:
        """Convert errors about a lost cluster or a missing package to a one-line `ClusterError`."""
        try:
            yield
        except (CancelledError, CommClosedError) as error:
            raise ClusterError(
                f"the scheduler {self.address} is gone; start it, and the same call continues the "
                "run"
            ) from error
        except ModuleNotFoundError as error:
            raise ClusterError(
                f"a worker lacks {error.name}; install the packages of this process there"
            ) from None


def _done(task: object, future: Future) -> Done:
    """Return the result of a task; waits if it runs again because its worker was lost."""
    try:
        return Done(task, loads(future.result()))
    except KilledWorker:
        times = dask.config.get("distributed.scheduler.allowed-failures") + 1
        reason = f"its worker ended {times} times during the work"
        return Done(task, None, f"{reason}; it may need more memory than a worker has")
