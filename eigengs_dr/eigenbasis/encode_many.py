"""Many images encoded by one model, in groups that share matrix products."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..backend.recording import exclusive
from ..collection.manifest import ImageRow, RowProgress
from ..collection.run import FAILURES, Job, Outcome, Work, run_images
from ..collection.sources import Images
from ..gaussian.gaussians import Gaussians
from ..image.io import check_image
from ..image.pixels import EncodedImage
from .encoder import check_encoding

if TYPE_CHECKING:
    from .eigengs import EigenGS

MAX_GROUP = 32
"""Largest number of images that are encoded together. With the basis "natural", groups of 8, 16 and
32 images take 0.5, 0.5 and 0.4 of the time of `EigenGS.encode`."""

MAX_GROUP_PIXELS = 1 << 22
"""Largest number of pixels of a group before the images are resampled to the size of the model."""

Pixels = NDArray[np.float32]
EncodeGroup = Callable[[list[Pixels]], list[Gaussians]]


def encode_each(
    model: EigenGS,
    options: tuple[str, str, float | None],
    images: Images,
    output: str | os.PathLike[str] | None,
    overwrite: bool,
    progress: RowProgress | None,
    client: Any = None,
) -> list[ImageRow]:
    """Encode many images.

    Parameters
    ----------
    model : EigenGS
    options : tuple
        The colors, mean and target_psnr of `eigengs_dr.EigenGS.encode_many`.
    images, output, overwrite, progress, client
        See there, also for results and errors.
    """
    check_encoding(*options)
    job = Job(partial(encode_work, model, *options), _may_join)
    return run_images(images, output, overwrite, job, progress, client)


def encode_work(model: EigenGS, colors: str, mean: str, target_psnr: float | None) -> Work:
    """Return the work on groups of images, in this process or on a worker.

    Parameters
    ----------
    model : EigenGS
    colors, mean, target_psnr
        See `eigengs_dr.EigenGS.encode`.
    """
    encode = exclusive()(model.encoder.encode)
    encode = partial(encode, colors=colors, mean=mean, target_psnr=target_psnr)
    return partial(_encode_group, encode=encode)


def _may_join(group: list[EncodedImage], added: EncodedImage) -> bool:
    """Group images of any sizes, which all have the size of the model when they are encoded."""
    area = sum(image.pixels.size for image in [*group, added]) // 3
    return len(group) < MAX_GROUP and area <= MAX_GROUP_PIXELS


def _encode_group(images: list[EncodedImage], encode: EncodeGroup) -> Iterator[Outcome]:
    """Encode a group; if that fails, encode its images one by one to find the bad one."""
    started = time.perf_counter()
    try:
        sets = encode([check_image(image, copy=False) for image in images])
    except FAILURES as error:
        if len(images) > 1:
            for image in images:
                yield from _encode_group([image], encode)
        else:
            yield Outcome(None, None, {"error": str(error) or type(error).__name__})
        return
    seconds = (time.perf_counter() - started) / len(images)
    for gaussians in sets:
        yield Outcome(gaussians, gaussians, {"seconds": seconds})
