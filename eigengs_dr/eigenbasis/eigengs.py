"""EigenGS: one set of Gaussians for all principal components of a family of images.

A component is rendered as ``Psi~_j(x) = sum_n psi_nj w_n(x) + beta_j``, so an image with the
coefficients a_j is ``Psi~_0 + sum_j a_j Psi~_j = sum_n (c_n0 + sum_j a_j psi_nj) w_n(x) + const``:
Gaussians again, whose colours are one matrix product (the paper, eq. 2 and 3).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..fitting.solvers.normal_equations import NormalEquations, squared_norms
from ..gaussian.gaussians import Gaussians
from ..image.folder import to_planes
from ..image.io import check_image
from ..image.resize import resample
from ..storage import npz
from .basis import Eigenbasis
from .components.solve import ComponentFit, State, check_arguments, fit_components, with_colors
from .components.split import split_reason, wants_split
from .model_file import FORMAT, VERSION, from_members, layout_of, to_members
from .projection import ComponentProjector
from .truncation import TruncationCurve, curve_from_eigenvalues

Planes = NDArray[np.float32]
TrainProgress = Callable[[int, int, dict[str, Any]], None]


@dataclass(frozen=True, eq=False)
class EigenGS:
    """Gaussians that render the mean image and every principal component of a family of images.

    Attributes
    ----------
    gaussians : Gaussians
        N splats at the size of the training images, with the colours and the background of the
        mean image, "component 0".
    weights : tuple of ndarray of float32, shape (k, N + 1)
        For every channel, the weight ``psi_nj`` of splat n in component j, in the order of falling
        eigenvalues; the last column is the background ``beta_j``. Channels may differ in k.
    eigenvalues : tuple of ndarray of float64, shape (k,)
        Variance along each component.
    mean_image : ndarray of float32, shape (C, H, W)
        The mean image as pixels, in the space of the Gaussians.
    low : int
        Number of splats N_l, the first ones, that serve the low frequencies alone; 0 where all
        splats serve all components.
    low_components : int
        Components of each channel, the first ones, that these splats serve.
    split_reason : str
        Why the splats are split or not; empty where an older file does not say.
    variance : ndarray of float64, shape (C,)
        Total variance of the training images, see `eigengs_dr.Eigenbasis`; empty, shape (0,), where
        an older file does not say.
    held_out : ndarray of float64, shape (n + 1,)
        The PSNR of `eigengs_dr.eigenbasis.truncation.TruncationCurve`, in dB, mean over images that
        were not trained on, of their PCA by the first 0, 1, ..., n components; empty where none
        were held out.
    figures : dict of str to float
        What was measured when the model was fitted, see
        `eigengs_dr.eigenbasis.components.solve.ComponentFit`; not saved.
    """

    gaussians: Gaussians
    weights: tuple[Planes, ...]
    eigenvalues: tuple[NDArray[np.float64], ...]
    mean_image: Planes
    low: int = 0
    low_components: int = 0
    split_reason: str = ""
    variance: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    held_out: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    figures: dict[str, float] = field(default_factory=dict)

    @classmethod
    def fit(
        cls,
        basis: Eigenbasis,
        gaussians: int = 5000,
        frequency_aware: bool | str = "auto",
        seed: int = 0,
        preset: str = "default",
        steps: int | None = None,
        backend: str | None = None,
        progress: TrainProgress | None = None,
    ) -> EigenGS:
        """Fit one set of Gaussians to the mean image and all components of an eigenbasis.

        Parameters
        ----------
        basis : Eigenbasis
        gaussians : int, optional
            Number of splats, at most one a pixel.
        frequency_aware : {"auto", True, False}, optional
            Whether a tenth of the splats serve the first 50 components alone, and the others the
            rest; see `eigengs_dr.eigenbasis.components.split.wants_split`.
        seed : int, optional
        preset : {"default", "eigengs"}, optional
            "default" places splats on a grid and solves for the weights of all components at once,
            by one factorisation; "eigengs" trains shapes and weights together from a random start,
            with the settings of the paper.
        steps : int, optional
            Steps of training: of the shapes for "default" (0 by default: 300 gain 0.3 dB), of all
            for "eigengs" (15,000 by default, which takes hours without a GPU).
        backend : {"llvm", "cuda"}, optional
        progress : callable, optional
            ``progress(step, steps, {})`` after every round of training.

        Raises
        ------
        ValueError
            If an argument is out of range; one line.
        BackendError
            If the backend is not there.
        """
        steps = check_arguments(
            (basis.width, basis.height), gaussians, frequency_aware, seed, preset, steps
        )
        split, compared = wants_split(basis, gaussians, frequency_aware, backend)
        total = steps * (2 if split else 1)

        def save(states: list[State]) -> None:
            if progress:
                progress(sum(int(state["step"]) for state in states), total, {})

        fitted = fit_components(basis, gaussians, split, preset, steps, seed, backend, save=save)
        reason = split_reason(basis, gaussians, frequency_aware, compared)
        return cls.from_fit(basis, fitted, compared, split_reason=reason)

    @classmethod
    def from_fit(
        cls, basis: Eigenbasis, fitted: ComponentFit, figures: dict[str, float], **notes: Any
    ) -> EigenGS:
        """Put a model together from what was fitted to a basis, more figures and attributes."""
        return cls(
            gaussians=fitted.gaussians,
            weights=fitted.weights,
            eigenvalues=basis.eigenvalues,
            mean_image=basis.mean,
            low=fitted.low,
            low_components=fitted.low_components,
            variance=basis.variance,
            figures={**fitted.figures, **figures},
            **notes,
        )

    @property
    def components(self) -> tuple[int, ...]:
        """Number of components of every channel."""
        return tuple(len(w) for w in self.weights)

    def truncation_curve(self) -> TruncationCurve | None:
        """Tell how the error of the training images' PCA falls, component by component.

        Returns
        -------
        Fall or None
            See `eigengs_dr.eigenbasis.truncation.curve_from_eigenvalues`; None where an older file
            does not say.
        """
        if not len(self.variance):
            return None
        return curve_from_eigenvalues(self.eigenvalues, self.variance, self.mean_image.size)

    def project(self, image: ArrayLike, target_psnr: float | None = None) -> tuple[Planes, ...]:
        """Find the coefficients of an image: the closest point on the span of the components.

        Least squares on the rendered components, ``min_a |Psi~ a - (I - Psi~_0)|^2``; where they
        render the principal components well, that is PCA's projection. Where there are nearly as
        many components as splats, these are not independent, and coefficients are large and mean
        little one by one, though their rendering is right.

        Parameters
        ----------
        image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
            Of any size; resampled to that of the model.
        target_psnr : float, optional
            Use as few components as reach it for this image at the size of the model, in dB, of the
            channels as in `eigengs_dr.eigenbasis.truncation.TruncationCurve`. All by default.

        Returns
        -------
        tuple of ndarray of float32, shape (m,)
            One array a channel; m <= k, and m = k without a target.

        Raises
        ------
        ValueError
            If the image is unusable, or the target no positive number.

        Warns
        -----
        UserWarning
            If all components do not reach the target; they are used.
        """
        planes = self._planes(check_image(image))
        return self._coefficients(planes, self.equations.correlate(planes), False, target_psnr)

    def reconstruct(
        self, coefficients: tuple[Planes, ...], size: tuple[int, int] | None = None
    ) -> Gaussians:
        """Turn coefficients into Gaussians: one matrix product a channel.

        Parameters
        ----------
        coefficients : tuple of array_like, shape (m,)
            One array a channel, as from `project`; m <= k leaves out the last components.
        size : (int, int), optional
            Native width and height of the result; those of the model by default.

        Returns
        -------
        Gaussians

        Raises
        ------
        ValueError
            If there is not one array a channel, or one has more coefficients than components.
        """
        given = [np.shape(values) for values in coefficients]
        if len(given) != len(self.weights) or not all(
            len(shape) == 1 and shape[0] <= k
            for shape, k in zip(given, self.components, strict=True)
        ):
            raise ValueError(f"coefficients have shapes {given}; expected up to {self.components}")
        return self._colored(self._mean_coefficients + self._sum(coefficients), size)

    def encode(
        self,
        image: ArrayLike,
        colors: str = "exact",
        mean: str = "gaussians",
        target_psnr: float | None = None,
    ) -> Gaussians:
        """Give an image its Gaussians at once, without optimisation.

        Parameters
        ----------
        image : array_like, shape (H, W, 3), (H, W, 1) or (H, W)
            Of any size and aspect ratio: it is resampled to the size of the model, and the
            Gaussians are scaled to it.
        colors : {"exact", "projected"}, optional
            "exact" are the best colours on these shapes, by back-substitution (where the splats
            are split, the best of N_l, and of N_h for what is left); "projected" are those of the
            eigenbasis, which have no more degrees of freedom than there are components.
        mean : {"gaussians", "dense"}, optional
            "dense" is the paper's form: the result lacks the mean image, `dense_mean`.
        target_psnr : float, optional
            With "projected" colours: use as few components as reach it, see `project`.

        Returns
        -------
        Gaussians
            At the size of the image.

        Raises
        ------
        ValueError
            If the image is unusable, an option unknown, or the target no positive number or given
            for exact colours.

        Warns
        -----
        UserWarning
            If all components do not reach the target; they are used.
        """
        for name, value, known in (
            ("colors", colors, ("exact", "projected")),
            ("mean", mean, ("gaussians", "dense")),
        ):
            if value not in known:
                raise ValueError(f"{name} {value!r} is unknown; use one of {', '.join(known)}")
        if colors == "exact" and target_psnr is not None:
            raise ValueError("target_psnr chooses components; use it with colors 'projected'")
        pixels = check_image(image)
        size = (pixels.shape[1], pixels.shape[0])
        planes = self._planes(pixels)
        if mean == "dense":
            planes = planes - self.mean_image
        correlations = self.equations.correlate(planes)
        if colors == "exact":
            return self._colored(self.equations.solve(correlations), size)
        found = self._coefficients(planes, correlations, mean == "dense", target_psnr)
        if mean == "dense":
            return self._colored(self._sum(found), size)
        return self.reconstruct(found, size)

    def dense_mean(self, width: int, height: int) -> Planes:
        """Return the mean image as pixels, shape (height, width, C), in the space of the model."""
        return resample(np.moveaxis(self.mean_image, 0, 2), width, height)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as an ``.npz`` file, all or nothing.

        Weights are stored in half precision, each component scaled by its largest weight.

        Raises
        ------
        OSError
            If the file cannot be written; an existing one is then as before.
        """
        npz.write(path, FORMAT, VERSION, to_members(self))

    @classmethod
    def load(cls, path: str | os.PathLike[str], backend: str | None = None) -> EigenGS:
        """Read a model that `save` wrote.

        Parameters
        ----------
        path : path-like
        backend : {"llvm", "cuda"}, optional

        Raises
        ------
        ValueError
            If the file is not one of these, is damaged, newer than this package, or holds values
            that are not finite or do not fit together: one line that names file and key.
        OSError
            If it cannot be opened.
        """
        version = npz.read_version(path, FORMAT, VERSION)
        arrays = npz.read(path, FORMAT, VERSION, layout_of(version))
        try:
            return cls(**from_members(arrays, backend))
        except ValueError as error:
            raise ValueError(f"{Path(path)}: {error}") from None

    def _planes(self, pixels: Planes) -> Planes:
        """Bring an RGB image to the size and space of the model, shape (C, H, W)."""
        width, height = self.gaussians.width, self.gaussians.height
        if pixels.shape[:2] != (height, width):
            pixels = resample(pixels, width, height)
        return to_planes(pixels, self.gaussians.space).reshape(-1, height, width)

    def _colored(
        self, coefficients: NDArray[np.float64], size: tuple[int, int] | None
    ) -> Gaussians:
        """The model's shapes with the colours and background given, scaled to a size."""
        result = with_colors(self.gaussians, coefficients, self.gaussians.space)
        return result.scaled(*size) if size else result

    # --- What is computed once a model -----------------------------------------------------------

    @cached_property
    def equations(self) -> NormalEquations:
        """The normal equations of all splats, factorised."""
        return NormalEquations(self.gaussians, self.low)

    @cached_property
    def _mean_coefficients(self) -> NDArray[np.float64]:
        """Colours and background of the mean image, shape (N + 1, C)."""
        arrays = self.gaussians.to_arrays()
        return np.vstack([arrays["color"], arrays["background"]]).astype(np.float64)

    @cached_property
    def _mean_product(self) -> NDArray[np.float64]:
        """What the rendered mean image correlates to, shape (N + 1, C)."""
        return self.equations.product(self._mean_coefficients)

    @cached_property
    def _projector(self) -> ComponentProjector:
        """The rendered components, with the factors of their least squares."""
        return ComponentProjector(self.equations, self.weights)

    def _coefficients(
        self,
        planes: Planes,
        correlations: NDArray[np.float64],
        centred: bool,
        target_psnr: float | None,
    ) -> tuple[Planes, ...]:
        """Least squares on the rendered components; `centred` planes lack the mean image."""
        seen = correlations if centred else correlations - self._mean_product
        if target_psnr is None:
            return self._projector.coefficients(seen)
        lengths = squared_norms(planes)
        if not centred:
            lengths = self.equations.error(self._mean_coefficients, correlations, lengths)
        return self._projector.coefficients_for_psnr(seen, lengths, planes.size, target_psnr)

    def _sum(self, coefficients: tuple[Any, ...]) -> NDArray[np.float64]:
        """``sum_j a_j psi_nj`` for every channel, shape (N + 1, C)."""
        columns = []
        for weights, values in zip(self.weights, coefficients, strict=True):
            values = np.asarray(values, np.float32)
            columns.append(np.einsum("j,jn->n", values, weights[: len(values)]))
        return np.stack(columns, axis=1).astype(np.float64)
