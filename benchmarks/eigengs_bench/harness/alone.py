"""Measurements in a process of their own, which have the peak of their memory alone."""

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from eigengs_bench.harness.store import Row

STATUS = Path("/proc/self/status")  # of Linux


def measure_alone(title: str, work: Callable[..., Row], *arguments: Any) -> Row:
    """Call `work` in a new process; `ValueError` names what is measured if memory runs out."""
    try:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            return pool.submit(work, *arguments).result()
    except BrokenProcessPool:
        raise ValueError(
            f"{title}: its process was ended, as it is where memory runs out; "
            "free some, or leave the case out"
        ) from None


def peak_gib() -> float | None:
    """Most memory of this process so far, in GiB; None on Windows."""
    if sys.platform == "win32":
        return None
    if STATUS.exists():  # the figure of getrusage includes the process that started this one
        lines = (line.split() for line in STATUS.read_text().splitlines())
        return next(int(line[1]) / (1 << 20) for line in lines if line[0] == "VmHWM:")
    import resource

    unit = 30 if sys.platform == "darwin" else 20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << unit)
