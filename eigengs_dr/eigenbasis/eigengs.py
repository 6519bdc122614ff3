"""EigenGS: one set of Gaussians for all principal components of a family of images.

The Gaussians render component j as ``Psi~_j(x) = sum_n psi_nj w_n(x) + beta_j``. An image with the
coefficients a_j is ``Psi~_0 + sum_j a_j Psi~_j = sum_n (c_n0 + sum_j a_j psi_nj) w_n(x) + const``.
These are the same Gaussians, with colours from one matrix product (eq. 2 and 3 of the paper).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..backend.entry_points import checks_types, entry_point, shows_progress
from ..backend.types import ArrayLike, Doubles, Record, Singles
from ..gaussian.gaussians import Gaussians, notebook_html, with_colors
from ..image.io import Codes, check_member
from ..image.pixels import EncodedImage, check_encoding
from ..image.resize import resample
from .files import read_model, write_model
from .truncation import TruncationCurve, curve_from_eigenvalues, name_components

if TYPE_CHECKING:  # training, encoding and runs over many images are imported on demand
    from ..image.folder import TrainingImages
    from ..many.images import ImageRow, Images
    from .basis import Eigenbasis
    from .encoder import ModelEncoder


SHIPPED = {"natural": Path(__file__).parent / "data" / "natural.npz"}
"""Files of the package's models, by name; see ``tools/train_natural.py``."""


