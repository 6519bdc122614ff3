"""The kernels that Dr.Jit launches."""

from contextlib import contextmanager
from types import SimpleNamespace

import drjit as dr


@contextmanager
def launches():
    """Collect what a block launches, with the attributes ``type``, ``hash`` and more."""
    found = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        yield found
        found += [SimpleNamespace(**launch) for launch in dr.kernel_history()]


def jit(launched):
    """Return the launches of compiled kernels, as others have no hash."""
    return [launch for launch in launched if launch.type == dr.KernelType.JIT]
