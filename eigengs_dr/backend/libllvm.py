"""Choice of the libLLVM that Dr.Jit loads.

Dr.Jit looks for libLLVM while it is imported: first at ``DRJIT_LIBLLVM_PATH``, then for the
system's ``libLLVM.so``, then in ``/usr/lib``. That library may be too old: Dr.Jit rejects version
14, and accepts versions 15 and 16 although these crash at the first ``dr.clip``. Therefore
`select_libllvm` sets the variable to a newer library before the import.
"""

import glob
import os
import platform
import re
import sys
from pathlib import Path
from typing import NamedTuple

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""The environment variable from which Dr.Jit takes the path of libLLVM."""

MIN_VERSION = 17
"""The oldest major version of LLVM that is accepted."""

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
    return (
        f"{library.path} (from {PATH_VARIABLE}) is LLVM {library.version}, which Dr.Jit cannot use"
    )


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
