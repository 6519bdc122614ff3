"""Tasks, in this process or on Dask workers; the only folder that imports Dask, for a Dask client.

Functions that take ``client`` get an `Executor` from `executor_for`; ``executor`` has that of Dask.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

if TYPE_CHECKING:
    from distributed import Client

Task = TypeVar("Task")
Value = TypeVar("Value")

Function = Callable[[Task, Any], Value]
"""``function(task, shared)``, defined at the top level of a module."""


class ClusterError(RuntimeError):
    """A cluster cannot be used, or the connection is lost; the message is one line."""


class Done(NamedTuple):
    """A task that has ended.

    Attributes
    ----------
    task : object
    value : object
        What the function returned.
    lost : str
        One line if the task was given up because it crashed its worker too often; the value is
        then None. Otherwise empty.
    """

    task: Any
    value: Any
    lost: str = ""


@runtime_checkable
class Executor(Protocol):
    """A place where tasks run.

    Attributes
    ----------
    workers : int
        Number of processes that run tasks.
    """

    workers: int

    def map(
        self, function: Function[Task, Value], tasks: Iterable[Task], shared: Any = None
    ) -> Generator[Done, None, None]:
        """Call ``function(task, shared)`` for every task, and yield the results.

        Parameters
        ----------
        function : callable
            Defined at the top level of a module. It may run twice for one task if a worker is lost.
        tasks : iterable
            NumPy arrays, paths, numbers, bytes, and records of these. Tasks are taken from the
            iterable as workers become free, a few ahead.
        shared : object
            Data that all tasks use; it is sent once.

        Yields
        ------
        Done
            In this process in order; on a cluster as the tasks end.

        Raises
        ------
        ClusterError
            If the cluster is lost.
        Exception
            The exception of the function, if it raises one.
        """


class LocalExecutor:
    """The `Executor` of this process: one task after the other, without copies."""

    workers = 1

    def map(
        self, function: Function[Task, Value], tasks: Iterable[Task], shared: Any = None
    ) -> Generator[Done, None, None]:
        """Call ``function(task, shared)`` for every task; see `Executor.map`."""
        from ..backend.recording import exclusive  # loads Dr.Jit, which `--help` does not need

        for task in tasks:
            with exclusive():  # a task may use Dr.Jit, beside other threads of the caller
                value = function(task, shared)
            yield Done(task, value)


def completed(
    executor: Executor,
    function: Function[Task, Value],
    tasks: Iterable[Task],
    shared: Any = None,
) -> Generator[tuple[Task, Value], None, None]:
    """Run tasks, and fail if one of them is given up.

    Parameters
    ----------
    executor : Executor
    function, tasks, shared
        See `Executor.map`, also for errors.

    Yields
    ------
    task, value : object
        See `Done`.

    Raises
    ------
    ClusterError
        If a task was given up.
    """
    with closing(executor.map(function, tasks, shared)) as ended:
        for task, value, lost in ended:
            if lost:
                raise ClusterError(f"part of the work cannot be done: {lost}")
            yield task, value


def executor_for(client: object = None) -> Executor:
    """Return the executor of a client.

    Parameters
    ----------
    client : distributed.Client, Executor or None
        None stands for this process.

    Returns
    -------
    Executor

    Raises
    ------
    TypeError
        If the type of the client is not supported.
    ClusterError
        If the workers of the client cannot be used.
    """
    if client is None:
        return LocalExecutor()
    kind = type(client)
    if kind.__module__.partition(".")[0] == "distributed":
        from .executor import ClusterExecutor

        return ClusterExecutor(cast("Client", client))
    if isinstance(client, Executor):
        return client
    raise TypeError(
        f"client is a {kind.__module__}.{kind.__name__}; pass a distributed.Client, or None"
    )
