"""The eigenbasis of a family of images: PCA of each colour channel, block by block."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import index
from typing import Any

import numpy as np

from ..backend.entry_points import checks_types, shows_progress
from ..backend.messages import shown, warn
from ..backend.types import ArrayLike, Doubles, Singles
from ..gaussian.gaussians import notebook_html
from ..image.folder import TrainingImages, find_lists
from ..image.io import check_member
from ..image.notes import series
from ..image.pixels import check_encoding, check_size
from ..image.resize import resample
from ..image.space import space_of, to_planes
from .files import ENERGY_TOLERANCE, read_basis, write_basis
from .incremental import Stream, block_length, find_states, orient, rank_for
from .truncation import (
    CHANNELS,
    TruncationCurve,
    curve_from_eigenvalues,
    curve_from_residuals,
    name_components,
    residual_energy,
)


@dataclass(frozen=True, eq=False, repr=False)
class Eigenbasis:
    """The mean image and the principal components of a family of images.

    Each channel of an image I is approximated by ``Psi_0 + sum_j w_j Psi_j`` with
    ``w_j = <Psi_j, I - Psi_0>``.

    Attributes
    ----------
    mean : ndarray of float32, shape (C, H, W)
        Mean image, in [0, 1], in the space of the basis.
    components : tuple of C ndarrays of float32, shape (k_c, H, W)
        Orthonormal components; the numbers k_c may differ and be 0. The entry of a component with
        the largest absolute value is positive.
    eigenvalues : tuple of C ndarrays of float64, shape (k_c,)
        Variance along each component, descending; the covariance is ``1/m sum v v^T`` over the m
        training images (eq. 1 of the paper).
    variance : ndarray of float64, shape (C,)
        Total variance: the sum of all eigenvalues, including those of dropped components.
    count : int
        Number of training images, m.
    space : {"ycbcr", "rgb"}
        Colour space of the C = 3 channels.
    """

    mean: Singles
    components: tuple[Singles, ...]
    eigenvalues: tuple[Doubles, ...]
    variance: Doubles
    count: int
    space: str

    @classmethod
    @shows_progress
    @checks_types
    def from_images(
        cls,
        images: TrainingImages,
        size: tuple[int, int] = (256, 256),
        components: int | Sequence[int] = 300,
        energy: float | None = None,
        space: str = "ycbcr",
        progress: Any = None,
        client: object = None,
        checkpoint: str | os.PathLike[str] | None = None,
        encoding: str | None = None,
    ) -> Eigenbasis:
        """Compute the eigenbasis of a family of images in one pass.

        The result is bit-identical for any number of workers. Blocks of up to 1,024 images are
        merged, so that memory does not grow with the number of images: it is that of a block
        (805 MB), plus ``5 k d`` numbers for k components of d pixels in 3 channels. The result is
        exact for one block; with more blocks, the last components lose some variance: with 4,096
        crops of 256x256 and 300 components, 0.09 dB on the crops and 0.01 dB on 200 others.

        Parameters
        ----------
        images : path, array or iterable
            See `eigengs_dr.image.folder.read_blocks`. For an array that is computed part by part,
            pass the parts: ``(block.compute() for block in array.blocks)`` for a dask.array.
        size : (int, int)
            Width and height of the basis.
        components : int or sequence of 3 ints
            Largest number of components of each channel.
        energy : float, optional
            Keep the fewest components with this share of a channel's variance, in (0, 1].
        space : {"ycbcr", "rgb"}
            Space of the channels.
        progress : bool or callable, optional
            By default a bar, in a terminal or a notebook, after two seconds; False shows none. A
            function is called as ``progress(done, total, {})`` after every image, on a cluster
            after every shard; `total` may be None.
        client : distributed.Client, optional
            Dask cluster whose workers do the work; None is this process. Workers read the files, so
            they need the same file system.
        checkpoint : path-like, optional
            An existing folder for this call only, which stores results of tasks, so that the same
            call can be continued after an interruption; the caller deletes it. By default a
            temporary folder.
        encoding : {"srgb", "linear"}, optional
            What the pixels of all images are, see `eigengs_dr.fit`. By default a tensor of Dr.Jit
            holds linear light, as those of `mitsuba.render`, and floats of other arrays are sRGB.

        Raises
        ------
        ValueError
            If an argument is out of range, or the source is an iterator and there is a client; an
            `ImageError` if no image can be read.
        ClusterError
            If the cluster cannot be used, or is lost.

        Warns
        -----
        UserWarning
            If images are skipped, cropped, too few or brighter than white, `components` is too low
            for the energy, or the folder holds a list of lights (.lp).
        """
        size, limits = check_size(size), check_components(components, energy)
        ranks = [rank_for(k) for k in limits]
        check_encoding(encoding)
        if isinstance(images, (str, os.PathLike)) and os.path.isdir(images):
            for file in find_lists(images)[:1]:
                warn(f"{file}: names the lights of photos; Relightable.fit makes a model of them")
        stream = Stream(size, space, ranks, block_length(size), progress, encoding)
        with series():
            states = find_states(images, stream, client, checkpoint)
        count, shape = states[0].count, (size[1], size[0])
        if energy is None and count <= max(limits):
            images_give = "1 image gives" if count == 1 else f"{count} images give"
            warn(f"{images_give} at most {count - 1} components per channel")
        pairs = list(zip(states, limits, strict=True))
        basis = cls(
            mean=np.stack([state.mean for state in states]).astype(np.float32).reshape(-1, *shape),
            components=tuple(orient(state.rows[:k]).reshape(-1, *shape) for state, k in pairs),
            eigenvalues=tuple(state.scatter[:k] / count for state, k in pairs),
            variance=np.array([state.squares for state in states]) / count,
            count=count,
            space=space,
        )
        if energy is None:
            return basis
        return basis.truncated(_ranks_for_energy(basis, limits, energy))

    def __repr__(self) -> str:
        components = name_components(self.space, map(len, self.components))
        return f"Eigenbasis({self.count} images, {self.width}x{self.height} pixels, {components})"

    _repr_html_ = notebook_html  # what a notebook shows

    @property
    def width(self) -> int:
        """Width in pixels."""
        return self.mean.shape[2]

    @property
    def height(self) -> int:
        """Height in pixels."""
        return self.mean.shape[1]

    def project(self, image: ArrayLike, encoding: str | None = None) -> tuple[Singles, ...]:
        """Return the coefficients w_j of an image, a tuple of C float32 arrays of shape (k_c,).

        The image, (H, W, 3), (H, W, 1) or (H, W), may have any size and is resampled to the basis.
        For its encoding see `from_images`. The method warns about light above white, and raises
        `ImageError` if `eigengs_dr.image.io.check_image` rejects the array.
        """
        return self._coefficients(self._centred(image, encoding))

    def reconstruct(self, coefficients: Sequence[ArrayLike]) -> Singles:
        """Return the image for C arrays of coefficients, shape (k_c,), as `project` returns them.

        The image is RGB, not clamped, float32, shape (H, W, 3). The method raises ValueError unless
        there is one coefficient for each component.
        """
        weights = [np.asarray(w, np.float32) for w in coefficients]
        actual, expected = [w.shape for w in weights], [(len(c),) for c in self.components]
        if actual != expected:
            raise ValueError(f"coefficients have shapes {actual}; expected {expected}")
        pairs = zip(weights, self.components, strict=True)
        planes = self.mean + np.stack([np.tensordot(w, c, 1) for w, c in pairs])
        image = np.ascontiguousarray(np.moveaxis(planes, 0, 2))
        return np.asarray(space_of(self.space).decode_image(image))

    def energy(self) -> tuple[Doubles, ...]:
        """Return the share of the variance of the first 1, 2, ..., k_c components.

        The result is a tuple of C float64 arrays of shape (k_c,), ascending, at most 1.
        """
        pairs = zip(self.eigenvalues, self.variance, strict=True)
        return tuple(np.minimum(np.cumsum(v) / (total or 1), 1) for v, total in pairs)

    def truncation_curve(
        self, images: Iterable[ArrayLike] | None = None, encoding: str | None = None
    ) -> TruncationCurve:
        """Return the mean PSNR of images as a function of the number of components.

        ``basis.truncated(basis.truncation_curve(images).rank_for_psnr(30))`` reaches 30 dB.

        Parameters
        ----------
        images : iterable of array_like, optional
            At least one image as for `project` (otherwise ValueError), preferably not from the
            training. By default, the curve of the training images follows from the eigenvalues.
        encoding : {"srgb", "linear"}, optional
            See `from_images`.
        """
        if images is None:
            if encoding is not None:
                raise ValueError(
                    "encoding is for the pixels of images, and the curve follows from the "
                    "eigenvalues; leave it out"
                )
            return curve_from_eigenvalues(self.eigenvalues, self.variance, self.mean.size)
        with series():
            rows = [self._residuals(image, encoding) for image in images]
        if not rows:
            raise ValueError("there are no images to measure the basis on; pass at least one")
        residuals = [np.stack(channel) for channel in zip(*rows, strict=True)]
        return curve_from_residuals(self.eigenvalues, residuals, self.mean.size)

    def truncated(self, components: int | Sequence[int]) -> Eigenbasis:
        """Return the basis of the first components; `components` is one number, or one per channel.

        The method raises ValueError for a negative number, or if there are not C numbers.
        """
        counts = check_components(components)
        return replace(
            self,
            components=tuple(c[:k] for c, k in zip(self.components, counts, strict=True)),
            eigenvalues=tuple(e[:k] for e, k in zip(self.eigenvalues, counts, strict=True)),
        )

    @checks_types
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.npz`` file atomically; if that raises OSError, an old file is unchanged."""
        write_basis(path, vars(self))

    @classmethod
    @checks_types
    def load(cls, path: str | os.PathLike[str]) -> Eigenbasis:
        """Read a file that `save` wrote.

        Raises
        ------
        ValueError
            If the file is not a basis, damaged, too new or inconsistent; names the file and the
            key.
        OSError
            If the file cannot be opened.
        """
        return cls(**read_basis(path))

    def _centred(self, image: ArrayLike, encoding: str | None) -> Singles:
        """Resample and convert an image, and subtract the mean; shape (C, H, W)."""
        pixels = resample(check_member(image, encoding), self.width, self.height)
        planes = to_planes(pixels, self.space) - self.mean.reshape(len(self.mean), -1)
        return planes.reshape(self.mean.shape)

    def _coefficients(self, planes: Singles) -> tuple[Singles, ...]:
        pairs = zip(self.components, planes, strict=True)
        return tuple(np.tensordot(components, plane) for components, plane in pairs)

    def _residuals(self, image: ArrayLike, encoding: str | None) -> list[Doubles]:
        """Return the squared error of each channel after 0, 1, ..., k_c components."""
        planes = self._centred(image, encoding)
        lengths = np.einsum("cij,cij->c", planes, planes, dtype=np.float64)
        pairs = zip(lengths, self._coefficients(planes), strict=True)
        return [residual_energy(length, w.astype(np.float64) ** 2) for length, w in pairs]


