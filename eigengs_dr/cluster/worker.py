"""Execution of tasks on a worker: one at a time, each restoring the state of the process.

Dask copies, prints and drops the arguments and results of tasks in threads of its own. If those
were Dr.Jit arrays, these threads would use Dr.Jit at the same time as a task, and hang. So Dask
only sees bytes. The thread of the task unpickles and frees the values.
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
    """Data that all tasks of a run use, as bytes and, on a worker, as a cached value.

    Parameters
    ----------
    data : bytes
        The function and its second argument, from `distributed.protocol.pickle.dumps`.
    versions : dict of str to str
        The package versions that all workers of the run must have.
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
        return len(self.data)  # Dask uses it as the memory of the object

    def __del__(self) -> None:
        with release_later(self.__dict__.pop("value", None)):  # Dask drops it in its own thread
            pass


def share(data: bytes, versions: dict[str, str]) -> Shared:
    """Begin a run on the first worker; the other workers must have the same LLVM.

    Parameters
    ----------
    data : bytes
        See `Shared`.
    versions : dict of str to str
        The versions of the client, from `package_versions`.
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
        The exception of the function, if it raises one.
    """
    worker = get_worker()
    with _unprofiled(worker), limited_threads(worker.state.nthreads):
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
def _unprofiled(worker: Worker) -> Iterator[None]:
    """Hide this thread from Dask's profiler during a block.

    The profiler accesses the frames of all tasks a hundred times per second. If a function returns
    at that moment, the profiler keeps its variables, so that Dask's thread frees Dr.Jit arrays.
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
    """Limit the threads of BLAS and Dr.Jit during a block, then free Dr.Jit's cached memory.

    The block is `exclusive`, because thread counts apply to the process, which may hold several
    workers.

    Dr.Jit's pool ignores OMP variables and uses every core, so two workers would use each core
    twice. It keeps freed memory for reuse, so that a worker that Dask pauses because of its memory,
    by default at 80 % of its limit, would never continue.
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
    """Return the versions of the packages that determine the bits of results."""
    return {name: version(name) for name in ("drjit", "numpy")}


@cache  # of the process; asked for every task
def _llvm_version() -> str:
    try:
        return str(describe("llvm")["versions"]["libllvm"])
    except BackendError:
        return "none"


def check_versions(expected: dict[str, str]) -> None:
    """Check that this worker has the expected versions.

    Parameters
    ----------
    expected : dict of str to str
        From `package_versions`, optionally with ``LLVM``.

    Raises
    ------
    ClusterError
        If a version differs.
    """
    installed = package_versions()
    if "LLVM" in expected:
        installed["LLVM"] = _llvm_version()
    for name, needed in expected.items():
        if installed[name] != needed:
            raise ClusterError(
                f"worker {get_worker().address} has {name} {installed[name]}, and the run began "
                f"with {needed}; install equal versions"
            )
