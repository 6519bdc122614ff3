"""What a worker needs before its first task: threads, a GPU, a kernel cache, a warm backend.

Dr.Jit's pool ignores OMP variables and takes every core, so two workers would use each core twice.
"""

from __future__ import annotations

import ctypes
import getpass
import os
import signal
import stat
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from distributed import Worker, WorkerPlugin

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
