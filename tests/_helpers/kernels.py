"""The kernels that Dr.Jit launches, in its versions before and after 1.6."""

from contextlib import contextmanager
from types import SimpleNamespace

import drjit as dr


@contextmanager
def launches(history=dr.kernel_history):
    """Collect what a block launches; each launch has the attributes ``type``, ``hash``, and more.

    In Dr.Jit 1.6 the history is a context manager of such launches, and a call of it as in 1.5, for
    dictionaries, is deprecated.
    """
    found = []
    if isinstance(history, type):
        with history() as launched:
            yield found
        found += launched
    else:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            yield found
            found += [SimpleNamespace(**launch) for launch in history()]


def jit(launched):
    """Return the launches of compiled kernels, as others have no hash."""
    return [launch for launch in launched if launch.type == dr.KernelType.JIT]
