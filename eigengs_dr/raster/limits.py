"""The largest image that 32-bit indices can number."""

from __future__ import annotations

MAX_VALUES = (1 << 32) - 1
"""Largest number of values of an image, channels included. Kernels index them by 32 bits, as Dr.Jit
does its arrays: larger indices would wrap to the first pixels without an error."""


def check_index_range(
    width: int, height: int, channels: int, tile: tuple[int, int] = (1, 1)
) -> None:
    """Refuse an image with more values than 32-bit indices can number.

    The limit is 37,837 pixels a side with three channels, and 8,191 with 64.

    Parameters
    ----------
    width, height : int
        Size in pixels.
    channels : int
    tile : (int, int), optional
        Width and height of a tile: sides are rounded up to whole tiles.

    Raises
    ------
    ValueError
        If the image, in whole tiles, has more than `MAX_VALUES` values.
    """
    columns, rows = (
        -(-side // unit) * unit for side, unit in zip((width, height), tile, strict=True)
    )
    values = columns * rows * channels
    if values > MAX_VALUES:
        raise ValueError(
            f"an image of {width}x{height} pixels and {channels} channels has {values:,} values, "
            f"the limit is {MAX_VALUES:,}: scale it down or work on parts of it"
        )
