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
from .messages import warn
from .types import Record

BACKENDS = ("llvm", "cuda", "metal")

UNTESTED_ON_METAL = "never run; only its names are tested"
"""Status of Dr.Jit's metal backend, which runs on Macs."""


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

    Warns
    -----
    UserWarning
        At the first use of metal in a process: `UNTESTED_ON_METAL`.

    Examples
    --------
    >>> from eigengs_dr.backend.selection import select
    >>> select().Float(1, 2).shape
    (2,)
    """
    if backend not in (None, *BACKENDS):
        raise ValueError(f"backend {backend!r} is unknown; use {', '.join(map(repr, BACKENDS))}")
    dr = _import_drjit()
    if backend == "metal":
        if not _has(dr, "Metal"):
            raise BackendError("no Metal GPU was found; use backend 'llvm'")
        _announce_metal()
        return dr.metal.ad
    if backend != "llvm" and _has(dr, "CUDA"):
        return dr.cuda.ad
    if backend == "cuda":
        raise BackendError("no CUDA GPU or driver was found; use backend 'llvm'")
    if (fault := too_old()) or not _has(dr, "LLVM"):
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
def _has(dr: ModuleType, name: str) -> bool:
    """Return whether Dr.Jit has a backend; cached, because the query waits for Dr.Jit's lock."""
    kind = getattr(dr.JitBackend, name, None)  # Dr.Jit has Metal since 1.4
    return kind is not None and bool(dr.has_backend(kind))


@cache  # the second call is silent
def _announce_metal() -> None:
    """Warn about the status of the metal backend, once in a process."""
    warn(f"backend metal: {UNTESTED_ON_METAL}; compare with backend 'llvm'")


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

    llvm = _has(dr, "LLVM")
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
