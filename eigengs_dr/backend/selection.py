"""Pick llvm or cuda, and a libLLVM that works before Dr.Jit loads one.

Dr.Jit looks for libLLVM while it is being imported: at ``DRJIT_LIBLLVM_PATH`` if that is set, else
for the system's ``libLLVM.so`` and then in ``/usr/lib``. What it finds there may be too old:
version 14 is refused, 15 and 16 are accepted and then end the process at the first ``dr.clip``. So
`prepare` names a newer one before the import, and `select` refuses to go on without.
"""

import glob
import importlib
import importlib.metadata
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

VARIABLE = "DRJIT_LIBLLVM_PATH"
"""The environment variable by which Dr.Jit is told which libLLVM to load."""

OLDEST = 17
"""The oldest major version of LLVM accepted; 19 and 22 are tested."""

ADVICE = (
    f"install LLVM {OLDEST} or newer: Debian, Ubuntu 'apt install libllvm19', Fedora 'dnf install "
    "llvm-libs', macOS 'brew install llvm', Windows 'winget install LLVM.LLVM'"
)
"""What to do where no libLLVM works, by operating system."""


class BackendError(RuntimeError):
    """A backend that is not there; the message is one line that says what to install."""


class Library(NamedTuple):
    """A libLLVM on the disk.

    Attributes
    ----------
    path : str
        Where it was found.
    version : int or None
        Major version, as far as file names tell: those on Windows do not.
    """

    path: str
    version: int | None

    @property
    def usable(self) -> bool:
        """Whether Dr.Jit works with it; an unknown version gets the benefit of the doubt."""
        return self.version is None or self.version >= OLDEST


def candidates() -> list[Library]:
    """Find the LLVM libraries of this machine by their file names, without loading any.

    Returns
    -------
    list of Library
        One entry a file, the newest first, those of unknown version last.
    """
    found: dict[str, Library] = {}
    for pattern in _patterns():
        for path in sorted(glob.glob(pattern)):
            real = os.path.realpath(path)
            # A small file of that name is a linker script, not the library.
            if os.path.isfile(real) and os.path.getsize(real) > 1_000_000:
                found.setdefault(real, Library(path, _version_in(path) or _version_in(real)))
    return sorted(found.values(), key=lambda library: -(library.version or 0))


def prepare() -> None:
    """Point Dr.Jit to the newest libLLVM that works; called when the package is imported.

    Sets `VARIABLE` where it is unset, Dr.Jit is not imported yet and a usable library is found.
    Loads nothing.
    """
    if os.environ.get(VARIABLE) or "drjit" in sys.modules:
        return
    newest = next(_usable(), None)
    if newest:
        os.environ[VARIABLE] = newest.path


