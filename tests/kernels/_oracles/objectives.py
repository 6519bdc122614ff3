"""Objectives of images, and sets that were placed for them."""

import numpy as np

import eigengs_dr as eg
from _helpers.halves import picture
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.channels import Channels, Target
from eigengs_dr.fitting.objective import Pixels, squares_of
from eigengs_dr.image.space import space_of


def objective_of(image, backend=None, space="ycbcr"):
    """The squared error of an RGB image in a space of colours."""
    known = space_of(space)
    target = Target.of(np.asarray(image, np.float32), known)
    shown = [Channels("", known, slice(0, target.pixels.shape[2]), (target,))]
    return squares_of(shown, types_in(select(backend)))


def objective_for(gaussians, target, weight=None):
    """The squared error of an image (H, W, C) in the space of a set, with weights."""
    return Pixels.plain(target, gaussians, weight)


def fitted(count=60):
    """Placed Gaussians with the best colours for a picture, and the objective, in YCbCr."""
    objective = objective_of(picture())
    return eg.DEFAULT.place_and_solve(objective, count), objective
