"""Choice of the Dr.Jit backend, llvm, cuda or metal, and of the libLLVM that Dr.Jit loads.

Dr.Jit looks for libLLVM while it is imported: first at ``DRJIT_LIBLLVM_PATH``, then for the
system's ``libLLVM.so``, then in ``/usr/lib``. That library may be too old: Dr.Jit rejects version
14, and accepts versions 15 and 16 although these crash at the first ``dr.clip``. Therefore
`select_libllvm` sets the variable to a newer library before the import.
"""

from __future__ import annotations

import glob
import importlib
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # loads NumPy, which `import eigengs_dr` does not
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
    if backend is not None and str(backend) not in BACKENDS:
        raise ValueError(f"backend {backend!r} is unknown; use {', '.join(map(repr, BACKENDS))}")
    dr = import_drjit()
    backend = backend or ("cuda" if _has(dr, "cuda") else "llvm")
    if backend != "llvm":
        if not _has(dr, backend):
            name = BACKENDS[backend]
            raise BackendError(f"no {name} GPU or driver was found; use backend 'llvm'")
        module: ModuleType = getattr(dr, backend).ad
        return module
    if (fault := too_old()) or not _has(dr, "llvm"):
        raise BackendError(f"{fault or load_failure()}; {advice()}")
    version = _llvm_version(dr)[0]
    if version < MIN_VERSION:
        raise BackendError(f"{loaded_path()} is LLVM {version}, which is too old; {advice()}")
    return dr.llvm.ad


def name_of(module: ModuleType) -> str:
    """Return the name of the backend of a module from `select`, e.g. "llvm"."""
    return module.__name__.split(".")[1]


def backend_of(variant: str) -> str | None:
    """Return the backend of a Mitsuba variant such as ``llvm_ad_rgb``; None if it is scalar."""
    backend = variant.partition("_")[0]
    return backend if backend in BACKENDS else None


def _llvm_version(dr: ModuleType) -> tuple[int, ...]:
    """Return the version of the libLLVM that Dr.Jit has loaded."""
    return tuple(dr.detail.llvm_version())


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
    dr = import_drjit()
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
            "libllvm": ".".join(map(str, _llvm_version(dr))) if llvm else None,
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
    from importlib import metadata  # takes 20 ms

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def import_drjit() -> ModuleType:
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


PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""The environment variable from which Dr.Jit takes the path of libLLVM."""

MIN_VERSION = 18
"""The oldest major version of LLVM that is accepted. 15 and 16 end the process in `drjit.clip`, and
Dr.Jit 1.6 requires 18, as its changelog says."""

TESTED_VERSIONS = (19, 22)
"""Major versions that the tests ran with; they are preferred to all others."""

INSTALL_ADVICE = (
    f"install LLVM {MIN_VERSION} or newer: Debian, Ubuntu 'apt install libllvm19', Fedora "
    "'dnf install llvm-libs', macOS 'brew install llvm', Windows 'winget install LLVM.LLVM'"
)
"""What to do if no libLLVM works, for each operating system."""


class Library(NamedTuple):
    """A file of libLLVM.

    Attributes
    ----------
    path : str
    version : int or None
        Major version, read from the file name; None if the name has none, as on Windows.
    """

    path: str
    version: int | None

    @property
    def usable(self) -> bool:
        """Whether the version is at least `MIN_VERSION`, or unknown."""
        return self.version is None or self.version >= MIN_VERSION


def candidates() -> list[Library]:
    """Find the LLVM libraries on this machine by their file names, without loading them.

    Returns
    -------
    list of Library
        One entry for each file: tested versions first, then the others, both from newest to
        oldest. Unknown versions come last.
    """
    libraries: dict[str, Library] = {}
    for pattern in _patterns():
        for path in sorted(glob.glob(pattern)):
            real = os.path.realpath(path)
            # A small file with this name is a linker script.
            if os.path.isfile(real) and os.path.getsize(real) > 1_000_000:
                libraries.setdefault(real, _library(path))
    return sorted(
        libraries.values(),
        key=lambda library: (library.version not in TESTED_VERSIONS, -(library.version or 0)),
    )


def _usable() -> list[str]:
    """Return the paths of the usable libraries in the order of `candidates`."""
    return [library.path for library in candidates() if library.usable]


def select_libllvm() -> None:
    """Set `PATH_VARIABLE` to the first usable library of `candidates`, without loading it.

    The function does nothing if the variable is set, Dr.Jit is imported already, or no library is
    usable. It runs when the package is imported.
    """
    if os.environ.get(PATH_VARIABLE) or "drjit" in sys.modules:
        return
    for path in _usable()[:1]:
        os.environ[PATH_VARIABLE] = path


def _patterns() -> list[str]:
    """Return the file patterns of libLLVM on this operating system."""
    conda = os.environ.get("CONDA_PREFIX")
    if sys.platform == "win32":
        names, inside = ["LLVM-C.dll"], r"\Library\bin"
        folders = [os.environ.get("PROGRAMFILES", r"C:\Program Files") + r"\LLVM\bin"]
    elif sys.platform == "darwin":
        names, inside = ["libLLVM*.dylib"], "/lib"
        folders = ["/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib"]
        folders += ["/opt/local/libexec/llvm-*/lib"]
    else:
        names, inside = ["libLLVM.so*", "libLLVM-*.so*"], "/lib"
        multiarch = f"/usr/lib/{platform.machine()}-linux-gnu"
        folders = ["/usr/lib/llvm-*/lib", multiarch, "/usr/lib64", "/usr/lib64/llvm*/lib"]
        folders += ["/usr/lib", "/usr/local/lib"]
        folders += filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(":"))
    folders += [conda + inside] if conda else []
    return [os.path.join(folder, name) for folder in folders for name in names]


def _library(path: str) -> Library:
    """Read the version from the name of a file, or from the name of the target of a link."""
    return Library(path, _version_in(path) or _version_in(os.path.realpath(path)))


def _version_in(path: str) -> int | None:
    """Read the major version from ``libLLVM.so.19.1``, ``libLLVM-15.so`` or ``llvm@18/lib/...``."""
    name = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", os.path.basename(path))
    folder = re.search(r"llvm(?:[@-]?|/)(\d+)(?:\.[\d.]*)?[/\\]lib", path, re.IGNORECASE)
    match = name or folder
    return int(match.group(1)) if match else None


def too_old() -> str | None:
    """Return a message if the file name of the library at `PATH_VARIABLE` has an old version.

    Loading a library only to reject it may crash the process, and takes minutes on a cold disk.
    """
    library = _library(os.environ.get(PATH_VARIABLE, ""))
    if library.usable:
        return None
    return f"{library.path} (from {PATH_VARIABLE}) is LLVM {library.version}, which is too old"


def load_failure() -> str:
    """Return a message that names the libLLVM that Dr.Jit rejected, or says that none was found."""
    path = os.environ.get(PATH_VARIABLE)
    if not path:
        names = ", ".join(library.path for library in candidates())
        return f"no libLLVM is new enough for Dr.Jit ({names})" if names else "no libLLVM was found"
    fault = "is not a libLLVM" if os.path.exists(path) else "does not exist"
    return f"{path} (from {PATH_VARIABLE}) {fault}"


def advice() -> str:
    """Return what to do, for a message: use another library of this machine, or install one."""
    failed = os.path.realpath(os.environ.get(PATH_VARIABLE) or loaded_path() or "")
    for path in _usable():
        if os.path.realpath(path) != failed:
            return f"set {PATH_VARIABLE}={path} before drjit is imported, or {INSTALL_ADVICE}"
    return INSTALL_ADVICE


def loaded_path() -> str | None:
    """Return the path of the libLLVM in use.

    Returns
    -------
    str or None
        On Linux the file that the process has loaded, or None; on other systems the value of
        `PATH_VARIABLE`, or None.
    """
    configured = os.environ.get(PATH_VARIABLE)
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return configured
    loaded = sorted({line.split(maxsplit=5)[5] for line in lines if "libLLVM" in line})
    if configured and os.path.realpath(configured) in loaded:
        return configured
    return loaded[0] if loaded else None
