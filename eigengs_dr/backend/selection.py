"""Choice of the Dr.Jit backend: llvm or cuda."""

import importlib
import importlib.metadata
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from .feedback import warn
from .libllvm import MIN_VERSION, advice, load_failure, loaded_path, too_old

UNTESTED_ON_GPU = "tested with a simulated driver only, not yet on a GPU"
"""State of the cuda backend, until the whole suite has passed on a GPU."""


class BackendError(RuntimeError):
    """A backend is not available; the message is one line that says what to install."""


def select(backend: str | None = None) -> ModuleType:
    """Return the module with a backend's differentiable array types.

    Parameters
    ----------
    backend : {"llvm", "cuda"}, optional
        By default "cuda" if the machine has a CUDA GPU, else "llvm".

    Returns
    -------
    module
        ``drjit.llvm.ad`` or ``drjit.cuda.ad``.

    Raises
    ------
    BackendError
        If the backend is not available, its libLLVM is older than `MIN_VERSION`, or Dr.Jit cannot
        be imported.
    ValueError
        If `backend` has another value.

    Warns
    -----
    UserWarning
        At the first use of cuda in a process: `UNTESTED_ON_GPU`.

    Examples
    --------
    >>> from eigengs_dr.backend.selection import select
    >>> select().Float(1, 2).shape
    (2,)
    """
    if backend not in (None, "llvm", "cuda"):
        raise ValueError(f"backend {backend!r} is unknown; use 'llvm' or 'cuda'")
    dr = _import_drjit()
    if backend != "llvm" and dr.has_backend(dr.JitBackend.CUDA):
        _announce_cuda()
        return dr.cuda.ad
    if backend == "cuda":
        raise BackendError("no CUDA GPU or driver was found; use backend 'llvm'")
    if (fault := too_old()) or not dr.has_backend(dr.JitBackend.LLVM):
        raise BackendError(f"{fault or load_failure()}; {advice()}")
    from .detail import llvm_version

    version = llvm_version()[0]
    if version < MIN_VERSION:
        raise BackendError(f"{loaded_path()} is LLVM {version}, which crashes Dr.Jit; {advice()}")
    return dr.llvm.ad


@cache
def _announce_cuda() -> None:
    """Warn of the state of the cuda backend, once in a process."""
    warn(f"backend cuda: {UNTESTED_ON_GPU}; compare with backend 'llvm'")


def describe(backend: str | None = None) -> dict[str, Any]:
    """Return the hardware and the versions that a measurement depends on.

    Parameters
    ----------
    backend : {"llvm", "cuda"}, optional
        As for `select`.

    Returns
    -------
    dict
        ``backend``; ``threads`` of the llvm backend; ``cpu``, the model of the processor;
        ``platform``; ``versions``, a dict of eigengs_dr, drjit, numpy, python, libllvm and
        libllvm_path. The last two are None if the llvm backend does not work.

    Raises
    ------
    BackendError, ValueError
        As for `select`.
    """
    module = select(backend)
    import drjit as dr

    from .detail import llvm_version

    llvm = dr.has_backend(dr.JitBackend.LLVM)
    return {
        "backend": "cuda" if module is dr.cuda.ad else "llvm",
        "threads": dr.thread_count(),
        "cpu": _cpu_model(),
        "platform": platform.platform(),
        "versions": {
            "eigengs_dr": version_of("eigengs-dr"),
            "drjit": version_of("drjit"),
            "numpy": version_of("numpy"),
            "python": platform.python_version(),
            "libllvm": ".".join(map(str, llvm_version())) if llvm else None,
            "libllvm_path": loaded_path() if llvm else None,
        },
    }


def version_of(package: str) -> str | None:
    """Return the version of a Python package.

    Parameters
    ----------
    package : str
        Name on the package index.

    Returns
    -------
    str or None
        None if the package is not installed.
    """
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _import_drjit() -> ModuleType:
    """Import Dr.Jit; if libatomic is missing, say so more clearly than Dr.Jit does."""
    if "drjit" in sys.modules:
        return sys.modules["drjit"]
    try:
        with _silent_stderr():
            return importlib.import_module("drjit")
    except (ImportError, NameError) as error:
        reason = error.__context__ or error
        raise BackendError(
            f"Dr.Jit cannot be imported ({reason}); if libatomic is missing, install it: "
            "Debian, Ubuntu 'apt install libatomic1', Fedora 'dnf install libatomic'"
        ) from error


def _cpu_model() -> str:
    """Return the model of the processor on Linux, or its architecture on other systems."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor()
    model = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return model.group(1) if model else platform.machine()


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Hide what Dr.Jit prints about a libLLVM that fails; `BackendError` says what to do."""
    try:
        saved = os.dup(2)
    except OSError:  # some daemons close standard error
        yield
        return
    with open(os.devnull, "w") as null:
        os.dup2(null.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
