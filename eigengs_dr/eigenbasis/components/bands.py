"""Division of Gaussians and components: a single band, or two bands with a frequency split."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...fitting.place import grid_of
from ...gaussian.gaussians import Gaussians
from ..pca.basis import Eigenbasis

Planes = NDArray[np.float32]

LOW_SHARE = 0.1
"""Share of the Gaussians that represent the low frequencies in a split (from the paper)."""

LOW_COMPONENTS = 50
"""Number of components of each channel that count as low frequencies (from the authors' code); with
fewer than 100 components, half of them."""

MIN_SPLIT_SIDE = 512
"""Smallest longer side in pixels for which "auto" splits. In the paper, the split costs 0.4 to 0.8
dB at 256 pixels and gains 1 dB at 512. Here, on cats of 512 pixels with 1,000 to 5,000 Gaussians,
it cost 0.1 dB initially, and gained 0.2 to 0.8 dB after 300 steps."""


class FrequencyBand(NamedTuple):
    """A number of Gaussians and the components that they represent.

    Attributes
    ----------
    number : int
    components : tuple of C ndarrays of float32, shape (k_c, H, W)
        A channel may have none.
    eigenvalues : tuple of C ndarrays of float64, shape (k_c,)
        Variance along each component.
    """

    number: int
    components: tuple[Planes, ...]
    eigenvalues: tuple[NDArray[np.float64], ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.components[0].shape[1:]
        return width, height


def frequency_bands(
    basis: Eigenbasis, count: int, frequency_aware: bool | str
) -> list[FrequencyBand]:
    """Divide the Gaussians and components into bands, low frequencies first.

    There is one band if `frequency_aware` is False, if it is "auto" and the longer side has fewer
    than `MIN_SPLIT_SIDE` pixels, or if there are too few Gaussians or components for two.
    """
    if frequency_aware == "auto":
        frequency_aware = max(basis.width, basis.height) >= MIN_SPLIT_SIDE
    first = low_component_count(basis)
    if not frequency_aware or count < 2 or first < 1:
        return [FrequencyBand(count, basis.components, basis.eigenvalues)]
    low = max(1, round(LOW_SHARE * count))

    def part(number: int, rows: slice) -> FrequencyBand:
        planes = tuple(c[rows] for c in basis.components)
        return FrequencyBand(number, planes, tuple(e[rows] for e in basis.eigenvalues))

    return [part(low, slice(first)), part(count - low, slice(first, None))]


def low_component_count(basis: Eigenbasis) -> int:
    """Return the number of components of each channel that count as low frequencies."""
    return min(LOW_COMPONENTS, max(map(len, basis.components)) // 2)


def on_grid(band: FrequencyBand, backend: str | None = None) -> Gaussians:
    """Return the Gaussians of a band on a grid, with colours of 0 in the space "data"."""
    mean, factor = grid_of(band.size, band.number)
    colors = np.zeros((len(mean), len(band.components)))
    return Gaussians.from_arrays(
        mean, factor, colors, size=band.size, space="data", backend=backend
    )
