"""Pictures with unlike parts, settings to fit them by blocks, and executors of other ways."""

from functools import cache

import numpy as np

import eigengs_dr as eg
from _helpers.sets import check_equal

FEW = {"gaussians": 700, "iterations": 10, "block": 64, "backend": "llvm"}
"""Settings of a fit of 128x128 pixels in four blocks."""


@cache
def mosaic(side=256):
    """Parts of photos, whose borders are none of blocks of 64 or 96 pixels; uint8, to be read."""
    parts = [
        eg.sample("coffee")[60:180, 100:220],
        eg.sample("astronaut")[20:140, 180:300],
        eg.sample("chelsea")[80:200, 120:240],
    ]
    tiles = -(-side // 120)
    rows = [
        np.concatenate([parts[(row + column) % 3] for column in range(tiles)], axis=1)
        for row in range(tiles)
    ]
    pixels = np.rint(255 * np.concatenate(rows)[:side, :side]).astype(np.uint8)
    pixels.setflags(write=False)
    return pixels


class Sliced:
    """An array on disk that is read by slices alone, as those of zarr and Dask are."""

    def __init__(self, pixels):
        self.pixels, self.largest = pixels, 0
        self.shape, self.dtype = pixels.shape, pixels.dtype

    def __getitem__(self, part):
        found = self.pixels[part]
        self.largest = max(self.largest, found.size)
        return found

    def __array__(self, *arguments, **options):
        raise AssertionError("the whole array was read")


def assert_same_bits(one, other):
    check_equal(one.gaussians, other.gaussians.to_arrays())
