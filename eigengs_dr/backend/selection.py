"""Choice of the Dr.Jit backend: llvm, cuda or metal."""

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

from .libllvm import MIN_VERSION, advice, load_failure, loaded_path, too_old
from .types import Record

BACKENDS = {"llvm": "LLVM", "cuda": "CUDA", "metal": "Metal"}
"""The backends, and their names in `drjit.JitBackend`; nobody has run "metal", for Macs."""


class BackendError(RuntimeError):
    """A backend is not available; the message is one line with what to install."""


def select(backend: str | None = None) -> ModuleType:
    """Return the module with a backend's differentiable array types.

    Parameters
    ----------
    backend : {"llvm", "cuda", "metal"}, optional
        By default "cuda" if the machine has a CUDA GPU and a driver, else "llvm".

    Returns
    -------
    module
        ``drjit.llvm.ad``, ``drjit.cuda.ad`` or ``drjit.metal.ad``.

    Raises
    ------
    BackendError
        If the backend is not available, its libLLVM is older than `MIN_VERSION`, or Dr.Jit cannot
        be imported.
    ValueError
        If `backend` has another value.

    Examples
    --------
    >>> from eigengs_dr.backend.selection import select
    >>> select().Float(1, 2).shape
    (2,)
    """
    if backend not in (None, *BACKENDS):
        raise ValueError(f"backend {backend!r} is unknown; use {', '.join(map(repr, BACKENDS))}")
    dr = _import_drjit()
    backend = backend or ("cuda" if _has(dr, "cuda") else "llvm")
    if backend != "llvm":
        if not _has(dr, backend):
            name = BACKENDS[backend]
            raise BackendError(f"no {name} GPU or driver was found; use backend 'llvm'")
        module: ModuleType = getattr(dr, backend).ad
        return module
    if (fault := too_old()) or not _has(dr, "llvm"):
        raise BackendError(f"{fault or load_failure()}; {advice()}")
    from .detail import llvm_version

    version = llvm_version()[0]
    if version < MIN_VERSION:
        raise BackendError(f"{loaded_path()} is LLVM {version}, which crashes Dr.Jit; {advice()}")
    return dr.llvm.ad


def name_of(module: ModuleType) -> str:
    """Return the name of the backend of a module from `select`, e.g. "llvm"."""
    return module.__name__.split(".")[1]


def backend_of(variant: str) -> str | None:
    """Return the backend of a Mitsuba variant such as ``llvm_ad_rgb``; None if it is scalar."""
    backend = variant.partition("_")[0]
    return backend if backend in BACKENDS else None


@cache
def _has(dr: ModuleType, backend: str) -> bool:
    """Return whether Dr.Jit has a backend; cached, because the query waits for Dr.Jit's lock."""
    return bool(dr.has_backend(getattr(dr.JitBackend, BACKENDS[backend])))


def describe(backend: str | None = None) -> Record:
    """Return the hardware and the versions that a measurement depends on.

    Parameters
    ----------
    backend : {"llvm", "cuda", "metal"}, optional
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

    llvm = _has(dr, "llvm")
    return {
        "backend": name_of(module),
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
    """Import Dr.Jit, with a clearer error than Dr.Jit's if libatomic is missing."""
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
    """Hide Dr.Jit's messages about a libLLVM that fails; `BackendError` gives advice instead."""
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
