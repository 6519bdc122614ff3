"""The frequency-aware split: which Gaussians serve which components, and whether to split."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...fitting.solvers.normal_equations import NormalEquations, squared_norms
from ...gaussian.gaussians import concatenate
from ...image.metrics import psnr_from_mse
from ...image.planes import to_planes
from ..pca.basis import Eigenbasis
from .shape_training import on_grid, shapes_of

Planes = NDArray[np.float32]

LOW_SHARE = 0.1
"""Share of the Gaussians that serve the low frequencies in a split (the paper)."""


LOW_COMPONENTS = 50
"""Number of components of each channel that are low frequencies (the authors' code); with fewer
than 100 components, it is half of them."""


SPLIT_FROM = 512
"""Smallest longer side, in pixels, at which "auto" considers the split. In the paper, the split
costs 0.4 to 0.8 dB at 256 pixels and gains 1 dB at 512."""


SPLIT_COST = 0.2
"""Largest loss of PSNR, in dB of exact colours, at which "auto" still splits."""


class FrequencyBand(NamedTuple):
    """A number of Gaussians and the components that they serve: all, or one side of the split."""

    splats: int
    components: tuple[Planes, ...]
    eigenvalues: tuple[NDArray[np.float64], ...]


def wants_split(
    basis: Eigenbasis, count: int, frequency_aware: bool | str, backend: str | None = None
) -> tuple[bool, dict[str, float]]:
    """Decide on the frequency-aware split; "auto" measures it for large images.

    From `SPLIT_FROM` pixels on, "auto" fits exact colours to the example images, with and without
    the split, and compares the PSNR. It accepts a loss of `SPLIT_COST`, because without coarse
    Gaussians, small Gaussians must render the low frequencies (the paper's "penny-round tiles").

    Returns
    -------
    bool
        Whether to split.
    dict of str to float
        ``psnr_whole`` and ``psnr_split`` in dB; empty without a measurement.
    """
    if count < 2 or low_component_count(basis) < 1:
        return False, {}
    if isinstance(frequency_aware, bool):
        return frequency_aware, {}
    if max(basis.width, basis.height) < SPLIT_FROM or not len(basis.examples):
        return False, {}
    images = np.stack([to_planes(image, basis.space) for image in basis.examples])
    planes = images.reshape(-1, basis.height, basis.width)
    figures = {}
    for name, split in (("psnr_whole", False), ("psnr_split", True)):
        counts = [side.splats for side in frequency_bands(basis, count, split)]
        size = (basis.width, basis.height)
        sets = [shapes_of(on_grid(size, n), size, 1, backend) for n in counts]
        equations = NormalEquations(concatenate(sets), counts[0] if split else 0)
        correlations = equations.correlate(planes)
        error = equations.error(equations.solve(correlations), correlations, squared_norms(planes))
        figures[name] = psnr_from_mse(float(error.mean()) / (basis.width * basis.height))
    return figures["psnr_split"] > figures["psnr_whole"] - SPLIT_COST, figures


def split_reason(
    basis: Eigenbasis, count: int, frequency_aware: bool | str, figures: dict[str, float]
) -> str:
    """Return the reason for the decision of `wants_split` in under 64 characters."""
    if count < 2 or low_component_count(basis) < 1:
        return "too few Gaussians or components to split"
    if isinstance(frequency_aware, bool):
        return "frequency_aware is set"
    if figures:
        whole, split = figures["psnr_whole"], figures["psnr_split"]
        return f"whole {whole:.2f} dB, split {split:.2f} dB, may cost {SPLIT_COST:g}"
    if (side := max(basis.width, basis.height)) < SPLIT_FROM:
        return f"{side} pixels a side; auto measures from {SPLIT_FROM} on"
    return "no training images to compare on"


def low_component_count(basis: Eigenbasis) -> int:
    """Return the number of components of each channel that are low frequencies."""
    return min(LOW_COMPONENTS, max(map(len, basis.components)) // 2)


def frequency_bands(basis: Eigenbasis, count: int, split: bool) -> list[FrequencyBand]:
    """Divide the Gaussians and components into bands, low frequencies first."""
    if not split:
        return [FrequencyBand(count, basis.components, basis.eigenvalues)]
    low = max(1, round(LOW_SHARE * count))

    def part(number: int, rows: slice) -> FrequencyBand:
        planes = tuple(c[rows] for c in basis.components)
        return FrequencyBand(number, planes, tuple(e[rows] for e in basis.eigenvalues))

    first = low_component_count(basis)
    return [part(low, slice(first)), part(count - low, slice(first, None))]
