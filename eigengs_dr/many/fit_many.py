"""The function `fit_many`, which fits Gaussians to each of many images."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from functools import partial
from typing import Any

from ..backend.entry_points import checks_types, shows_progress
from ..backend.selection import name_of, select
from ..fitting.control import Diverged
from ..fitting.fit import Fit, fit_images
from ..fitting.options import FitOptions, refuse_unknown
from ..fitting.start import load_start, set_in
from ..image.io import check_data, read_floats
from ..image.pixels import EncodedImage
from ..image.space import YCBCR
from .images import ImageRow, Images, digest, fingerprint
from .run import Job, run_images

MAX_SIDE = 256
"""Largest side in pixels of images that are fitted in groups."""

MAX_GAUSSIANS = 1 << 15
"""Largest number of Gaussians of an image in a group. Dr.Jit adds up to this many numbers in a
fixed order, and more of them in parts that depend on the number of sums."""

MAX_CUTOFF = 3.1
"""Largest cutoff at which no Gaussian of a fit is steep, see `eigengs_dr.raster.evaluate.is_steep`.
One steep Gaussian changes the arithmetic of all, also of those of other images in its group."""

MAX_GROUP_PIXELS, MAX_GROUP_PIXELS_ON_GPU = 1 << 18, 1 << 20
"""Largest number of pixels of a group. On llvm 4 images of 256x256, or 64 of 64x64: larger groups
are not faster, and an interrupt loses the current group. A GPU fits 16 images of 256x256 in 1.5
times the time of 4, and larger groups are not faster per image (H200, 100 steps)."""


@shows_progress
@checks_types
def fit_many(
    images: Images,
    output: str | os.PathLike[str] | None = None,
    *,
    recursive: bool = False,
    overwrite: bool = False,
    progress: Any = None,
    client: Any = None,
    **options: Any,
) -> list[ImageRow]:
    """Fit many images; one that fails gets a row with its error, and the run continues.

    Threads decode files and write results while other images are fitted. With an output folder,
    memory does not grow with the number of images.

    Parameters
    ----------
    images : path-like or iterable
        A folder, a glob such as ``"photos/**/*.jpg"``, or an iterable of files and arrays
        (H, W, 3), (H, W, 1) or (H, W). The name of an image is the stem of its file; arrays are
        named by their index, such as "000012".
    output : path-like, optional
        Folder of the results, ``NAME.npz`` for each image; it is created if it is missing. Each
        file is written atomically. By default the results stay in memory.
    recursive : bool, optional
        Take images in the subfolders of a folder too; otherwise a warning names one. All images
        need names of their own.
    overwrite : bool, optional
        Fit images again whose output exists. By default these are skipped, so that repeating an
        interrupted run continues it; results of other options are an error. A file that is not a
        set of Gaussians is never replaced.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none. A
        function is called as ``progress(done, total, row)`` after every image, with its
        `ImageRow`, which has the `Fit` in this process; `total` is None for an iterator. It may
        raise `KeyboardInterrupt` to end the run.
    client : distributed.Client, optional
        Fit on the workers of this Dask cluster; None is this process. Workers read the files and
        write the results, so they need the same file system. On llvm the results are
        bit-identical for any number of workers.
    options : Any
        Keyword arguments, the options of `eigengs_dr.fit`: gaussians, iterations, target_psnr,
        start, space, method, seed, backend and encoding. A start is read once.

    Returns
    -------
    list of ImageRow
        One row for each image, in order.

    Raises
    ------
    ValueError
        If an option is out of range, two images have the same name, there is no image, or the
        output folder has results of other options. In an iterator, the second image of the same
        name gets a row with an error instead.
    TypeError
        If an option is unknown, or only `eigengs_dr.fit` has it: weight and loss.
    OSError
        If the output folder cannot be written, or another run writes into it.
    BackendError
        If the backend is not available.
    ClusterError
        If the cluster cannot be used, or is lost. The same call continues the run.
    Interrupted
        After Ctrl-C or SIGTERM: a `KeyboardInterrupt` whose ``result`` are the rows so far, with
        complete files. The interrupted image has no file.

    Notes
    -----
    Consecutive small images of the same size are fitted in groups, see
    `eigengs_dr.fitting.fit.fit_images`. On llvm a result is bit-identical to that of
    `eigengs_dr.fit`, whatever the other images are. On cuda the order of summation differs: the
    results of long fits differ by some tenths of a decibel, up or down.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> photo = eg.sample("coffee")[:64, :64]
    >>> rows = eg.fit_many([photo, photo[:32]], gaussians=200, iterations=10)
    >>> [(row.name, row.status, row.gaussians) for row in rows]
    [('000000', 'done', 200), ('000001', 'done', 200)]
    """
    parameters = ("images", "output", "recursive", "overwrite", "progress", "client")
    if single := {"weight", "loss"} & set(options):
        raise TypeError(f"fit_many takes no {min(single)}; call eigengs_dr.fit for each image")
    known = [field.name for field in fields(FitOptions) if field.name != "loss"]
    refuse_unknown(options, [*known, *parameters])
    settings = FitOptions(**options)
    if settings.start is not None:
        start = load_start(settings.start, settings.backend)
        settings = replace(settings, start=start, space=settings.space or set_in(start).space)
    if client is None:
        select(settings.backend)  # a missing backend is an error before any work
    job = Job(
        partial(_fit_group, options=settings),
        partial(_read, options=settings),
        partial(_may_join, options=settings),
        settings.iterations,
        _digest_of(settings),
    )
    return run_images(images, output, overwrite, job, progress, client, recursive)


def _read(image: Any, name: str, options: FitOptions) -> EncodedImage:
    """Read an image, or data."""
    if not (options.space or YCBCR).is_color:
        return EncodedImage(check_data(image), "srgb")
    return read_floats(image, encoding=options.encoding)


def _digest_of(settings: FitOptions) -> str:
    """Return a digest of the options on which results depend; a start counts by what it holds."""
    options = vars(settings) | {"backend": None, "space": settings.space or YCBCR}
    if settings.start is not None:
        start: Any = settings.start
        options["start"] = fingerprint(start)
    return digest(options)


def _may_join(group: list[EncodedImage], added: EncodedImage, options: FitOptions) -> bool:
    """Return whether an image may join a group: small images of the same size may."""
    on_cpu = name_of(select(options.backend)) == "llvm"
    max_pixels = MAX_GROUP_PIXELS if on_cpu else MAX_GROUP_PIXELS_ON_GPU
    first, last = group[-1].pixels, added.pixels
    same_size = first.shape == last.shape and _is_groupable(group[-1], options)
    pixels = (len(group) + 1) * last.shape[0] * last.shape[1]
    return same_size and _is_groupable(added, options) and pixels <= max_pixels


def _is_groupable(image: EncodedImage, options: FitOptions) -> bool:
    """Return whether a fit in a group is bit-identical to a separate fit of the image."""
    pixels, method = image.pixels, options.method
    return (
        image.encoding == "srgb"
        and (options.space or YCBCR).has_codes(pixels)
        and options.start is None
        and not method.place.has_colors
        and options.goal is None
        and not options.has_levels
        and method.cutoff <= MAX_CUTOFF
        and max(pixels.shape[:2]) <= MAX_SIDE
        and options.count_for(pixels.shape[0] * pixels.shape[1]) <= MAX_GAUSSIANS
    )


def _fit_group(images: list[EncodedImage], options: FitOptions) -> list[Fit]:
    """Fit one image, or several as one batch."""
    try:
        return fit_images(images, options)
    except Diverged:
        return [fit_images([image], options)[0] for image in images]
