"""The libLLVM that Dr.Jit loads: find one that works and name it before the import.

Dr.Jit looks for libLLVM while it is being imported: at ``DRJIT_LIBLLVM_PATH`` if that is set, else
for the system's ``libLLVM.so`` and then in ``/usr/lib``. The one it finds may be too old: version
14 is refused, 15 and 16 are accepted and then end the process at the first ``dr.clip``.
`select_libllvm` therefore names a newer one before the import.
"""

import glob
import os
import platform
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""The environment variable by which Dr.Jit is told which libLLVM to load."""


MIN_VERSION = 17
"""The oldest major version of LLVM accepted."""

TESTED_VERSIONS = (19, 22)
"""Versions that the tests were run with; they are preferred to all others."""


INSTALL_ADVICE = (
    f"install LLVM {MIN_VERSION} or newer: Debian, Ubuntu 'apt install libllvm19', Fedora "
    "'dnf install llvm-libs', macOS 'brew install llvm', Windows 'winget install LLVM.LLVM'"
)
"""What to do where no libLLVM works, by operating system."""


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
        return self.version is None or self.version >= MIN_VERSION


def candidates() -> list[Library]:
    """Find the LLVM libraries of this machine by their file names, without loading any.

    Returns
    -------
    list of Library
        One entry a file: tested versions first, then the newest first, unknown versions last.
    """
    found: dict[str, Library] = {}
    for pattern in _patterns():
        for path in sorted(glob.glob(pattern)):
            real = os.path.realpath(path)
            # A small file of that name is a linker script, not the library.
            if os.path.isfile(real) and os.path.getsize(real) > 1_000_000:
                found.setdefault(real, Library(path, _version_in(path) or _version_in(real)))
    return sorted(found.values(), key=_preference)


def _preference(library: Library) -> tuple[bool, int]:
    """Sort key: tested versions first, the newest of each group first."""
    return library.version not in TESTED_VERSIONS, -(library.version or 0)


def select_libllvm() -> None:
    """Point Dr.Jit to a libLLVM that works, see `candidates`; called when the package is imported.

    Sets `PATH_VARIABLE` where it is unset, Dr.Jit is not imported yet and a usable library is
    found. Loads nothing.
    """
    if os.environ.get(PATH_VARIABLE) or "drjit" in sys.modules:
        return
    library = next(_usable(), None)
    if library:
        os.environ[PATH_VARIABLE] = library.path


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


def _usable() -> Iterator[Library]:
    """The candidates that work, in the order of `candidates`."""
    return (library for library in candidates() if library.usable)


def load_failure() -> str:
    """Say which libLLVM Dr.Jit refused, or that there is none."""
    asked = os.environ.get(PATH_VARIABLE)
    if not asked:
        names = ", ".join(library.path for library in candidates())
        return f"no libLLVM is new enough for Dr.Jit ({names})" if names else "no libLLVM was found"
    if not os.path.exists(asked):
        return f"{asked} (from {PATH_VARIABLE}) does not exist"
    version = _version_in(asked) or _version_in(os.path.realpath(asked))
    fault = f"is LLVM {version}, which Dr.Jit refuses" if version else "is no libLLVM"
    return f"{asked} (from {PATH_VARIABLE}) {fault}"


def advice() -> str:
    """What to do about a libLLVM that does not work: take another that is here, or install one."""
    failed = os.path.realpath(os.environ.get(PATH_VARIABLE) or loaded_path() or "")
    others = (library.path for library in _usable() if os.path.realpath(library.path) != failed)
    other = next(others, None)
    return (
        f"set {PATH_VARIABLE}={other} before drjit is imported, or {INSTALL_ADVICE}"
        if other
        else INSTALL_ADVICE
    )


def loaded_path() -> str | None:
    """Which libLLVM is loaded: what the system says, which only Linux does, else what was asked."""
    asked = os.environ.get(PATH_VARIABLE)
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return asked
    loaded = sorted({line.split(maxsplit=5)[5] for line in lines if "libLLVM" in line})
    if asked and os.path.realpath(asked) in loaded:
        return asked
    return loaded[0] if loaded else None
