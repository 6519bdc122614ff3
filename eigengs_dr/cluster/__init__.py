"""Dask workers; the only folder that imports Dask, and only for a Dask client."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from ..backend.executor import Executor, LocalExecutor

if TYPE_CHECKING:
    from distributed import Client


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
