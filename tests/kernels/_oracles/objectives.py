"""Objectives of images."""

import numpy as np

from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.channels import Channels, Target
from eigengs_dr.fitting.objective import squares_of
from eigengs_dr.image.space import space_of


def objective_of(image, backend=None, space="ycbcr"):
    """The squared error of an RGB image in a space of colours."""
    known = space_of(space)
    target = Target.of(np.asarray(image, np.float32), known)
    shown = [Channels("", known, slice(0, target.pixels.shape[2]), (target,))]
    return squares_of(shown, types_in(select(backend)))
