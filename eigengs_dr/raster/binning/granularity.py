"""How much work one lane of a kernel gets, by backend: the one place that chooses it."""

from __future__ import annotations

from typing import NamedTuple

from ...backend.arrays import ArrayTypes


class Granularity(NamedTuple):
    """The share of a lane.

    Attributes
    ----------
    rows : int
        Rows of a tile that one lane owns, of the sum over Gaussians and of the adjoint: 1, 2 or 4.
    visits, long_visits : int
        Largest number of tiles that one lane of the adjoint visits, and the number where lists are
        long enough to keep `MIN_PIECES` lanes busy. A Gaussian that touches more tiles gets several
        lanes, so that few large Gaussians fill many cores too; fewer lanes have fewer results to
        store and to add.
    ordered : bool
        Whether lanes are ordered by their work. A SIMD packet of a CPU takes as long as its longest
        lane, and ordering is cheap there; a GPU would need another sort.
    products : bool
        Whether weights along a row continue one exponential by products, where that is accurate. On
        a GPU an exponential is one instruction, and products would cost more.
    """

    rows: int
    visits: int
    long_visits: int
    ordered: bool
    products: bool

    def visits_for(self, entries: int, tiles: int) -> int:
        """Return the largest number of tiles of a lane, for the lists of an image of some tiles."""
        large = tiles > SMALL and entries >= MIN_PIECES * self.long_visits
        return self.long_visits if large else self.visits


MIN_PIECES = 1 << 15
"""Pieces that keep all cores of a large CPU busy."""

SMALL = 1 << 12
"""Most tiles of an image, 256x256 pixels, that takes `Granularity.visits` whatever its lists. In a
batch the number may not depend on the lists of other images: it decides in which order sums run."""

GRANULARITY = {
    "llvm": Granularity(rows=4, visits=16, long_visits=64, ordered=True, products=True),
    "cuda": Granularity(rows=1, visits=16, long_visits=16, ordered=False, products=False),
}
"""Granularity by backend. On llvm a lane shares the parameters of a Gaussian among 16 pixels; on a
GPU more lanes with fewer registers hide the latency of memory."""


def granularity_of(types: ArrayTypes) -> Granularity:
    """Return the granularity for the backend of some array types."""
    return GRANULARITY[types.backend]
