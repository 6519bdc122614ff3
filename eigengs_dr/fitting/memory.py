"""The memory that a fit takes, said before it starts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ..image.strips import MAX_THREADS, STRIP_PIXELS, available_cores
from .schedule import MAX_SURPLUS, MAX_SURPLUS_DENSITY

BASE_BYTES = 130e6
"""Memory of Python, libLLVM and the compiled programs. This and the constants below follow the
largest resident memory of processes that fit a mosaic of photos with the backend llvm on 2 cores,
10 steps:

| image | channels | Gaussians | measured | estimated |
|---|---|---|---|---|
| 512x512 | 3 | 20,000 | 0.20 GB | 0.21 GB |
| 1,024x1,024 | 3 | 80,000 | 0.38 GB | 0.44 GB |
| 2,048x2,048 | 3 | 20,000 | 0.64 GB | 0.63 GB |
| 2,048x2,048 | 3 | 320,000 | 0.88 GB | 0.84 GB |
| 2,048x2,048 | 1 | 320,000 | 0.63 GB | 0.65 GB |
| 4,000x3,000 | 3 | 5,000 | 1.17 GB | 1.17 GB |
| 4,096x4,096 | 3 | 1,280,000 | 2.37 GB | 2.43 GB |

Rows of equal size give `BYTES_PER_GAUSSIAN` and `BYTES_PER_VALUE`, the two largest sizes
`BYTES_PER_PIXEL`, and the others `BYTES_PER_STRIP_PIXEL`."""

BYTES_PER_STRIP_PIXEL = 170.0
"""Memory of the temporary arrays of a placement, for each pixel of the strips under way."""

BYTES_PER_PIXEL = 5.0
"""Memory of the density and of the lists of tiles, for each pixel."""

BYTES_PER_VALUE = 22.0
"""Memory of the images, for each pixel and channel: between 5 and 6 images in single precision."""

BYTES_PER_GAUSSIAN = 730.0
"""Memory of the parameters, of the colour solve and of the lists, for each Gaussian. A fit of
130,000 Gaussians on 2,048x2,048 pixels takes 65 MB more with as many in addition than without."""


def estimate_memory(width: int, height: int, channels: int, gaussians: int) -> int:
    """Estimate the largest memory of a process that fits one image.

    Parameters
    ----------
    width, height : int
        Size of the image in pixels.
    channels : int
    gaussians : int

    Returns
    -------
    int
        Bytes, to about a sixth for sets that `eigengs_dr.fit` places. Large Gaussians touch more
        tiles and take more. It counts the largest surplus, which short fits do not have.
    """
    pixels = width * height
    in_strips = min(pixels, STRIP_PIXELS * min(MAX_THREADS, available_cores()))
    with_surplus = min((1 + MAX_SURPLUS) * gaussians, MAX_SURPLUS_DENSITY * pixels)
    return round(
        BASE_BYTES
        + in_strips * BYTES_PER_STRIP_PIXEL
        + pixels * (BYTES_PER_PIXEL + channels * BYTES_PER_VALUE)
        + max(gaussians, with_surplus) * BYTES_PER_GAUSSIAN
    )


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


def check_memory(width: int, height: int, channels: int, gaussians: int) -> str:
    """Say in one line how much memory a fit takes.

    For the parameters see `estimate_memory`.

    Raises
    ------
    ValueError
        If this process may use less memory: one line that says so and what to do.
    """
    needed, usable = estimate_memory(width, height, channels, gaussians), usable_memory()
    line = (
        f"{gaussians:,} Gaussians on {width}x{height} pixels take about {needed / 1e9:.1f} GB "
        "of memory"
    )
    if usable is not None and needed > usable:
        raise ValueError(
            f"{line}, this process may use {usable / 1e9:.1f} GB: "
            "scale the image down or use fewer Gaussians"
        )
    return line