@dataclass(frozen=True, eq=False, repr=False)
class EigenGS:
    """Gaussians that render the mean image and all principal components of a family of images.

    Attributes
    ----------
    gaussians : Gaussians
        N Gaussians at the size of the training images, with the colours of the mean image.
    weights : tuple of C ndarrays of float32, shape (k_c, N + 1)
        Weight ``psi_nj`` of Gaussian n in component j, in the order of descending eigenvalues; the
        last column is the background ``beta_j``.
    eigenvalues : tuple of C ndarrays of float64, shape (k_c,)
        Variance along each component.
    mean_image : ndarray of float32, shape (C, H, W)
        Pixels of the mean image, in the space of the Gaussians.
    low, low_components : int
        The first `low` Gaussians only represent the first `low_components` of each channel; both
        are 0 if all Gaussians represent all components.
    variance : ndarray of float64, shape (C,) or (0,)
        See `eigengs_dr.Eigenbasis`; empty if unknown.
    held_out : ndarray of float64, shape (n + 1,) or (0,)
        Mean PSNR in dB of PCA with 0, 1, ..., n components, for images that were held out of the
        training; see `eigengs_dr.eigenbasis.truncation.TruncationCurve`. Empty if there were
        none.
    figures : dict of str to float
        See `eigengs_dr.eigenbasis.components.fit_model`; not saved.
    """

    gaussians: Gaussians
    weights: tuple[Singles, ...]
    eigenvalues: tuple[Doubles, ...]
    mean_image: Singles
    low: int = 0
    low_components: int = 0
    variance: Doubles = field(default_factory=lambda: np.zeros(0))
    held_out: Doubles = field(default_factory=lambda: np.zeros(0))
    figures: dict[str, float] = field(default_factory=dict)

    @classmethod
    @shows_progress
    @checks_types
    def fit(
        cls,
        basis: Eigenbasis | TrainingImages,
        gaussians: int = 5000,
        frequency_aware: bool | str = "auto",
        seed: int = 0,
        preset: str = "default",
        iterations: int | None = None,
        backend: str | None = None,
        progress: Any = None,
    ) -> EigenGS:
        """Fit one set of Gaussians to the mean image and all components of an eigenbasis.

        Parameters
        ----------
        basis : Eigenbasis, or path, array or iterable
            Images are converted to their basis, ``Eigenbasis.from_images(images)``.
        gaussians : int, optional
            Number of Gaussians, at most one per pixel.
        frequency_aware : {"auto", True, False}, optional
            Whether a tenth of the Gaussians only represent the first 50 components, and the others
            the rest; "auto" does so if the longer side has at least 512 pixels.
        seed : int, optional
        preset : {"default", "eigengs"}, optional
            "default" places Gaussians on a grid and solves for all weights by one factorisation.
            "eigengs" trains shapes and weights from a random start, with the paper's settings.
        iterations : int, optional
            Number of training steps of "eigengs": 15,000 by default, which take hours without a
            GPU.
        backend : {"llvm", "cuda"}, optional
        progress : bool or callable, optional
            By default a bar, in a terminal or a notebook, after two seconds; False shows none. A
            function is called as ``progress(step, steps, {})`` after every round of training.

        Raises
        ------
        ValueError
            If an argument is out of range.
        BackendError
            If the backend does not work.
        """
        from .basis import Eigenbasis
        from .components import TrainOptions, fit_model

        if not isinstance(basis, Eigenbasis):
            basis = Eigenbasis.from_images(basis, progress=False)
        options = TrainOptions(
            size=(basis.width, basis.height),
            gaussians=gaussians,
            frequency_aware=frequency_aware,
            preset=preset,
            iterations=iterations,
            seed=seed,
        )

        def report(states: object, done: int, total: int) -> None:
            if progress:
                progress(done, total, {})

        return cls(**fit_model(basis, options, backend, after_round=report))

    def __repr__(self) -> str:
        size = f"{len(self.gaussians)} Gaussians, {self.gaussians.width}x{self.gaussians.height}"
        return f"EigenGS({size} pixels, {name_components(self.gaussians.space, self.components)})"

    _repr_html_ = notebook_html  # what a notebook shows

    @property
    def components(self) -> tuple[int, ...]:
        """Number of components of each channel."""
        return tuple(len(w) for w in self.weights)

    def truncation_curve(self) -> TruncationCurve | None:
        """Return the truncation curve of the PCA of the training images.

        It is None if the variance is unknown.
        """
        if not len(self.variance):
            return None
        return curve_from_eigenvalues(self.eigenvalues, self.variance, self.mean_image.size)

    @entry_point
    def project(
        self, image: ArrayLike, target_psnr: float | None = None, encoding: str | None = None
    ) -> tuple[Singles, ...]:
        """Compute the coefficients of an image by least squares on the rendered components.

        The function solves ``min_a |Psi~ a - (I - Psi~_0)|^2``. If the Gaussians render the
        components well, the result is the projection of PCA. With nearly as many components as
        Gaussians, individual coefficients are large and not meaningful, but their sum renders well.

        Parameters
        ----------
        image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
            An image of any size; it is resampled to the size of the model.
        target_psnr : float, optional
            Use the fewest components that reach this PSNR, in dB, for the image at the size of the
            model; see `eigengs_dr.eigenbasis.truncation.TruncationCurve`. By default all.
        encoding : {"srgb", "linear"}, optional
            What the pixels are, see `eigengs_dr.Eigenbasis.from_images`.

        Returns
        -------
        tuple of C ndarrays of float32, shape (m_c,)
            ``m_c <= k_c``; without a target ``m_c = k_c``.

        Raises
        ------
        ValueError
            If the image cannot be used or the target is not a positive number.

        Warns
        -----
        UserWarning
            If all components miss the target; the result then has all of them. If the image is
            brighter than white.
        """
        return self.encoder.project(check_member(image, encoding), target_psnr)

    @entry_point
    def reconstruct(
        self, coefficients: Sequence[ArrayLike], size: tuple[int, int] | None = None
    ) -> Gaussians:
        """Convert coefficients to Gaussians, by one matrix product per channel.

        Parameters
        ----------
        coefficients : tuple of C array_like, shape (m_c,)
            Coefficients from `project`; ``m_c < k_c`` leaves out the last components.
        size : (int, int), optional
            Native width and height of the result; by default those of the model.

        Raises
        ------
        ValueError
            If there is not one array per channel, one has more than k_c coefficients, or a
            coefficient is not finite.
        """
        shapes, limits = [np.shape(values) for values in coefficients], self.components
        if len(shapes) != len(limits) or not all(
            len(shape) == 1 and shape[0] <= k for shape, k in zip(shapes, limits, strict=True)
        ):
            raise ValueError(f"coefficients have shapes {shapes}; expected up to {limits}")
        if not all(np.isfinite(np.asarray(values, np.float32)).all() for values in coefficients):
            raise ValueError("coefficients are not all finite in single precision; replace them")
        return self._colored(self.encoder.mean_colors + self.encoder.sum(coefficients), size)

    @entry_point
    def encode(
        self,
        image: ArrayLike,
        colors: str = "exact",
        mean: str = "gaussians",
        target_psnr: float | None = None,
        encoding: str | None = None,
    ) -> Gaussians:
        """Encode an image as Gaussians with its native size, without optimisation.

        Parameters
        ----------
        image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
            An image of any size and aspect ratio; it is resampled to the size of the model, and
            the Gaussians are scaled to the size of the image.
        colors : {"exact", "projected"}, optional
            "exact" computes the best colours for the shapes, by back-substitution. With a split, it
            computes the best colours of the first `low` Gaussians, then those of the others for the
            residual. "projected" has as many degrees of freedom as there are components.
        mean : {"gaussians", "dense"}, optional
            "dense" is the form of the paper: the result does not include the mean image,
            `dense_mean`.
        target_psnr : float, optional
            Use the fewest components that reach this PSNR; only with "projected", see `project`.
        encoding : {"srgb", "linear"}, optional
            What the pixels are, see `eigengs_dr.Eigenbasis.from_images`. Light above white is kept
            in renderings and files of floats, with a warning: displays and textures clamp it.

        Raises
        ------
        ValueError
            As for `project`; also if an option is unknown, or a target is combined with exact
            colours.
        """
        pixels = check_member(image, encoding)
        check_coding(colors, mean, target_psnr)
        columns = self.encoder.columns(pixels, colors, mean == "dense", target_psnr)
        return self._colored(columns, (pixels.shape[1], pixels.shape[0]))

    @shows_progress
    @checks_types
    def encode_many(
        self,
        images: Images,
        output: str | os.PathLike[str] | None = None,
        *,
        overwrite: bool = False,
        colors: str = "exact",
        mean: str = "gaussians",
        target_psnr: float | None = None,
        encoding: str | None = None,
        progress: Any = None,
        client: object = None,
    ) -> list[ImageRow]:
        """Encode many images; an image that fails gets a row with its error, and the run continues.

        Parameters
        ----------
        images, output, overwrite, progress, client
            See `eigengs_dr.fit_many`. Without an output folder, ``ImageRow.result`` is a
            `Gaussians`. Rows have the PSNRs of its picture as `eigengs_dr.psnr` computes them, or
            None with the mean "dense", without which a set is no picture.
        colors, mean, target_psnr, encoding
            See `encode`. The Gaussians are bit-identical to those of `encode`.

        Returns
        -------
        list of ImageRow
            One row for each image, in order.

        Raises
        ------
        ValueError, OSError, Interrupted
            See `encode` and `eigengs_dr.fit_many`.
        """
        from ..many.images import digest, fingerprint
        from ..many.run import Job, run_images

        check_coding(colors, mean, target_psnr)
        check_encoding(encoding)
        work = partial(_encode_all, model=self, options=(colors, mean, target_psnr))
        options = {"colors": colors, "mean": mean, "target_psnr": target_psnr, "encoding": encoding}
        options |= {"model": fingerprint(self)}
        read, has_picture = partial(_read, encoding=encoding), mean != "dense"
        job = Job(work, read, None, 0, digest(options), has_picture)
        return run_images(images, output, overwrite, job, progress, client)

    def _colored(self, columns: Doubles, size: tuple[int, int] | None) -> Gaussians:
        """Return the Gaussians with other colours and background (N + 1, C), scaled to a size."""
        result = with_colors(self.gaussians, columns, self.gaussians.space)
        return result.scaled(*size) if size else result

    @checks_types
    def dense_mean(self, width: int, height: int) -> Singles:
        """Return the mean image as pixels, shape (height, width, C), in the space of the model."""
        return resample(np.moveaxis(self.mean_image, 0, 2), width, height)

    @checks_types
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.npz`` file atomically; if that raises OSError, an old file is unchanged."""
        write_model(path, vars(self))

    @classmethod
    @checks_types
    def load(cls, path: str | os.PathLike[str], backend: str | None = None) -> EigenGS:
        """Read a model that `save` wrote, or a model of this package.

        Parameters
        ----------
        path : path-like
            A file, or a name in `SHIPPED`.
        backend : {"llvm", "cuda"}, optional

        Raises
        ------
        ValueError, OSError
            As for `eigengs_dr.Gaussians.load`; also if there is no such file or name.
        """
        file = SHIPPED.get(str(path), Path(path))
        if not file.is_file():
            names = ", ".join(SHIPPED)
            raise ValueError(f"model {str(path)!r} is neither a file nor one of: {names}")
        return cls(**read_model(file, backend))

    def __getstate__(self) -> Record:
        """Leave out the encoder, whose factors cannot be copied."""
        return {key: value for key, value in self.__dict__.items() if key != "encoder"}

    @cached_property
    def encoder(self) -> ModelEncoder:
        """The `eigengs_dr.eigenbasis.encoder.ModelEncoder` of the model, with cached values."""
        from .encoder import ModelEncoder

        return ModelEncoder(self.gaussians, self.weights, self.mean_image, self.low)


def _encode_all(
    images: list[EncodedImage], model: EigenGS, options: tuple[str, str, float | None]
) -> list[Gaussians]:
    """Encode images, in this process or on a worker."""
    return [model.encode(Codes(image.pixels), *options) for image in images]


def _read(image: Any, name: str, encoding: str | None) -> EncodedImage:
    """Read an image of a family."""
    return EncodedImage(check_member(image, encoding, f"image {name}"), "srgb")


def check_coding(colors: str, mean: str, target_psnr: float | None) -> None:
    """Raise ValueError if options of `eigengs_dr.EigenGS.encode` are unknown or contradictory.

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
