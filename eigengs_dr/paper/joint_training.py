"""Joint training of the shapes and the weights of all components, as in EigenGS.

Source: Tai et al., "EigenGS Representation: From Eigenspace to Gaussian Image Space", CVPR 2025.
Gradient descent optimises N Gaussians and their weights in all principal components together. The
loss is the mean squared error of the rendered components, with each channel scaled to [0, 1].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, types_in, types_of, upload
from ..backend.recording import freeze_program
from ..backend.selection import select
from ..backend.types import Float, Rows, Singles
from ..fitting.place import random_shapes
from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import Gaussians
from ..image.space import DATA
from ..raster.adjoint import adjoint
from ..raster.kernels import residual
from ..raster.lists import TileLists
from ..raster.parameters import NUM_SHAPE_PARAMS, kernel_radius, kernel_shape, pack_parameters
from ..raster.render import bin_gaussians, to_tiles
from .adan import Adan
from .gaussianimage import Cholesky

State = dict[str, NDArray]
"""The state of a training as plain arrays, for a checkpoint."""

CHOLESKY = Cholesky()


class Band(NamedTuple):
    """Components, and the number of Gaussians that represent them.

    Attributes
    ----------
    number : int
    components : tuple of C ndarrays of float32, shape (k_c, H, W)
        A channel may have none.
    """

    number: int
    components: tuple[Singles, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.components[0].shape[1:]
        return width, height


def joint_shapes(state: State, band: Band, backend: str | None = None) -> Gaussians:
    """Return the Gaussians of a state, with one channel of zeros, in the space "data"."""
    types = types_in(select(backend))
    rows = [upload(types.Float, row) for row in state["rows"][0, :NUM_SHAPE_PARAMS]]
    return decode_shapes(rows, band.size)


def joint_weights(state: State, band: Band) -> list[Singles]:
    """Return the weights of the components of a state, with the scaling undone.

    The scaled weight ``w_nj`` of Gaussian n in component j and the bounds of the channel give
    ``psi'_nj = w_nj (max - min)`` and ``beta_j = min``.

    Returns
    -------
    list of C ndarrays of float32, shape (k_c, N + 1)
        Row j holds psi'_nj of all Gaussians, then the background beta_j.
    """
    ends = np.cumsum([len(planes) for planes in band.components])
    parts = np.split(state["rows"][0, NUM_SHAPE_PARAMS:], ends[:-1])
    return [
        np.pad(part * (high - low), [(0, 0), (0, 1)], constant_values=low)
        for part, (low, high) in zip(parts, _bounds(band), strict=True)
    ]


def _bounds(band: Band) -> list[tuple[np.float32, np.float32]]:
    """Return the smallest and largest value of all components of each channel."""
    none = np.zeros(1, np.float32)
    return [(p.min(), p.max()) for p in (c if len(c) else none for c in band.components)]


def decode_shapes(rows: Sequence[Float], size: tuple[int, int]) -> Gaussians:
    """Decode rows of variables to Gaussians with one channel of zeros; differentiable.

    Parameters
    ----------
    rows : sequence of 5 Float, shape (N,)
        Mean and factor in the coordinates `Cholesky`.
    size : (int, int)
        Width and height in pixels.
    """
    types = types_of(rows[0])
    x, y, *factor = rows
    color, background = (dr.zeros(types.FloatX, (1, n)) for n in (dr.width(x), 1))
    blank = Gaussians(types.Float2(0), types.Float3(1), color, background, *size, DATA)
    return CHOLESKY.decode(blank, {"mean": types.Float2(x, y), "cholesky": types.Float3(*factor)})


RATE = 1e-3
"""Initial learning rate of all variables."""

HALVING_STEPS = 20_000
"""Number of steps after which the learning rate is halved."""

STATE_STEPS = 20
"""Number of steps between two states, about 5 s for 900 components of 256x256 pixels and 5,000
Gaussians."""

GROUP_COMPONENTS = 8
"""Number of components per rendering. More would not fit into registers; with fewer, Gaussians are
evaluated more often."""

OPTIMIZER = Adan()

RADIUS = kernel_radius(CUTOFF)
"""Radius of all kernels."""


def train_jointly(
    band: Band,
    seed: int,
    steps: int,
    backend: str | None = None,
    state: State | None = None,
) -> Iterator[State]:
    """Fit Gaussians and their weights to the principal components of all channels.

    With the scaled components ``Phi_j`` and the value ``g_n(x)`` of Gaussian n at a pixel, the loss
    is ::

        L = 1 / (P W H)  sum_j sum_x (sum_n w_nj g_n(x) - Phi_j(x))^2

    The settings are those of the authors: uniform means with their atanh as variables, Cholesky
    factors of covariances uniform in [0, 1] + (0.5, 0, 0.5), weights uniform in [0, 1], and `Adan`
    with one learning rate.

    Parameters
    ----------
    band : Band
    seed : int
        Seed of the random start.
    steps : int
        Total number of steps.
    backend : {"llvm", "cuda"}, optional
    state : dict of str to ndarray, optional
        Resume from this state, without the seed. The result is bit-identical to that of an
        uninterrupted run.

    Yields
    ------
    dict of str to ndarray
        The state after every `STATE_STEPS` steps and after the last step; nothing if `state` is
        complete. Between two states, `KeyboardInterrupt` may become another error, see
        `eigengs_dr.backend.interrupts.defer_interrupts`. "step" is the number of finished steps.
        "rows" has shape (5, 5 + P, N) for P components: the variables, then m, v, n and the last
        gradient of `eigengs_dr.paper.adan.Adan`. The first 5 rows of each are the mean and the
        factor in `Cholesky` coordinates, the others the scaled weights of one component each.

    Raises
    ------
    ValueError
        If there is no component.

    Notes
    -----
    A step costs one rendering and one adjoint per component. In addition to the components, it
    needs 4 P W H bytes for scaled components, 20 P N for weights and moments, and 20 P N per state.
    """
    if not any(map(len, band.components)):
        raise ValueError("the images give no components to train on; use preset 'default'")
    return _train(band, state or _start(band, seed, backend), steps, backend)


def _start(band: Band, seed: int, backend: str | None) -> State:
    """Draw a random initial state, with moments of 0."""
    generator = np.random.default_rng(seed)
    count = band.number
    mean, factor = random_shapes(band.size, count, generator)
    gaussians = Gaussians.from_arrays(
        mean, factor, np.zeros((count, 1)), size=band.size, space="data", backend=backend
    )
    components = sum(map(len, band.components))
    rows = np.zeros((5, NUM_SHAPE_PARAMS + components, count), np.float32)
    variables = CHOLESKY.encode(gaussians)
    rows[0, :NUM_SHAPE_PARAMS] = [v.numpy() for v in (*variables["mean"], *variables["cholesky"])]
    rows[0, NUM_SHAPE_PARAMS:] = generator.uniform(0, 1, (components, count))
    return {"step": np.array(0), "rows": rows}


def _train(band: Band, state: State, steps: int, backend: str | None) -> Iterator[State]:
    """Take the remaining steps."""
    types, size, start = types_in(select(backend)), band.size, state["rows"]
    shape = _upload(types, start[:, :NUM_SHAPE_PARAMS])
    groups = [_upload(types, rows) for rows in _split(start[:, NUM_SHAPE_PARAMS:], axis=1)]
    scaled = [
        (planes - low) / (high - low) if high > low else planes * 0
        for planes, (low, high) in zip(band.components, _bounds(band), strict=True)
    ]
    targets = [
        to_tiles(types, np.moveaxis(planes, 0, 2))
        for planes in _split(np.concatenate(scaled), axis=0)
    ]
    scale = dr.opaque(types.Float, 2 / sum(planes.size for planes in band.components))
    with freeze_program(_move_group) as move, freeze_program(_move_shape) as move_shape:
        for step in range(int(state["step"]), steps):
            rate = dr.opaque(types.Float, RATE * 0.5 ** (step // HALVING_STEPS))
            time = dr.opaque(types.Float, step + 1)
            current = decode_shapes(shape[0], size)
            values = kernel_shape(current)
            dr.eval(values)
            # Building lists in every step is cheaper than larger lists that last several steps.
            lists = bin_gaussians(current)
            slopes = [dr.opaque(types.Float, 0, dr.width(v)) for v in values]
            for k, target in enumerate(targets):
                groups[k], slopes = move(
                    groups[k], target, values, lists, scale, slopes, rate, time
                )
            shape = move_shape(shape, slopes, size, rate, time)
            if (step + 1) % STATE_STEPS == 0 or step + 1 == steps:
                rows = np.concatenate([_download(o) for o in (shape, *groups)], axis=1)
                rows = rows[:, : start.shape[1]]  # without the padding of the last group
                yield {"step": np.array(step + 1), "rows": rows}


def _move_group(
    group: list,
    target: Float,
    shape: list,
    lists: TileLists,
    scale: Float,
    slopes: list,
    rate: Float,
    time: Float,
) -> tuple[list, list]:
    """Take a step with the weights of a group, and add its gradient of the shapes to `slopes`."""
    moments: Sequence[Rows]
    rows, *moments = group
    packed = pack_parameters([*shape, *rows])
    delta, _ = residual(packed, [type(target)(0)] * GROUP_COMPONENTS, lists, RADIUS, target)
    gradient = [g * scale for g in adjoint(packed, delta, GROUP_COMPONENTS, lists, RADIUS)]
    added = [s + g for s, g in zip(slopes, gradient[:NUM_SHAPE_PARAMS], strict=True)]
    weight_gradient = type(rows)(gradient[NUM_SHAPE_PARAMS:])
    rows, moments = OPTIMIZER.step(rows, weight_gradient, tuple(moments), rate, time)
    return [rows, *moments], added


def _move_shape(
    shape: list, gradient: list, size: tuple[int, int], rate: Float, time: Float
) -> list:
    """Take a step with all means and factors, from the gradient of the kernels' parameters."""
    moments: Sequence[Rows]
    rows, *moments = shape
    with dr.resume_grad():
        traced = type(rows)(rows)
        dr.enable_grad(traced)
        values = kernel_shape(decode_shapes(traced, size))
        dr.backward(sum(v * g for v, g in zip(values, gradient, strict=True)))
        slopes = dr.grad(traced)
    rows, moments = OPTIMIZER.step(rows, slopes, tuple(moments), rate, time)
    return [rows, *moments]


def _upload(types: ArrayTypes, rows: Singles) -> list:
    """Copy values, moments and gradients of `Adan`, shape (5, R, N), to the device."""
    return [types.FloatX([upload(types.Float, row) for row in part]) for part in rows]


def _download(parts: list) -> Singles:
    """Copy the state of an optimiser to NumPy; the inverse of `_upload`."""
    return np.stack([dr.detach(part).numpy() for part in parts])


def _split(array: Singles, axis: int) -> Iterator[Singles]:
    """Yield groups of `GROUP_COMPONENTS` components, the last one padded with zeros.

    The padding remains 0, because a zero component with zero weights has no gradient.
    """
    for part in np.split(array, range(GROUP_COMPONENTS, array.shape[axis], GROUP_COMPONENTS), axis):
        missing = np.zeros((array.ndim, 2), int)
        missing[axis, 1] = GROUP_COMPONENTS - part.shape[axis]
        yield np.pad(part, missing)
