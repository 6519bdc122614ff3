"""Strips along the borders of blocks, in which a second fit joins both sides."""

from __future__ import annotations

import math

from .grid import Block

SEAM_SPACINGS = 4.0
"""Half of the width of a strip, in spacings of the Gaussians."""


def seams(blocks: list[Block], width: int, height: int, spacing: float, halo: int) -> list[Block]:
    """Return the strips along all borders of blocks.

    Parameters
    ----------
    blocks : list of Block
    width, height : int
        Size of the image in pixels.
    spacing : float
        Mean distance of the Gaussians in pixels.
    halo : int
        Pixels around a strip that belong to its window.

    Returns
    -------
    list of Block
        First the vertical borders, then the horizontal ones. Strips of one phase do not touch each
        other, as long as blocks are larger than strips are wide.
    """
    rows = sorted({(block.rows.start, block.rows.stop) for block in blocks})
    columns = sorted({(block.columns.start, block.columns.stop) for block in blocks})
    narrowest = min(stop - start for start, stop in rows + columns)
    reach = min(math.ceil(SEAM_SPACINGS * spacing), narrowest // 2)
    strips = list[Block]()

    def add(rows: slice, columns: slice, phase: int) -> None:
        windows = _widened(rows, halo, height), _widened(columns, halo, width)
        strips.append(Block(len(strips), rows, columns, *windows, phase))

    for border, _ in columns[1:]:
        across = _widened(slice(border, border), reach, width)
        for number, along in enumerate(rows):
            add(slice(*along), across, number % 2)
    for border, _ in rows[1:]:
        across = _widened(slice(border, border), reach, height)
        for number, along in enumerate(columns):
            add(across, slice(*along), 2 + number % 2)
    return strips


def _widened(part: slice, by: int, length: int) -> slice:
    return slice(max(0, part.start - by), min(length, part.stop + by))
