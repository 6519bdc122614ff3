"""Parameters of Gaussians for lists of tiles."""

import numpy as np

from _helpers.sets import SIZE
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.raster.binning.tiles import Grid

RADIUS = 3.0

GRID = Grid(*SIZE)


def upload(backend, mean, factor):
    types = types_in(select(backend))
    return [types.Float(np.ascontiguousarray(v, np.float32)) for v in (*mean.T, *factor.T)]