def select(backend: str | None = None) -> ModuleType:
    """Return the module of a backend's differentiable array types.

    Parameters
    ----------
    backend : {"llvm", "cuda"}, optional
        The backend. By default "cuda" where there is a GPU, else "llvm".

    Returns
    -------
    module
        ``drjit.llvm.ad`` or ``drjit.cuda.ad``.

    Raises
    ------
    BackendError
        If the backend is not there, its libLLVM would end the process, or Dr.Jit cannot be
        imported. One line that says what to install.
    ValueError
        If `backend` is another name.

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
        return dr.cuda.ad
    if backend == "cuda":
        raise BackendError("no CUDA GPU or driver was found; use backend 'llvm'")
    if not dr.has_backend(dr.JitBackend.LLVM):
        raise BackendError(f"{_why_not_loaded()}; {_advice()}")
    version = dr.detail.llvm_version()[0]
    if version < OLDEST:
        raise BackendError(f"{_loaded_path()} is LLVM {version}, which crashes Dr.Jit; {_advice()}")
    return dr.llvm.ad


def describe(backend: str | None = None) -> dict[str, Any]:
    """Say what a figure was measured with.

    Parameters
    ----------
    backend : {"llvm", "cuda"}, optional
        As for `select`.

    Returns
    -------
    dict
        ``backend``; ``threads``, those of the llvm backend; ``cpu``, its model; ``platform``; and
        ``versions`` of eigengs_dr, drjit, numpy and python, with ``libllvm`` and ``libllvm_path``,
        both None where none is loaded.

    Raises
    ------
    BackendError
        As `select` does.
    """
    module = select(backend)
    import drjit as dr

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
            "libllvm": ".".join(map(str, dr.detail.llvm_version())) if llvm else None,
            "libllvm_path": _loaded_path() if llvm else None,
        },
    }


def version_of(package: str) -> str | None:
    """Version of an installed package.

    Parameters
    ----------
    package : str
        Its name on the package index.

    Returns
    -------
    str or None
        None where it is not installed.
    """
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _patterns() -> list[str]:
    """Where a libLLVM may lie, by operating system."""
    conda = os.environ.get("CONDA_PREFIX", "")
    if sys.platform == "win32":
        folders = [os.environ.get("PROGRAMFILES", r"C:\Program Files") + r"\LLVM\bin"]
        names = ["LLVM-C.dll"]
        folders += [conda + r"\Library\bin"] if conda else []
    elif sys.platform == "darwin":
        prefixes = ["/opt/homebrew/opt/llvm*", "/usr/local/opt/llvm*", "/opt/local/libexec/llvm-*"]
        folders = [prefix + "/lib" for prefix in prefixes] + ([conda + "/lib"] if conda else [])
        names = ["libLLVM*.dylib"]
    else:
        multiarch = f"/usr/lib/{platform.machine()}-linux-gnu"
        folders = ["/usr/lib/llvm-*/lib", multiarch, "/usr/lib64", "/usr/lib64/llvm*/lib"]
        folders += ["/usr/lib", "/usr/local/lib"] + ([conda + "/lib"] if conda else [])
        folders += filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(":"))
        names = ["libLLVM.so*", "libLLVM-*.so*"]
    return [os.path.join(folder, name) for folder in folders for name in names]


def _version_in(path: str) -> int | None:
    """Read the major version from ``libLLVM.so.19.1``, ``libLLVM-15.so`` or ``llvm@18/lib/...``."""
    name = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", os.path.basename(path))
    folder = re.search(r"llvm(?:[@-]?|/)(\d+)[^/\\]*[/\\]lib", path, re.IGNORECASE)
    found = name or folder
    return int(found.group(1)) if found else None


def _import_drjit() -> ModuleType:
    """Import Dr.Jit; its wheel needs a library that bare systems lack, and says so badly."""
    try:
        with _silent_stderr():
            return importlib.import_module("drjit")
    except (ImportError, NameError) as error:
        reason = error.__context__ or error
        raise BackendError(
            f"Dr.Jit cannot be imported ({reason}); where libatomic is missing, install it: "
            "Debian, Ubuntu 'apt install libatomic1', Fedora 'dnf install libatomic'"
        ) from error


def _usable() -> Iterator[Library]:
    """The candidates that work, the newest first."""
    return (library for library in candidates() if library.usable)


def _why_not_loaded() -> str:
    """Say which libLLVM Dr.Jit refused, or that there is none."""
    asked = os.environ.get(VARIABLE)
    if not asked:
        names = ", ".join(library.path for library in candidates())
        return f"no libLLVM is new enough for Dr.Jit ({names})" if names else "no libLLVM was found"
    if not os.path.exists(asked):
        return f"{asked} (from {VARIABLE}) does not exist"
    version = _version_in(asked) or _version_in(os.path.realpath(asked))
    fault = f"is LLVM {version}, which Dr.Jit refuses" if version else "is no libLLVM"
    return f"{asked} (from {VARIABLE}) {fault}"


def _advice() -> str:
    """What to do about a libLLVM that does not work: take another that is here, or install one."""
    failed = os.path.realpath(os.environ.get(VARIABLE) or _loaded_path() or "")
    others = (library.path for library in _usable() if os.path.realpath(library.path) != failed)
    other = next(others, None)
    return f"set {VARIABLE}={other} before drjit is imported, or {ADVICE}" if other else ADVICE


def _loaded_path() -> str | None:
    """Which libLLVM is loaded: what the system says, which only Linux does, else what was asked."""
    asked = os.environ.get(VARIABLE)
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return asked
    loaded = sorted({line.split(maxsplit=5)[5] for line in lines if "libLLVM" in line})
    if asked and os.path.realpath(asked) in loaded:
        return asked
    return loaded[0] if loaded else None


def _cpu_model() -> str:
    """Model of the processor, as Linux names it; elsewhere the architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor()
    model = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return model.group(1) if model else platform.machine()


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Keep Dr.Jit's own lines on a libLLVM that fails off the terminal: ours says what to do."""
    if "drjit" in sys.modules:
        yield
        return
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)
