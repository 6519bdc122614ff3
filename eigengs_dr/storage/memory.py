"""The memory that this process may use, and the limit for the content of one file."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

SETTING = "EIGENGS_DR_MAX_FILE_MB"
"""Environment variable: megabytes of memory that the content of one file may take."""

ALWAYS, TIMES_FILE = 512 << 20, 100
"""Bytes of memory that any file may take, and the multiple of its size that a larger file may take.
As floats, an 8-bit photo takes 8 times the size of its PNG and up to 60 times that of its JPEG; a
TIFF of 2 MB can claim 8 GB."""


MAX_STREAM = 1 << 30
"""Largest number of bytes of a pipe, which is copied to disk."""


def usable_memory(root: Path = Path("/")) -> int | None:
    """Return the bytes of memory that this process may use, or None if they are unknown.

    This is the memory of the machine, or less in a container or in a job of a batch system: Linux
    limits the memory of a control group (version 1 or 2) and of its parents; and Unix the addresses
    of a process (``ulimit -v``).

    Parameters
    ----------
    root : Path, optional
        The root of the file system with ``proc`` and ``sys``.
    """
    try:
        installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # Windows has no `sysconf`
        return None
    return min([installed, *_address_limits(), *_group_limits(root)])


def _address_limits() -> Iterator[int]:
    """Yield the limit of the addresses of this process, if there is one."""
    import resource  # Windows has none

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY:
        yield limit


def _group_limits(root: Path) -> Iterator[int]:
    """Yield the visible memory limits of the control groups of this process."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            mount, name = root / "sys/fs/cgroup", "memory.max"
        elif "memory" in controllers.split(","):
            mount, name = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
        else:
            continue
        group = mount / path.lstrip("/")
        # A container may only see its own group, at the mount point.
        for folder in [group, *group.parents]:
            with suppress(OSError, ValueError):  # no such file, or "max"
                yield int((folder / name).read_text())
            if folder == mount:
                break


def check_content(path: str | os.PathLike[str], needed: int) -> None:
    """Check that the content of a file fits into memory, before any of it is allocated.

    Parameters
    ----------
    path : path-like
        The file.
    needed : int
        Bytes that its content takes in memory; for an image, those of its pixels as floats.

    Raises
    ------
    ValueError
        If that is more than `ALWAYS` and more than `TIMES_FILE` times the size of the file, or
        more than half of `usable_memory`. One line names the variable that raises the limit.
    """
    limit = _setting()
    if limit is None:
        limit = max(ALWAYS, TIMES_FILE * os.stat(path).st_size)
        limit = min(limit, (usable_memory() or limit * 2) // 2)
    if needed > limit:
        raise ValueError(
            f"{path}: takes {needed / 1e6:,.0f} MB in memory, the limit is {limit / 1e6:,.0f} MB; "
            f"if you trust the file, set {SETTING}={(needed >> 20) + 1}"
        )


def check_usable(needed: float, what: str, advice: str) -> None:
    """Raise ValueError, in one line, if something takes more memory than `usable_memory`.

    Parameters
    ----------
    needed : float
        Bytes.
    what : str
        What takes them, in the plural.
    advice : str
        What to do.
    """
    usable = usable_memory()
    if usable is not None and needed > usable:
        raise ValueError(
            f"{what} take about {needed / 1e9:.1f} GB of memory, but this process may use "
            f"{usable / 1e9:.1f} GB; {advice}"
        )


def open_regular(path: str | os.PathLike[str], once: bool = False) -> BinaryIO:
    """Open a file for reading; raise ValueError for a device or a pipe, which may have no end.

    With `once`, a pipe that this process holds, such as ``/dev/stdin``, is opened too.
    """
    kind = os.stat(path).st_mode
    is_held = once and stat.S_ISFIFO(kind) and os.fspath(path).startswith(("/dev/", "/proc/"))
    if not (is_held or stat.S_ISREG(kind) or stat.S_ISDIR(kind)):  # `open` refuses a folder
        raise ValueError(f"{path}: is a device or a pipe; give a file")
    return open(path, "rb")


def stream_limit() -> int:
    """Return the largest size of a pipe in bytes: `SETTING`, or `MAX_STREAM`."""
    return _setting() or MAX_STREAM


def _setting() -> int | None:
    """Return the value of the environment variable in bytes, or None."""
    text = os.environ.get(SETTING, "")
    if text and not (text.isdecimal() and int(text)):
        raise ValueError(f"{SETTING} is {text!r}; set a whole number of MB, or unset it")
    return int(text) << 20 if text else None
