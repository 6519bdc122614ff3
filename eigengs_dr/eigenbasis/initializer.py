"""The initialiser "eigen": a fit starts from the shapes and colours of a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..fitting.descent import FitProblem
from ..fitting.options import DEFAULT_BASIS, FitOptions
from ..fitting.solvers.conjugate_gradient import solve
from ..fitting.start import control_for
from ..fitting.target import FitTarget
from ..gaussian.gaussians import Gaussians
from ..image.color import decode
from ..image.planes import BASIS_SPACES
from .eigengs import EigenGS
from .registry import load_basis


def start_from_basis(target: FitTarget, options: FitOptions) -> FitProblem:
    """Take shapes and colours from a model.

    Raises
    ------
    ValueError
        If the model and the options differ in the number of Gaussians, space or backend.
    """
    model = load_basis(options.basis or DEFAULT_BASIS, options.backend, options.gaussians)
    _check_basis(model, target.pixels, options.gaussians, options.space)
    encoded = _encode(model, target, options)
    if options.method.mean != "dense":
        return FitProblem(encoded, target.values, target.weight, control_for(target, options))
    dense = model.dense_mean(encoded.width, encoded.height)
    base_image = _picture(dense, options.space)
    return FitProblem(encoded, target.values - dense, target.weight, base_image=base_image)


def _encode(model: EigenGS, target: FitTarget, options: FitOptions) -> Gaussians:
    solves = options.method.solves
    colors = "exact" if solves else "projected"
    start = model.encode(target.pixels, colors, options.method.mean).bounded()
    start = replace(start, cutoff=float(options.cutoff))
    same = (start.width, start.height) == (model.gaussians.width, model.gaussians.height)
    same &= start.cutoff == model.gaussians.cutoff
    # At another size or cutoff the colours are not exact.
    if solves and not same:
        return solve(start, target.values, options.solve_steps, warm_start=True).gaussians
    return start


def _picture(planes: NDArray[np.float32], space: str) -> NDArray[np.float32]:
    """Return the RGB that planes add to a rendering, which already holds the RGB of zeros."""
    rgb = np.stack(decode(space, list(np.moveaxis(planes, 2, 0))), axis=2)
    return rgb - np.array(decode(space, [0.0] * planes.shape[2]), np.float32)


def _check_basis(
    model: EigenGS, pixels: NDArray[np.float32], gaussians: int | None, space: str
) -> None:
    """Raise ValueError unless a basis fits the image and the options."""
    count, of_basis = len(model.gaussians), model.gaussians.space
    if gaussians not in (None, count):
        raise ValueError(
            f"gaussians is {gaussians}, but the basis has {count}; leave the number out, use "
            f"init 'adaptive', or train a basis with --gaussians {gaussians}"
        )
    height, width = pixels.shape[:2]
    if count > width * height:
        raise ValueError(
            f"the basis has {count} Gaussians, more than an image of {width}x{height} has pixels; "
            "use init 'adaptive'"
        )
    if space != of_basis:
        advice = f"train a basis with --space {space}" if space in BASIS_SPACES else "another init"
        raise ValueError(
            f"space is {space!r}, but the basis is in {of_basis!r}; use space "
            f"{of_basis!r}, or {advice}"
        )