def check_components(
    components: int | Sequence[int], energy: float | None = None
) -> tuple[int, int, int]:
    """Return the limit of components of each channel; raise ValueError for invalid arguments."""
    if energy is not None and not 0 < energy <= 1:
        raise ValueError(f"energy is {energy}; expected a share of the variance in (0, 1]")
    try:
        numbers = components if isinstance(components, Iterable) else (components,) * 3
        y, cb, cr = map(index, numbers)
    except (TypeError, ValueError):
        raise ValueError(
            f"components is {shown(components)}; expected a number, or three"
        ) from None
    if min(y, cb, cr) < 0:
        raise ValueError(f"components is {components!r}; expected no negative number")
    return y, cb, cr


def _ranks_for_energy(basis: Eigenbasis, limits: Sequence[int], energy: float) -> list[int]:
    """Return the fewest components with a share of the variance; warn if the limits are too low."""
    ranks = []
    names, shares = CHANNELS[basis.space], basis.energy()
    for name, held, cap, total in zip(names, shares, limits, basis.variance, strict=True):
        ranks.append(int(np.searchsorted(held, energy)) + 1)
        share = held[-1] if len(held) else 0.0
        if total > 0 and len(held) == cap and share < energy - ENERGY_TOLERANCE:
            warn(
                f"channel {name}: {cap} components hold {share:.2%} of the variance, "
                f"less than {energy:.2%}; raise components"
            )
    return ranks
