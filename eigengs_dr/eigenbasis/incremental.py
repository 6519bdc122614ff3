"""Incremental PCA: the mean and the principal components of images that arrive in blocks.

A state belongs to one channel. Its rows remain orthonormal in single precision; their Gram matrix
is summed in double precision.

A shard is a part of the images, determined only by their number. Its states are computed block by
block, in this process or on a worker. This process then merges the states of the shards in order,
so that the result is bit-identical for any number of workers. Merged states are stored in files, so
that a large family fits into 1 GB of memory.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh
from threadpoolctl import threadpool_limits

from ..backend.types import Doubles, Singles, Values
from ..cluster import completed, executor_for
from ..image.folder import ReadProgress, TrainingImages, list_images, read_blocks
from ..image.notes import NotedImages, kept_warnings, tell, tell_all
from ..image.pixels import ImageError, local_path
from ..storage.checkpoint import read_arrays, write_arrays
from ..storage.memory import check_usable

BLOCK_BYTES = 768 << 20
"""Size of a block of images in bytes."""

MAX_BLOCK = 1024
"""Largest number of images in a block, and so of rows of its Gram matrix."""

EXTRA_SHARE = 0.25
"""Additional components that are kept between blocks, as a share of the final components."""


@dataclass(frozen=True, eq=False)
class EigenState:
    """State of an incremental PCA of one channel after some images.

    Attributes
    ----------
    count : int
        Number of images, m.
    mean : ndarray of float64, shape (d,)
        Mean of the images; d is the number of pixels.
    rows : ndarray of float32, shape (r, d)
        Orthonormal directions of the largest scatter, descending.
    scatter : ndarray of float64, shape (r,)
        Sum over the images of the squared coefficient of each row: m times the variance.
    squares : float
        Sum over the images of the squared distance to the mean.
    """

    count: int
    mean: Doubles
    rows: Singles
    scatter: Doubles
    squares: float


def empty_state(size: tuple[int, int]) -> EigenState:
    """Return the state of no images of a size (width, height)."""
    pixels = size[0] * size[1]
    return EigenState(
        0, np.zeros(pixels), np.zeros((0, pixels), np.float32), np.zeros(0), squares=0.0
    )


def block_length(size: tuple[int, int]) -> int:
    """Return the number of images of a size (width, height) in a block of `BLOCK_BYTES`."""
    return max(1, min(MAX_BLOCK, BLOCK_BYTES // (12 * size[0] * size[1])))


def rank_for(components: int) -> int:
    """Return the number of rows that a state needs for `components` accurate components."""
    return components + int(np.ceil(EXTRA_SHARE * components))


def merge(state: EigenState, block: Singles, rank: int) -> EigenState:
    """Add a block of images to a state, by one step of incremental PCA.

    With n earlier images of mean m1 and b new images of mean m2, the scatter matrix of all is ::

        S = S1 + S2 + n b / (n + b) (m1 - m2) (m1 - m2)^T

    (Ross et al. 2008, "Incremental learning for robust visual tracking", IJCV 77, eq. 3). Its
    eigenvectors follow from the Gram matrix of all rows, which is small. If there are at most
    `rank` directions, the result is exact except for rounding.

    Parameters
    ----------
    state : EigenState
        The earlier state; it is not changed.
    block : ndarray of float32, shape (b, d)
        The new images, which are overwritten.
    rank : int
        Largest number of rows to keep; see `rank_for`.

    Returns
    -------
    EigenState
    """
    n, b = state.count, len(block)
    if b == 0:
        return state
    mean = block.mean(axis=0, dtype=np.float64)
    # With this shift towards the old mean, the scatter of the new images includes the last term.
    block -= (mean + np.sqrt(n / (n + b)) * (state.mean - mean)).astype(np.float32)
    rows, scatter, added = _add_rows(state, block, rank, n + b)
    mean = state.mean + b / (n + b) * (mean - state.mean)
    return EigenState(n + b, mean, rows, scatter, state.squares + added)


def merge_states(first: EigenState, second: EigenState, rank: int) -> EigenState:
    """Return the state for the images of two states, by the equation of `merge`."""
    if not second.count or not first.count:
        return second if second.count else first
    n, m = first.count, second.count
    shift = np.sqrt(n / (n + m) * m) * (second.mean - first.mean)
    block = np.vstack([second.rows, shift.astype(np.float32)])
    block[:-1] *= np.sqrt(second.scatter).astype(np.float32)[:, None]
    rows, scatter, _ = _add_rows(first, block, rank, n + m)
    mean = first.mean + m / (n + m) * (second.mean - first.mean)
    squares = first.squares + second.squares + float((shift**2).sum())
    return EigenState(n + m, mean, rows, scatter, squares)


def _add_rows(
    state: EigenState, block: Singles, rank: int, count: int
) -> tuple[Singles, Doubles, float]:
    """Add the rows of a block to the scatter matrix of a state; also return the added trace."""
    old = len(state.rows)
    roots = np.sqrt(state.scatter)
    gram = np.zeros((old + len(block),) * 2)  # of [roots rows; block]; the upper right is unused
    gram[np.arange(old), np.arange(old)] = state.scatter
    gram[old:, :old] = product(block, state.rows) * roots
    gram[old:, old:] = product(block, block)
    added = float(np.trace(gram[old:, old:]))
    values, weights = largest_eigenpairs(gram, rank, MIN_VARIANCE * count * block.shape[1])
    weights[:old] *= roots[:, None]
    combine = weights.T.astype(np.float32)
    directions = combine[:, old:] @ block
    directions += combine[:, :old] @ state.rows
    return *orthonormalize(directions, values), added


MIN_VARIANCE = 1e-10
"""Smallest variance of a component per pixel, with 1 as white; smaller ones are rounding."""

MIN_EIGENVALUE_SHARE = 1e-8
"""Smallest eigenvalue relative to the total variance; smaller ones are rounding of the Gram
matrix."""

MAX_DRIFT = 1e-6
"""Largest entry of ``V V^T - 1`` for which the rows V are not orthonormalized again."""

SUM_PIXELS = 4096
"""Number of pixels that are summed in single precision before the sums are added in double."""

SUBSET_SHARE = 0.25
"""Share of the eigenvalues below which LAPACK's ``syevr`` computes only these: 300 of 2,048 take
0.8 s instead of 1.2 s, and the memory of one matrix instead of three. 375 of 631 would take 0.11 s
instead of 0.05 s."""


def product(a: Singles, b: Singles) -> Doubles:
    """Return ``a b^T`` for long rows; single precision alone would lose small variances."""
    result = np.zeros((len(a), len(b)))
    for first in range(0, a.shape[1], SUM_PIXELS):
        result += a[:, first : first + SUM_PIXELS] @ b[:, first : first + SUM_PIXELS].T
    return result


# With two threads, matrices of 150 to 1,200 rows take 3 to 50 times the CPU time.
@threadpool_limits.wrap(limits=1, user_api="blas")
def largest_eigenpairs(gram: Doubles, limit: int, floor: float) -> tuple[Doubles, Doubles]:
    """Return the largest eigenvalues of a Gram matrix, and the weights of its rows.

    Parameters
    ----------
    gram : ndarray of float64, shape (n, n)
        Only the lower left is read; the matrix may be overwritten.
    limit : int
        Largest number of eigenvalues.
    floor : float
        Smallest eigenvalue to return.

    Returns
    -------
    values : ndarray of float64, shape (k,)
        Descending.
    weights : ndarray of float64, shape (n, k)
        Weights that combine the rows to unit vectors: eigenvectors divided by roots of eigenvalues.
    """
    n, trace = len(gram), np.trace(gram)
    if limit < SUBSET_SHARE * n:
        subset = [n - limit - 1, n - 1]
        # The transpose is in Fortran order, which LAPACK accepts without a copy.
        values, vectors = eigh(
            gram.T, lower=False, overwrite_a=True, subset_by_index=subset, check_finite=False
        )
    else:
        values, vectors = np.linalg.eigh(gram, UPLO="L")
    values, vectors = values[::-1], vectors[:, ::-1]
    kept = min(limit, int((values > max(floor, MIN_EIGENVALUE_SHARE * trace)).sum()))
    return values[:kept], vectors[:, :kept] / np.sqrt(values[:kept])


def orthonormalize(rows: Singles, scatter: Doubles) -> tuple[Singles, Doubles]:
    """Drop spurious rows, and make the others orthonormal again after rounding.

    Parameters
    ----------
    rows : ndarray of float32, shape (k, d)
    scatter : ndarray of float64, shape (k,)
        Eigenvalues, descending.

    Returns
    -------
    rows : ndarray of float32, shape (l, d)
        ``l <= k``
    scatter : ndarray of float64, shape (l,)
    """
    overlap = product(rows, rows)
    # If the length of a row is far from 1, its eigenvalue is rounding, and the row is meaningless.
    valid = np.abs(np.diag(overlap) - 1) < 0.5
    if not valid.all():
        rows, scatter, overlap = rows[valid], scatter[valid], overlap[valid][:, valid]
    if np.abs(overlap - np.eye(len(rows))).max(initial=0) > MAX_DRIFT:
        # Gram-Schmidt from the largest scatter, so that errors are removed from small scatter.
        inverse = np.linalg.inv(np.linalg.cholesky(overlap))
        rows = inverse.astype(np.float32) @ rows
    return rows, scatter


def orient(rows: Singles) -> Singles:
    """Choose the sign of each row so that its largest absolute entry is positive.

    This is the rule of scikit-learn. The signs of eigenvectors are arbitrary: without a rule, they
    would depend on rounding.
    """
    positive = [row.max() >= -row.min() for row in rows]
    signs = np.where(positive, 1, -1).astype(np.float32)
    return rows * signs[:, None]


# --- All images of a source ----------------------------------------------------------------------

SHARD = 2048
"""Number of images of a shard. Merging two states of 375 rows takes 0.2 of the time of a shard of
images of 256x256."""

BLOCK_DIVISOR = 4
"""With several shards, the number of images of a block from `block_length` is divided by this: 256
of 256x256. A process then needs less than 1 GB."""

Images = Sequence | Values
"""Files or single images, or one array of images."""


class Stream(NamedTuple):
    """How the states of images are computed.

    Attributes
    ----------
    size : (int, int)
    space : {"ycbcr", "rgb"}
    ranks : sequence of 3 ints
        Largest number of rows of the state of each channel.
    length : int
        Number of images of a block.
    progress : callable, optional
        See `eigengs_dr.Eigenbasis.from_images`; used in this process only.
    encoding : {"srgb", "linear"}, optional
    """

    size: tuple[int, int]
    space: str
    ranks: Sequence[int]
    length: int
    progress: ReadProgress | None = None
    encoding: str | None = None


def find_states(
    source: TrainingImages,
    stream: Stream,
    client: object = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> list[EigenState]:
    """Compute the state of each channel for all images of a source.

    Parameters
    ----------
    stream : Stream
    source, client, checkpoint
        See `eigengs_dr.Eigenbasis.from_images`, also for errors.
    """
    images: Any = list_images(source) if isinstance(source, (str, os.PathLike)) else source
    countable = is_countable(images)
    _check_usable(stream, len(images) if countable else None)
    if client is not None and not countable:
        raise ValueError("the source is not a list of files or images; a cluster needs a list")
    if client is None and not (countable and len(images) > SHARD):
        return _find_states_of_part(images, stream)
    with nullcontext(checkpoint) if checkpoint else TemporaryDirectory() as folder:
        return _merge_shards(images, stream, client, Path(folder))


def _check_usable(stream: Stream, count: int | None) -> None:
    """Refuse components that take more memory than there is: a block, all rows, and a merge."""
    width, height = stream.size
    rows = [min(rank, count or rank) for rank in stream.ranks]
    images = 3 * min(stream.length, count or stream.length)
    check_usable(
        4 * width * height * (images + sum(rows) + max(rows)),
        f"components of images of {width}x{height} pixels",
        "choose a smaller size or fewer components",
    )


def is_countable(source: object) -> bool:
    """Return whether a source is a sequence of files or single images, which can be sharded."""
    if isinstance(source, np.ndarray):
        return source.ndim == 4 or (source.ndim == 3 and source.shape[2] not in (1, 3))
    return isinstance(source, Sequence) and all(
        isinstance(item, (str, os.PathLike)) or getattr(item, "shape", ())[2:] in ((1,), (3,))
        for item in source
    )


def _merge_shards(images: Images, stream: Stream, client: object, folder: Path) -> list[EigenState]:
    """Merge the states of shards in order.

    In the folder, ``pca-C.npz`` holds the state of channel C after some shards, and their number.
    """
    total, report = len(images), stream.progress or (lambda done, total, row: None)
    files = [folder / f"pca-{c}.npz" for c in range(len(stream.ranks))]
    merged = [int(read_arrays(file)["shards"]) if file.exists() else 0 for file in files]
    begun = shard = min(merged)
    done = min(begun * SHARD, total)
    in_shard = None if client is not None else lambda n, of, row: report(done + n, total, row)
    length = stream.length if total <= SHARD else max(1, stream.length // BLOCK_DIVISOR)
    stream = stream._replace(length=length, progress=in_shard)
    tasks = (
        (k, _absolute(images[k * SHARD : (k + 1) * SHARD]))
        for k in range(begun, -(-total // SHARD))
    )
    waiting: dict[int, list[EigenState]] = {}
    with closing(completed(executor_for(client), make_shard, tasks, stream)) as ended:
        for (k, part), (states, noted) in ended:
            tell_all(noted)
            waiting[k] = states
            done += len(part)
            if client is not None:
                report(done, total, {})
            while ready := waiting.pop(shard, None):
                for c, file in enumerate(files):
                    state = ready.pop(0)  # frees its memory before the next shard
                    if merged[c] <= shard:
                        if shard:
                            state = merge_states(_read(file), state, stream.ranks[c])
                        numbers = {"shards": shard + 1, **vars(state)}
                        write_arrays(file, {key: np.asarray(v) for key, v in numbers.items()})
                    del state
                shard += 1
    result = [_read(file) for file in files]
    if result[0].count == 0:
        raise ImageError(f"none of {total} images can be read; check the files")
    return result


def make_shard(task: tuple[int, Images], stream: Stream) -> tuple[list[EigenState], NotedImages]:
    """Compute the states of a shard, and return the warnings; this runs on a worker.

    If no file of a shard can be read, its states are empty; an invalid array is an error.
    """
    _, images = task
    with kept_warnings() as noted:
        try:
            states = _find_states_of_part(images, stream)
        except ImageError as error:
            if not isinstance(images, Sequence):
                raise
            states = [empty_state(stream.size) for _ in stream.ranks]
            tell("", str(error))
    return states, noted


def _find_states_of_part(images: Images, stream: Stream) -> list[EigenState]:
    """Compute the state of each channel, block by block."""
    size, space, ranks, length, progress, encoding = stream
    states = [empty_state(size) for _ in ranks]
    with closing(read_blocks(images, size, space, length, progress, encoding)) as blocks:
        for block in blocks:
            for c, rank in enumerate(ranks):
                states[c] = merge(states[c], block[:, c], rank)
            del block  # before the next one is read
    return states


def _absolute(images: Images) -> Images:
    """Make file names absolute, because a worker runs in another folder."""
    if not isinstance(images, Sequence):
        return images
    is_file = (str, os.PathLike)
    return [local_path(item).absolute() if isinstance(item, is_file) else item for item in images]


def _read(file: Path) -> EigenState:
    """Return the state in a file; what follows from it is bit-identical."""
    arrays = read_arrays(file)
    count, squares = arrays["count"].item(), arrays["squares"].item()
    return EigenState(count, arrays["mean"], arrays["rows"], arrays["scatter"], squares)
