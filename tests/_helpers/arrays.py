"""Arrays in memory of Dr.Jit, which is aligned: for that of NumPy, each run compiles anew."""

import drjit as dr
import numpy as np


def upload_rows(kind, rows):
    """Copies of flat arrays, as a list of arrays of a kind."""
    targets = []
    for values in rows:
        target = dr.empty(kind, len(values))
        if dr.backend_v(kind) == dr.JitBackend.LLVM:
            target.numpy()[:] = values  # a view
        else:
            target = kind(np.ascontiguousarray(values))
        targets.append(target)
    dr.eval(targets)
    dr.sync_thread()
    return targets
