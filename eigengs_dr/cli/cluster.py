"""The option ``--cluster``: a client for a block."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..backend.executor import ClusterError
from ..backend.interrupt import terminate_as_interrupt


@contextmanager
def open_cluster(cluster: str | None) -> Iterator[Any]:
    """Connect to a cluster during a block.

    Parameters
    ----------
    cluster : str or None
        See `eigengs_dr.cluster.connect.connect`; None is this process.

    Yields
    ------
    distributed.Client or None

    Raises
    ------
    ClusterError
        If Dask is missing, or the scheduler does not answer.
    ValueError
        If the word is unknown.
    """
    if cluster is None:
        yield None
        return
    try:
        from ..cluster.connect import connect
    except ModuleNotFoundError as error:
        raise ClusterError(
            f"--cluster needs {error.name}; type: pip install 'eigengs-dr[cluster]'"
        ) from None
    # Schedulers of batch jobs send SIGTERM; the workers of ``local`` have to end too.
    with terminate_as_interrupt(), connect(cluster) as client:
        yield client
