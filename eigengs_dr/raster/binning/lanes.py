"""The order of lanes: SIMD packets of like work, and blocks of like work for every core."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .transpose import transpose_pattern

PACKET = 16
"""Lanes of a SIMD packet; those of AVX-512."""


def order_lanes(length: NDArray[np.int64], window: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Return an order of lanes with like lengths in a packet, and packets dealt out evenly.

    Parameters
    ----------
    length : ndarray of int64, shape (lanes,)
        Work of each lane.
    window : ndarray of int64, shape (lanes,)
        Ascending numbers of the windows; a lane stays in its window, with its neighbours in space.

    Returns
    -------
    ndarray of uint32, shape (lanes,)
        By window, then by descending length; lanes without work are spread among the others.
    """
    order = _descending(length, window)
    return order[_deal(length[order])]


def _deal(length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return an order of lanes that spreads empty packets evenly among the others.

    Dr.Jit cuts a launch on llvm into blocks of neighbouring lanes, two for each core. Pieces leave
    a tenth to a third of their lanes empty, all at the end: the last block would have no work. In
    simulation, the longest thread had 1.27 times the mean work on 2 cores, 1.46 times on 16 and
    1.51 times on 64; dealt out 1.01, 1.10 and 1.15 times (512x512, 20,000 Gaussians).
    """
    count = len(length) // PACKET * PACKET
    full = length[:count].reshape(-1, PACKET).max(axis=1, initial=0) > 0
    place = np.empty(len(full))
    for kind in (full, ~full):
        place[kind] = (np.arange(kind.sum()) + 0.5) / max(1, kind.sum())
    packets = np.argsort(place, kind="stable")
    lanes = (packets[:, None] * PACKET + np.arange(PACKET)).ravel()
    return np.concatenate([lanes, np.arange(count, len(length))])


def _descending(length: NDArray[np.int64], window: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Return the stable order by window, then by descending length."""
    levels = int(length.max(initial=0)) + 1
    keys = window * levels + (levels - 1 - length)
    starts = np.arange(len(keys) + 1, dtype=np.int32)
    order: NDArray[np.int32] = transpose_pattern(
        keys.astype(np.int32), starts, (int(window.max()) + 1) * levels
    ).indices
    return order.view(np.uint32)
