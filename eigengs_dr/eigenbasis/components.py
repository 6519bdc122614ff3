"""The fit of shared Gaussians to an eigenbasis: shapes, then weights for each component.

With a frequency split, there are two bands: few Gaussians represent the first components, the
others the rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..backend.entry_points import check_types, entry_point
from ..backend.types import Doubles, Record, Singles
from ..fitting.place import grid_of
from ..gaussian.gaussians import Gaussians, concatenate, with_colors
from ..image.metrics import psnr_from_mse
from ..image.pixels import check_encoding, check_size
from ..image.space import FAMILY_SPACES, space_of
from ..paper.joint_training import Band, State, joint_shapes, joint_weights, train_jointly
from .basis import Eigenbasis, check_components
from .normal_equations import BATCH, NormalEquations, squared_norms
from .truncation import check_target

STEPS = {"default": 0, "eigengs": 15_000}
"""The presets, with their default numbers of training steps."""


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training, some of which are those of `eigengs_dr.EigenGS.fit`.

    Attributes
    ----------
    size : (int, int)
        Width and height in pixels.
    components : int or tuple of 3 ints
        Largest number of components of each channel.
    energy : float or None
        Keep the fewest components that hold this share of a channel's variance.
    target_psnr : float or None
        Keep the fewest components whose PCA has this mean PSNR, in dB, for the held-out images; see
        `eigengs_dr.eigenbasis.truncation.TruncationCurve`.
    gaussians, frequency_aware, preset, iterations, seed
        See `eigengs_dr.EigenGS.fit`.
    space : {"ycbcr", "rgb"}
        Space of the components.
    encoding : {"srgb", "linear"} or None
        What the pixels of the images are, see `eigengs_dr.Eigenbasis.from_images`.

    Raises
    ------
    ValueError
        If an option is out of range, or two options exclude each other; one line that names it.
    """

    size: tuple[int, int] = (256, 256)
    components: int | tuple[int, int, int] = 300
    energy: float | None = None
    target_psnr: float | None = None
    gaussians: int = 5000
    frequency_aware: bool | str = "auto"
    preset: str = "default"
    iterations: int | None = None
    space: str = "ycbcr"
    seed: int = 0
    encoding: str | None = None

    def __post_init__(self) -> None:
        for name, value in check_types(vars(self), TrainOptions.__annotations__).items():
            object.__setattr__(self, name, value)
        check_components(self.components, self.energy)
        check_encoding(self.encoding)
        if self.target_psnr is not None:
            check_target(self.target_psnr)
            if self.energy is not None:
                raise ValueError(
                    "energy and target_psnr both choose the components; give one of them"
                )
        object.__setattr__(self, "space", space_of(self.space, FAMILY_SPACES))
        if self.preset not in STEPS:
            raise ValueError(f"preset {self.preset!r} is unknown; use one of {', '.join(STEPS)}")
        counts = {
            "gaussians": self.gaussians,
            "seed": self.seed,
            "iterations": self.training_steps,
        }
        for name, number in counts.items():
            if number < 0:
                raise ValueError(f"{name} is {number}; it must be at least 0")
        width, height = check_size(self.size)
        if not 1 <= self.gaussians <= width * height:
            raise ValueError(
                f"gaussians is {self.gaussians}; a basis of {width}x{height} takes 1 to "
                f"{width * height}"
            )
        if self.preset == "eigengs" and self.training_steps < 1:
            raise ValueError("iterations is 0; preset 'eigengs' needs training, so give at least 1")
        if self.preset == "default" and self.training_steps:
            raise ValueError(
                f"iterations is {self.iterations}; preset 'default' trains nothing, so leave them "
                "out, or use preset 'eigengs'"
            )
        if not isinstance(self.frequency_aware, bool) and self.frequency_aware != "auto":
            raise ValueError(
                f"frequency_aware is {self.frequency_aware!r}; use 'auto', True or False"
            )

    @property
    def training_steps(self) -> int:
        """Number of training steps: the given number, or that of the preset."""
        return STEPS[self.preset] if self.iterations is None else self.iterations


LOW_SHARE = 0.1
"""Share of the Gaussians that represent the low frequencies in a split (from the paper)."""

LOW_COMPONENTS = 50
"""Number of components of each channel that count as low frequencies (from the authors' code); with
fewer than 100 components, half of them."""

MIN_SPLIT_SIDE = 512
"""Smallest longer side in pixels for which "auto" splits. In the paper, the split costs 0.4 to 0.8
dB at 256 pixels and gains 1 dB at 512. Here, on cats of 512 pixels with 1,000 to 5,000 Gaussians,
it cost 0.1 dB initially, and gained 0.2 to 0.8 dB after 300 steps."""


