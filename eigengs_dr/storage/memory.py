"""How much memory this process may use, and how much of it one file may take."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

SETTING = "EIGENGS_DR_MAX_FILE_MB"
"""Environment variable: megabytes that the content of one file may take in memory."""

ALWAYS, TIMES_FILE = 512 << 20, 100
"""Bytes that any file may take, and how many times its own size a larger one may. A photo of 8 bits
takes 8 times its PNG, and up to 60 times its JPEG, as floats; a TIFF of 2 MB can claim 8 GB."""


MAX_DOWNLOAD = 1 << 30
"""Bytes of a file behind a URL or of a pipe; they are copied to the disk."""


def usable_memory(root: Path = Path("/")) -> int | None:
    """Return the bytes of memory that this process may use, or None if the system does not say.

    They are those of the machine, or fewer in a container, or in a job of a batch system: Linux
    limits the memory of a control group and of the groups that it lies in, by version 1 or 2.

    Parameters
    ----------
    root : Path, optional
        The root of the file system with ``proc`` and ``sys``.
    """
    try:
        installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # Windows has no `sysconf`
        return None
    return min([installed, *_group_limits(root)])


def _group_limits(root: Path) -> Iterator[int]:
    """Yield the limits of the control groups of this process that are visible from here."""
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
        # A container may see its own group alone, at the mount, and not the path to it.
        for folder in [group, *group.parents]:
            with suppress(OSError, ValueError):  # no such file, or "max"
                yield int((folder / name).read_text())
            if folder == mount:
                break


def check_content(path: str | os.PathLike[str], needed: int) -> None:
    """Check that the content of a file may be read, before any of it is allocated.

    Parameters
    ----------
    path : path-like
        The file.
    needed : int
        Bytes that its content takes in memory; of an image, those of its pixels as floats.

    Raises
    ------
    ValueError
        If that is more than `ALWAYS` and `TIMES_FILE` times the size of the file, or more than half
        of `usable_memory`. One line names the variable that raises the limit.
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


def download_limit() -> int:
    """Return the bytes that a download or a pipe may have: as `SETTING` says, or `MAX_DOWNLOAD`."""
    return _setting() or MAX_DOWNLOAD


def _setting() -> int | None:
    """Return the bytes that the environment variable says."""
    text = os.environ.get(SETTING, "")
    return int(text) << 20 if text.isdecimal() else None
