"""How many components a basis has: what the caller allows, and what a share of energy needs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from operator import index

import numpy as np
from numpy.typing import NDArray

from ...backend.feedback import warn
from .basis_file import ENERGY_TOLERANCE

CHANNELS = {"ycbcr": ("Y", "Cb", "Cr"), "rgb": ("R", "G", "B")}
"""Names of the channels of a space, for warnings."""


def name_components(space: str, counts: Iterable[int]) -> str:
    """Return how many components each channel has, as in "230 Y, 60 Cb, 60 Cr"."""
    return ", ".join(f"{n} {name}" for n, name in zip(counts, CHANNELS[space], strict=True))


def check_components(
    components: int | Sequence[int], energy: float | None = None
) -> tuple[int, int, int]:
    """Return the most components of each channel; raise ValueError for bad numbers or energy."""
    if energy is not None and not 0 < energy <= 1:
        raise ValueError(f"energy is {energy}; expected a share of the variance in (0, 1]")
    try:
        each = components if isinstance(components, Iterable) else (components,) * 3
        y, cb, cr = map(index, each)
    except (TypeError, ValueError):
        raise ValueError(f"components is {components!r}; expected a number, or three") from None
    if min(y, cb, cr) < 0:
        raise ValueError(f"components is {components!r}; expected no negative number")
    return y, cb, cr


def ranks_for_energy(
    energies: Sequence[NDArray[np.float64]],
    variance: NDArray[np.float64],
    most: Sequence[int],
    energy: float,
    space: str,
) -> list[int]:
    """Return the fewest components of each channel that hold a share of its variance.

    Parameters
    ----------
    energies : sequence of C ndarrays, shape (k_c,)
        See `cumulative_share`.
    variance : ndarray, shape (C,)
        Total variance of each channel.
    most : sequence of C ints
        Components that the caller allows.
    energy : float
        The share, in (0, 1].
    space : {"ycbcr", "rgb"}

    Warns
    -----
    UserWarning
        If `most` is too low for the share.
    """
    ranks = []
    for name, shares, cap, total in zip(CHANNELS[space], energies, most, variance, strict=True):
        ranks.append(int(np.searchsorted(shares, energy)) + 1)
        share = shares[-1] if len(shares) else 0.0
        if total > 0 and len(shares) == cap and share < energy - ENERGY_TOLERANCE:
            warn(
                f"channel {name}: {cap} components hold {share:.2%} of the variance, "
                f"less than {energy:.2%}; raise components"
            )
    return ranks


def cumulative_share(eigenvalues: NDArray[np.float64], variance: float) -> NDArray[np.float64]:
    """Return the share of a variance that the first 1, 2, ... eigenvalues hold; shape (k,)."""
    return np.minimum(np.cumsum(eigenvalues) / (variance or 1), 1)