@entry_point
def fit_model(
    basis: Eigenbasis,
    options: TrainOptions,
    backend: str | None = None,
    states: Sequence[State] = (),
    after_round: Callable[[list[State], int, int], None] = lambda states, done, total: None,
) -> Record:
    """Fit one set of Gaussians and its weights to all components of a basis.

    Parameters
    ----------
    basis : Eigenbasis
    options : TrainOptions
        Only the options of `eigengs_dr.EigenGS.fit` are used.
    backend : {"llvm", "cuda"}, optional
    states : sequence of dict, optional
        Resume from the first argument of `after_round`: the state of each band.
    after_round : callable, optional
        ``after_round(states, step, steps)`` is called after every round of training; an error that
        it raises ends the training.

    Returns
    -------
    dict of str to object
        Arguments of `eigengs_dr.EigenGS`. The figures are ``psnr_components``, the PSNR of the
        components in dB, weighted by their variances; ``shape_seconds`` and ``weight_seconds``, the
        times of the training and of the rest.

    Raises
    ------
    ValueError
        If the preset is "eigengs" and the basis has no components.
    """
    bands = frequency_bands(basis, options.gaussians, options.frequency_aware)
    split, joint = len(bands) > 1, options.preset == "eigengs"
    steps, states = options.training_steps, list(states)
    started = time.perf_counter()
    for i, band in enumerate(bands if joint else ()):
        previous = states[i] if i < len(states) else None
        for state in train_jointly(band, options.seed + i, steps, backend, previous):
            states[i:] = [state]
            done = sum(int(state["step"]) for state in states)
            after_round(states, done, steps * len(bands))
    trained = time.perf_counter()
    known: Sequence[Singles | None] = [None] * len(basis.components)
    if joint:
        pairs = list(zip(states, bands, strict=True))
        shapes = [joint_shapes(state, band, backend) for state, band in pairs]
        known = _joined([joint_weights(state, band) for state, band in pairs])
    else:
        shapes = [_on_grid(band, backend) for band in bands]
        if split:
            known = _joined([_weights_of(*pair) for pair in zip(shapes, bands, strict=True)])
    gaussians, low = concatenate(shapes), bands[0].number if split else 0
    equations = NormalEquations(gaussians, low)
    fitted = [find_weights(equations, *pair) for pair in zip(basis.components, known, strict=True)]
    mean, _ = find_weights(equations, basis.mean)
    error = sum(
        float(values @ errors)
        for values, (_, errors) in zip(basis.eigenvalues, fitted, strict=True)
    )
    return {
        "gaussians": with_colors(gaussians, mean.T, space_of(basis.space)),
        "weights": tuple(rows for rows, _ in fitted),
        "eigenvalues": basis.eigenvalues,
        "mean_image": basis.mean,
        "low": low,
        "low_components": low_component_count(basis) if split else 0,
        "variance": basis.variance,
        "figures": {
            "shape_seconds": trained - started,
            "weight_seconds": time.perf_counter() - trained,
            "psnr_components": psnr_from_mse(error / basis.mean.size),
        },
    }


def frequency_bands(basis: Eigenbasis, count: int, frequency_aware: bool | str) -> list[Band]:
    """Divide the Gaussians and components into bands, low frequencies first.

    There is one band if `frequency_aware` is False, if it is "auto" and the longer side has fewer
    than `MIN_SPLIT_SIDE` pixels, or if there are too few Gaussians or components for two.
    """
    if frequency_aware == "auto":
        frequency_aware = max(basis.width, basis.height) >= MIN_SPLIT_SIDE
    first = low_component_count(basis)
    if not frequency_aware or count < 2 or first < 1:
        return [Band(count, basis.components)]
    low = max(1, round(LOW_SHARE * count))
    return [
        Band(low, tuple(planes[:first] for planes in basis.components)),
        Band(count - low, tuple(planes[first:] for planes in basis.components)),
    ]


def low_component_count(basis: Eigenbasis) -> int:
    """Return the number of components of each channel that count as low frequencies."""
    return min(LOW_COMPONENTS, max(map(len, basis.components)) // 2)


def _on_grid(band: Band, backend: str | None) -> Gaussians:
    """Return the Gaussians of a band on a grid, with colours of 0 in the space "data"."""
    mean, factor = grid_of(band.size, band.number)
    colors = np.zeros((len(mean), len(band.components)))
    return Gaussians.from_arrays(
        mean, factor, colors, size=band.size, space="data", backend=backend
    )


def _weights_of(gaussians: Gaussians, band: Band) -> list[Singles]:
    """Return the best weights of the Gaussians of a band alone, in its components."""
    equations = NormalEquations(gaussians)
    return [find_weights(equations, planes)[0] for planes in band.components]


def _joined(weights: list[list[Singles]]) -> list[Singles]:
    """Combine the weights of all bands in each channel; cross weights are 0."""
    if len(weights) == 1:
        return weights[0]
    joined = []
    for low, high in zip(*weights, strict=True):
        count, number = len(low), low.shape[1] - 1
        rows = np.zeros((count + len(high), number + high.shape[1]), np.float32)
        rows[:count, :number], rows[:count, -1] = low[:, :-1], low[:, -1]
        rows[count:, number:] = high
        joined.append(rows)
    return joined


def find_weights(
    equations: NormalEquations, planes: Singles, known: Singles | None = None
) -> tuple[Singles, Doubles]:
    """Compute the best weights of Gaussians in the components of a channel.

    Parameters
    ----------
    equations : NormalEquations
    planes : ndarray of float32, shape (k, H, W)
    known : ndarray of float32, shape (k, N + 1), optional
        The weights, if only the errors are needed.

    Returns
    -------
    weights : ndarray of float32, shape (k, N + 1)
        See `eigengs_dr.EigenGS`.
    errors : ndarray of float64, shape (k,)
        Squared distance between each component and its rendering, summed over pixels.
    """
    weights = np.empty((len(planes), equations.count + 1), np.float32)
    errors = np.empty(len(planes))
    for first in range(0, len(planes), BATCH):
        rows = slice(first, first + BATCH)
        correlations = equations.correlate(planes[rows])
        weights[rows] = equations.solve(correlations).T if known is None else known[rows]
        coefficients = weights[rows].T.astype(np.float64)
        errors[rows] = equations.error(coefficients, correlations, squared_norms(planes[rows]))
    return weights, errors
