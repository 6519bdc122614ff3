"""The state of a descent: what a step of gradient descent changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ...backend.arrays import types_of, upload
from ...gaussian.gaussians import Gaussians
from ...raster.layout import pack_parameters
from ...raster.parameters import kernel_shape
from .schedule import Schedule, agility_of


@dataclass(frozen=True)
class Descent:
    """The state of a descent.

    Attributes
    ----------
    variables : dict of str to arrays
        The variables that the optimiser moves.
    moments : dict of str to tuple
        The state of the optimiser for each variable.
    gaussians : Gaussians or None
        The set of these variables. A step does not need it, and each array that a frozen program
        gets costs a microsecond.
    packed : Float
        The parameters of this set for the kernels.
    agility : Float or None
        Factor of the learning rates of means and shapes, one for each Gaussian.
    """

    variables: dict[str, Any]
    moments: dict[str, tuple]
    gaussians: Any
    packed: Any
    agility: Any = None


def start_descent(gaussians: Gaussians, schedule: Schedule, images: int = 1) -> Descent:
    """Return the state before the first step, for the Gaussians of one image after another."""
    encoded, optimizer = schedule.variables().encode(gaussians), schedule.make_optimizer()
    variables = {name: dr.detach(encoded[name]) for name in schedule.rates}
    dr.eval(variables)
    moments = {name: optimizer.start(value) for name, value in variables.items()}
    agility, Float = None, types_of(gaussians.mean).Float
    if schedule.agility:
        rows = [np.broadcast_to(row.numpy(), len(gaussians)) for row in gaussians.color]
        color = np.stack(rows, axis=1).reshape(images, -1, len(rows))
        agility = upload(Float, agility_of(color, schedule.agility).ravel())
    return Descent(variables, moments, gaussians, pack(gaussians), agility)


def pack(gaussians: Gaussians) -> Any:
    """Return the parameters of a set for the kernels, in their layout in memory."""
    return pack_parameters([*kernel_shape(gaussians), *gaussians.color])
