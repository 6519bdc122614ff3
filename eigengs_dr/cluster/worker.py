"""What runs on a worker: one task at a time, which leaves the process as it was.

Dask copies, prints and drops what tasks take and return, in threads of its own. If those were
arrays of Dr.Jit, these threads would use Dr.Jit beside a task, and hang with it. So Dask sees
bytes alone. The thread of the task makes values of them, and frees these.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property
from importlib.metadata import version

from distributed import Worker, get_worker
from distributed.protocol.pickle import dumps, loads
from threadpoolctl import threadpool_limits

from ..backend.executor import ClusterError
from ..backend.recording import exclusive, release_later
from ..backend.selection import BackendError, describe


class Shared:
    """What all tasks of a run use, as bytes, and as a value while a worker holds it.

    Parameters
    ----------
    data : bytes
        The function and its second argument, from `distributed.protocol.pickle.dumps`.
    versions : dict of str to str
        The versions that all workers of the run need.
    """

    def __init__(self, data: bytes, versions: dict[str, str]) -> None:
        self.data, self.versions = data, versions

    @cached_property
    def value(self) -> tuple[Callable, object]:
        """The function and its second argument."""
        function, shared = loads(self.data)
        return function, shared

    def __reduce__(self) -> tuple:
        return Shared, (self.data, self.versions)

    def __sizeof__(self) -> int:
        return len(self.data)  # Dask asks how much memory it holds

    def __del__(self) -> None:
        with release_later(self.__dict__.pop("value", None)):  # Dask drops it in its own thread
            pass


def share(data: bytes, versions: dict[str, str]) -> Shared:
    """Begin a run on the first worker; the others need its LLVM.

    Parameters
    ----------
    data : bytes
        See `Shared`.
    versions : dict of str to str
        Those of the client, from `package_versions`.
    """
    check_versions(versions)
    return Shared(data, versions | {"LLVM": _llvm_version()})


def run_task(task: bytes, shared: Shared) -> bytes:
    """Call the function of a run for one task.

    Raises
    ------
    ClusterError
        If this worker has other versions than the rest of the run.
    Exception
        What the function raises.
    """
    worker = get_worker()
    with _unwatched(worker), limited_threads(worker.state.nthreads):
        check_versions(shared.versions)
        function, constant = shared.value
        try:
            return dumps(function(loads(task), constant))
        except BaseException as error:
            _clear_frames(error)
            raise


def _clear_frames(error: BaseException | None) -> None:
    """Free the arrays in the frames of an error, which Dask would free in its own thread."""
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__cause__ or error.__context__


@contextmanager
def _unwatched(worker: Worker) -> Iterator[None]:
    """Hide this thread from Dask's profiler during a block.

    The profiler takes the frames of all tasks a hundred times a second. A function that returns
    meanwhile leaves its variables to it, and so Dask's thread frees arrays of Dr.Jit.
    """
    thread = threading.get_ident()
    with worker.active_threads_lock:
        key = worker.active_threads.pop(thread)
    try:
        yield
    finally:
        with worker.active_threads_lock:
            worker.active_threads[thread] = key


@contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Let BLAS and Dr.Jit use so many threads during a block, and Dr.Jit keep no memory after it.

    The block is `exclusive`: numbers of threads belong to the process, as all workers in it do.

    Dr.Jit's pool ignores OMP variables and takes every core, so two workers would use each core
    twice. It keeps freed memory for reuse, and a worker that Dask pauses for its memory, by default
    at 80 % of its limit, would never go on.
    """
    import drjit as dr

    with exclusive(), threadpool_limits(count):
        before = dr.thread_count()
        dr.set_thread_count(count)
        try:
            yield
        finally:
            dr.set_thread_count(before)
            dr.flush_malloc_cache()


def package_versions() -> dict[str, str]:
    """Return the versions of packages that must be equal everywhere, for equal bits."""
    return {name: version(name) for name in ("drjit", "numpy")}


@cache  # of the process; asked for every task
def _llvm_version() -> str:
    try:
        return str(describe("llvm")["versions"]["libllvm"])
    except BackendError:
        return "none"


def check_versions(wanted: dict[str, str]) -> None:
    """Compare the versions of this worker with others.

    Parameters
    ----------
    wanted : dict of str to str
        From `package_versions`, and perhaps ``LLVM``.

    Raises
    ------
    ClusterError
        If one differs.
    """
    here = package_versions()
    if "LLVM" in wanted:
        here["LLVM"] = _llvm_version()
    for name, needed in wanted.items():
        if here[name] != needed:
            raise ClusterError(
                f"worker {get_worker().address} has {name} {here[name]}, and the run began with "
                f"{needed}; install equal versions"
            )
