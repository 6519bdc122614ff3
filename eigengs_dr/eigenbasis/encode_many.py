"""Many images encoded by one model, in groups that share matrix products."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..collection.plan import run_images
from ..collection.row import ImageRow, Outcome, RowProgress, collect
from ..collection.run import FAILURES, Job
from ..collection.sources import Images
from ..gaussian.gaussians import Gaussians

MAX_GROUP = 32
"""Largest number of images that are encoded together. With the basis "natural", groups of 8, 16 and
32 images take 0.5, 0.5 and 0.4 of the time of `EigenGS.encode`."""

MAX_GROUP_PIXELS = 1 << 22
"""Largest number of pixels of a group before the images are resampled to the size of the model."""

Pixels = NDArray[np.float32]
EncodeGroup = Callable[[list[Pixels]], list[Gaussians]]


def check_encoding(colors: str, mean: str, target_psnr: float | None) -> None:
    """Raise ValueError for options of `eigengs_dr.EigenGS.encode` that are unknown or contradict.

    Parameters
    ----------
    colors, mean, target_psnr
        See `eigengs_dr.EigenGS.encode`.
    """
    for name, value, valid in (
        ("colors", colors, ("exact", "projected")),
        ("mean", mean, ("gaussians", "dense")),
    ):
        if value not in valid:
            raise ValueError(f"{name} {value!r} is unknown; use one of {', '.join(valid)}")
    if colors == "exact" and target_psnr is not None:
        raise ValueError("target_psnr chooses components; use it with colors 'projected'")


def encode_each(
    encode: EncodeGroup,
    images: Images,
    output: str | os.PathLike[str] | None,
    overwrite: bool,
    progress: RowProgress | None,
) -> list[ImageRow]:
    """Encode many images.

    Parameters
    ----------
    encode : callable
        ``encode(images)`` returns the Gaussians of every image of a group.
    images, output, overwrite, progress
        See `eigengs_dr.EigenGS.encode_many`, also for results and errors.
    """
    job = Job(lambda: partial(_encode_group, encode=encode), _may_join)
    folder = None if output is None else Path(output)
    total, finished = run_images(images, folder, overwrite, job)
    return collect(total, finished, folder is None, progress)


def _may_join(group: list[Pixels], pixels: Pixels) -> bool:
    """Group images of any sizes, which all have the size of the model when they are encoded."""
    area = sum(image.size for image in [*group, pixels]) // 3
    return len(group) < MAX_GROUP and area <= MAX_GROUP_PIXELS


def _encode_group(images: list[Pixels], encode: EncodeGroup) -> Iterator[Outcome]:
    """Encode a group; if that fails, encode its images one by one to find the bad one."""
    started = time.perf_counter()
    try:
        sets = encode(images)
    except FAILURES as error:
        if len(images) > 1:
            for pixels in images:
                yield from _encode_group([pixels], encode)
        else:
            yield Outcome(None, None, {"error": str(error) or type(error).__name__})
        return
    seconds = (time.perf_counter() - started) / len(images)
    for gaussians in sets:
        yield Outcome(gaussians, gaussians, {"seconds": seconds})
