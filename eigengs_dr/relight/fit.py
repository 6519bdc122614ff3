"""From photos under known lights to planes on one set of Gaussians, and a table of lights.

The pixels are samples with 3 n numbers each, those of n photos and 3 colours. Their principal
components give few planes: photo and colour j is about ``mean_j + sum_k V_jk (X V)_k``. Columns of
V are orthonormal, so a squared error of a plane is a squared error of the photos, and the planes
are fitted as the channels of one image.

Photos count in sRGB codes, whose curve goes on above white. Of six sets of real photos, planes of
codes show left-out lights 0.5 to 5.6 dB closer in codes than planes of linear light (12 planes,
every 8th of the lights left out).
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh
from threadpoolctl import threadpool_limits

from ..backend.messages import warn
from ..backend.types import ArrayLike, Doubles, Singles
from ..eigenbasis.incremental import largest_eigenpairs, orient, product
from ..fitting.channels import Channels, Target
from ..fitting.fit import Fit, fit_problem
from ..fitting.options import FitOptions
from ..fitting.problem import Problem
from ..image.color import MAX_CHANNELS
from ..image.io import is_pipe, read_photo
from ..image.metrics import psnr_from_mse
from ..image.notes import series
from ..image.pixels import ImageError, check_encoding, codes_of
from ..image.read import read_header
from ..image.space import DATA
from ..storage.memory import check_usable
from .lights import (
    FOLDS,
    LightTable,
    check_lights,
    check_spread,
    find_lists,
    folds,
    functions_at,
    read_lights,
    solve_table,
)

MAX_PLANES = 32
"""Largest number of planes that is tried. On six sets of real photos, the PSNR of left-out lights
stays the same from 24 on."""

MIN_LIGHTS = 4
"""Smallest number of photos: a linear function of the direction has four factors."""

ROUNDING = 1 / (12 * 255**2)
"""Mean squared error that rounding a picture to 8 bits adds."""

TABLES = (("thin_plate", 1e-3), ("thin_plate", 1e-2), ("thin_plate", 0.1), ("hsh", 0.1))
"""Tables that are tried, with their smoothing."""

LEAST_COST = 0.05
"""Smallest weight of the squared error of a plane: photos of the fit show it in full."""

MAX_PSNR_DROP = 0.3
"""Decibels of left-out lights that a model may lose by fewer planes and fewer Gaussians."""

PLANES_SHARE = 0.25
"""Share of the budget that planes may take. Half as many Gaussians take half of the bytes, for 0.1
to 0.9 dB; half as many planes take a tenth to a third less, for 0.1 to 1.2 dB (five sets)."""

PIXELS_PER_GAUSSIAN = 16
"""Pixels of a photo for each Gaussian, at least."""

TRY_SHARE = 0.1
"""Steps of a try as a fraction of those of a fit."""


class Photos(NamedTuple):
    """Photos under known lights.

    Attributes
    ----------
    rows : ndarray of float32, shape (3 n, H W)
        A row for each photo and colour, in sRGB codes; light above white has codes above 1.
    size : (int, int)
        Width and height in pixels.
    lights : ndarray of float64, shape (n, 3)
    """

    rows: Singles
    size: tuple[int, int]
    lights: Doubles


def read_photos(
    photos: Any,
    lights: ArrayLike | str | os.PathLike[str] | None = None,
    encoding: str | None = None,
) -> Photos:
    """Read photos and their lights; for parameters and errors see `Relightable.fit`."""
    check_encoding(encoding)
    is_folder = isinstance(photos, (str, os.PathLike))
    if not is_folder:
        photos = _listed(photos)
    if lights is None:
        if not is_folder:
            raise ValueError("photos need lights: give their directions (n, 3), or an .lp file")
        lists = find_lists(photos)
        if len(lists) != 1:
            raise ValueError(
                f"{photos}: holds {len(lists)} files of lights (.lp), expected one; give its name "
                "as lights"
            )
        lights = lists[0]
    files = photos if is_folder else [p for p in photos if isinstance(p, (str, os.PathLike))]
    if isinstance(lights, (str, os.PathLike)):
        if not is_folder and files and len(files) < len(photos):
            raise ValueError("photos are files and arrays; with an .lp file, give one kind of both")
        named, directions = read_lights(lights, files or None)
        photos = named if files else photos
    elif is_folder:
        raise ValueError(f"{photos}: a folder needs an .lp file, which names its photos")
    else:
        directions = check_lights(lights)
    if len(photos) != len(directions):
        raise ValueError(f"there are {len(photos)} photos, but {len(directions)} lights")
    if len(photos) < MIN_LIGHTS:
        raise ValueError(f"there are {len(photos)} photos; a model needs at least {MIN_LIGHTS}")
    check_spread(directions)
    with series():
        return _stacked(photos, directions, encoding)


def _listed(photos: Any) -> list[Any]:
    """Return photos as a list; each file may occur once."""
    if isinstance(photos, (bytes, dict, set, frozenset)) or not hasattr(photos, "__iter__"):
        kind = type(photos).__name__
        raise TypeError(f"photos: is of type {kind}; give a folder, or a list of files or images")
    photos = list(photos)
    files = [os.fspath(photo) for photo in photos if isinstance(photo, (str, os.PathLike))]
    if len(set(files)) < len(files):
        twice = next(file for k, file in enumerate(files) if file in files[:k])
        raise ValueError(f"photos: {twice} is given for several lights; give each a photo")
    return photos


def _stacked(photos: Sequence[object], lights: Doubles, encoding: str | None) -> Photos:
    """Read photos into one array: lights belong to the pixels that files store.

    A camera that looks straight down writes any orientation, and programs that find lights ignore
    it, so that it may differ from photo to photo.
    """
    turned = [photo for photo in photos if _is_turned(photo)]
    if turned:
        warn(
            f"{turned[0]}: an orientation is not applied, in {len(turned)} of {len(photos)} "
            "photos: lights belong to the pixels as they are stored"
        )
    rows, shape = np.empty((0, 0), np.float32), (0, 0, 0)
    for k, photo in enumerate(photos):
        pixels = codes_of(read_photo(photo, encoding, upright=False))
        if k == 0:
            shape = pixels.shape
            what = f"{len(photos)} photos of {shape[1]}x{shape[0]} pixels"
            check_usable(pixels.nbytes * (len(photos) + 1), what, "scale them down or give fewer")
            rows = np.empty((3 * len(photos), shape[0] * shape[1]), np.float32)
        if pixels.shape != shape:
            name = photos[k] if isinstance(photos[k], (str, os.PathLike)) else f"photo {k + 1}"
            raise ImageError(
                f"{name}: is {pixels.shape[1]}x{pixels.shape[0]}, but the first photo is "
                f"{shape[1]}x{shape[0]}; scale them to one size"
            )
        rows[3 * k : 3 * k + 3] = pixels.reshape(-1, 3).T
    return Photos(rows, (shape[1], shape[0]), lights)


def _is_turned(photo: object) -> bool:
    """Return whether a photo is a file whose EXIF orientation turns it."""
    if not isinstance(photo, (str, os.PathLike)) or is_pipe(photo):
        return False
    header = read_header(Path(photo), upright=False)
    return header.orientation != 1 and not header.upright


class Planes(NamedTuple):
    """The planes of photos.

    Attributes
    ----------
    images : ndarray of float32, shape (H, W, K)
        Scaled so that the sum of their mean squared errors is that of the photos.
    table : LightTable
    left_out : ndarray of float64, shape (n,)
        Mean squared error of each photo from planes of others, see `left_out`; 1 is white, also
        where light is above it.
    """

    images: Singles
    table: LightTable
    left_out: Doubles

    def psnr_held_out(self, shown: Singles) -> float:
        """Return the mean PSNR in dB of left-out photos, where the planes are shown (H, W, K).

        The Gaussians show a projection S of the planes, whose errors have the second moments E. A
        photo x, of which the others say y, then has the error ``|x - S y|^2``, which is
        ``|x - y|^2 + |x - S x|^2 - |(x - y) - S (x - y)|^2``: that of planes, and with the factors
        t of the photo and u of the others ``1/3 sum_c t^T E t - (t - u)^T E (t - u)``.
        """
        difference = (shown - self.images).reshape(-1, shown.shape[2])
        moments = (difference.T @ difference / len(difference)).astype(np.float64)
        added = np.einsum("nkl,kl->n", self._costs(), moments)
        return _mean_psnr(np.maximum(self.left_out + added, 0) + ROUNDING)

    def _costs(self) -> Doubles:
        """Return ``1/3 sum_c t t^T - (t - u) (t - u)^T`` of each photo, (n, K, K)."""
        added, spared = (
            np.einsum("nck,ncl->nkl", factors[..., :-1], factors[..., :-1]) / 3
            for factors in (self.table.values, self.table.changes())
        )
        return np.asarray(added - spared)

    def for_left_out(self) -> Planes:
        """Return uncorrelated planes whose mean squared errors add up to that of left-out photos.

        Errors of moments E change the mean PSNR of left-out photos, of errors e, as an error
        ``<M, E>`` of their geometric mean does, where M is the mean of `_costs` times that mean
        over e. Planes are products with the root of M, rotated to their principal axes. What lights
        hardly tell of others, such as noise, has a small M or one below 0: there Gaussians and bits
        would be wasted.
        """
        errors = self.left_out + ROUNDING
        weights = np.exp(np.log(errors).mean()) / errors
        values, vectors = eigh(np.tensordot(weights, self._costs(), 1) / len(weights))
        roots = np.sqrt(np.maximum(values, LEAST_COST))
        rows = self.images.reshape(-1, len(roots))
        scaled = vectors * roots
        moments = scaled.T @ (rows.T @ rows / len(rows)) @ scaled
        axes = eigh(moments)[1][:, ::-1]
        images = (rows @ (scaled @ axes).astype(np.float32)).reshape(self.images.shape)
        factors = self.table.values.copy()
        factors[..., :-1] = factors[..., :-1] @ (vectors / roots @ axes)
        return self._replace(images=images, table=replace(self.table, values=factors))


def find_planes(
    photos: Photos, planes: int | None = None, max_psnr_drop: float = PLANES_SHARE * MAX_PSNR_DROP
) -> Planes:
    """Compute planes and their table; by default as many planes as left-out lights need.

    Parameters
    ----------
    photos : Photos
        Its rows are centred in place.
    planes : int, optional
        Number of planes.
    max_psnr_drop : float, optional
        Decibels of left-out lights that a smaller number of planes may cost.
    """
    rows, lights = photos.rows, photos.lights
    mean = rows.mean(axis=1, dtype=np.float64)
    rows -= mean.astype(np.float32)[:, None]
    gram = product(rows, rows) / rows.shape[1]
    limit = planes or min(MAX_PLANES, most_planes(len(lights)))
    errors = left_out(gram, mean, lights, limit)
    psnrs = {
        choice: np.array([_mean_psnr(column + ROUNDING) for column in of_choice.T])
        for choice, of_choice in errors.items()
    }
    best = max(psnrs.values(), key=lambda values: values.max())
    count = planes or int(np.argmax(best >= best.max() - max_psnr_drop)) + 1
    kind, smoothing = max(psnrs, key=lambda choice: psnrs[choice][count - 1])
    _, weights = largest_eigenpairs(gram.copy(), count, 0.0)
    if not weights.size:
        raise ImageError("every photo is of one colour; a model needs photos of an object")
    unit = orient((weights / np.linalg.norm(weights, axis=0)).T.astype(np.float32))
    scale = np.sqrt(len(rows))
    images = (unit @ rows / np.float32(scale)).T.reshape(*photos.size[::-1], len(unit))
    columns = np.vstack([unit * scale, mean[None]]).astype(np.float64)
    values = np.moveaxis(columns.reshape(-1, len(lights), 3), 0, 2)
    table = LightTable(lights, values, kind, smoothing)
    return Planes(np.ascontiguousarray(images), table, errors[kind, smoothing][:, len(unit) - 1])


def _mean_psnr(errors: Doubles) -> float:
    """Return the mean PSNR in dB of photos with these mean squared errors."""
    return float(np.mean([psnr_from_mse(error) for error in errors.tolist()]))


def most_planes(photos: int) -> int:
    """Return the largest number of planes: as many as rows are left without one of the parts."""
    return min(MAX_CHANNELS, 3 * (photos - math.ceil(photos / FOLDS)))


@threadpool_limits.wrap(limits=1, user_api="blas")  # more wait for each other, see `incremental`
def left_out(
    gram: Doubles, mean: Doubles, lights: Doubles, limit: int
) -> dict[tuple[str, float], Doubles]:
    """Return errors (n, limit) of left-out photos with 1, 2, ..., `limit` planes of the others.

    With the covariance C of the rows, the eigenpairs (V, L) of the rest R, and interpolated factors
    W of left-out rows T, the mean squared error is ``C_TT - 2 W V^T C_RT + W L W^T`` and the
    squared error of the mean. So no pixel is needed.

    Parameters
    ----------
    gram : ndarray of float64, shape (3 n, 3 n)
        Covariance of the rows over the pixels.
    mean : ndarray of float64, shape (3 n,)
    lights : ndarray of float64, shape (n, 3)
    limit : int
        At most `most_planes`.

    Returns
    -------
    dict
        For each of `TABLES`.
    """
    all_errors = {choice: np.empty((len(lights), limit)) for choice in TABLES}
    for out in folds(lights):
        left, rest = np.repeat(out, 3), np.repeat(~out, 3)
        span = (rest.sum() - limit, rest.sum() - 1)
        values, vectors = eigh(gram[np.ix_(rest, rest)], subset_by_index=span)
        values, vectors = values[::-1], vectors[:, ::-1]
        columns = np.concatenate([vectors, mean[rest, None]], axis=1)
        products = gram[np.ix_(left, rest)] @ vectors
        known = lights[~out]
        for (kind, smoothing), errors in all_errors.items():
            solved = solve_table(kind, smoothing, known, columns.reshape(len(known), -1))
            factors = (functions_at(kind, known, lights[out]) @ solved).reshape(left.sum(), -1)
            weights = factors[:, :-1]
            change = values * weights**2 - 2 * weights * products
            fixed = np.diag(gram)[left] + (mean[left] - factors[:, -1]) ** 2
            by_count = fixed[:, None] + np.cumsum(change, axis=1)
            errors[out] = np.maximum(by_count.reshape(-1, 3, limit).mean(axis=1), 0)
    return all_errors


def fit_fewest(
    planes: Planes,
    max_psnr_drop: float,
    iterations: int,
    seed: int,
    backend: str | None,
    progress: Callable[..., None] | None = None,
) -> Fit:
    """Fit the smallest number of Gaussians that costs left-out lights at most so many decibels.

    The number is halved while a try, a fit of few steps, predicts that: the other steps lower its
    loss by about as large a factor as its own lowered the error, 0.2 to 0.7 on nine sets; what is
    lost is then 0.9 to 1.5 times the prediction. An interrupted try or fit is returned as well.
    """
    count = max(1, planes.images[..., 0].size // PIXELS_PER_GAUSSIAN)
    exact, steps = planes.psnr_held_out(planes.images), round(TRY_SHARE * iterations)
    while count > 1:
        show = progress and partial(_of_try, progress, count // 2)
        tried = fit_planes(planes.images, count // 2, steps, seed, backend, show)
        lost = exact - planes.psnr_held_out(tried.image.reshape(planes.images.shape))
        if tried.stopped == "interrupted":
            return tried
        if lost * 10 ** ((tried.trace[0]["psnr_ycbcr"] - tried.psnr_ycbcr) / 10) > max_psnr_drop:
            break
        count //= 2
    return fit_planes(planes.images, count, iterations, seed, backend, progress)


def _of_try(
    progress: Callable[..., None], gaussians: int, done: int, total: int, row: dict[str, Any]
) -> None:
    """Say which try a row of progress belongs to."""
    progress(done, total, row | {"stage": f"try {gaussians} Gaussians"})


def fit_planes(
    images: Singles,
    gaussians: int,
    iterations: int,
    seed: int,
    backend: str | None,
    progress: Callable[..., None] | None = None,
) -> Fit:
    """Fit planes (H, W, K) as the channels of one set; an interrupted fit is returned as well."""
    started = time.perf_counter()
    height, width, count = images.shape
    options = FitOptions(
        gaussians=gaussians,
        iterations=iterations,
        space=DATA,
        seed=seed,
        backend=backend,
    )
    options.check_image(width, height, count)
    channels = Channels("", DATA, slice(0, count), (Target.of(images, DATA),))
    problem = Problem((channels,), (width, height), options)
    [result] = fit_problem(problem, started, progress)
    return result
