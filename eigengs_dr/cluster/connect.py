"""A Dask client from one word, as the command line takes it."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from distributed import Client, LocalCluster

from ..backend.executor import ClusterError
from ..backend.feedback import defer_interrupts

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
