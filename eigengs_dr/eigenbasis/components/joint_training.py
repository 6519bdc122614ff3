"""Joint training of the shapes and the weights of all components, as the authors of EigenGS do.

Source: Tai et al., "EigenGS Representation: From Eigenspace to Gaussian Image Space", CVPR 2025.
Gradient descent moves N Gaussians and their weights in all principal components at once. The loss
is the mean squared error of the rendered components, with each channel scaled to [0, 1].
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import ArrayTypes, types_in, types_of, upload
from ...backend.recording import freeze_program
from ...backend.selection import select
from ...fitting.parameterization import CHOLESKY, Adan
from ...fitting.start import place_random
from ...gaussian.file import CUTOFF
from ...gaussian.gaussians import Gaussians
from ...raster.adjoint import adjoint
from ...raster.binning.lists import TileLists
from ...raster.binning.tiles import Grid
from ...raster.kernels import residual, sum_lanes
from ...raster.parameters import NUM_SHAPE_PARAMS, kernel_radius, kernel_shape, pack_parameters
from ...raster.render import bin_gaussians, to_tiles

Planes = NDArray[np.float32]


class JointState(NamedTuple):
    """State of a joint training of N Gaussians and P components after some steps.

    Attributes
    ----------
    step : int
        Number of finished steps.
    loss : float
        Mean squared error over all pixels of the scaled components, before the update of the last
        step; NaN before the first step.
    size : (int, int)
        Width and height in pixels.
    bounds : ndarray of float32, shape (C, 2)
        Smallest and largest value of all components of a channel; 0 for a channel without any.
    counts : tuple of C ints
        Number of components of each channel.
    rows : ndarray of float32, shape (5, 5 + P, N)
        Variables; then m, v, n and the last gradient of `eigengs_dr.fitting.parameterization.Adan`.
        The first 5 rows of each are the mean and the factor in `CHOLESKY` coordinates; each other
        row holds the scaled weights of one component.
    """

    step: int
    loss: float
    size: tuple[int, int]
    bounds: NDArray[np.float32]
    counts: tuple[int, ...]
    rows: NDArray[np.float32]

    def gaussians(self, backend: str | None = None) -> Gaussians:
        """Return N Gaussians with one channel of zeros, in the space "data"."""
        types = types_in(select(backend))
        return decode_shapes(
            [upload(types.Float, row) for row in self.rows[0, :NUM_SHAPE_PARAMS]], self.size
        )

    def weights(self) -> tuple[Planes, ...]:
        """Return the weights of the components without the scaling.

        The scaled weight ``w_nj`` of Gaussian n in component j and the bounds of the channel give
        ``psi'_nj = w_nj (max - min)`` and ``beta_j = min``.

        Returns
        -------
        tuple of C ndarrays of float32, shape (k_c, N + 1)
            Row j holds psi'_nj of all Gaussians, then the background beta_j.
        """
        parts = np.split(self.rows[0, NUM_SHAPE_PARAMS:], np.cumsum(self.counts)[:-1])
        return tuple(
            np.pad(part * (high - low), [(0, 0), (0, 1)], constant_values=low)
            for part, (low, high) in zip(parts, self.bounds, strict=True)
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the state as plain arrays, for a checkpoint."""
        return {name: np.asarray(value) for name, value in self._asdict().items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> JointState:
        """Rebuild a state from the result of `arrays`; the next steps then give equal bits."""
        width, height = arrays["size"].tolist()
        counts = tuple(arrays["counts"].tolist())
        step, loss = int(arrays["step"]), float(arrays["loss"])
        return cls(step, loss, (width, height), arrays["bounds"], counts, arrays["rows"])


def decode_shapes(rows: Any, size: tuple[int, int]) -> Gaussians:
    """Decode rows of variables to Gaussians with one channel of zeros; differentiable.

    Parameters
    ----------
    rows : sequence of 5 Float, shape (N,)
        Mean and factor in the coordinates `CHOLESKY`.
    size : (int, int)
        Width and height in pixels.
    """
    types = types_of(rows[0])
    x, y, *factor = rows
    color, background = (dr.zeros(types.FloatX, (1, n)) for n in (dr.width(x), 1))
    blank = Gaussians(types.Float2(0), types.Float3(1), color, background, *size, "data")
    return CHOLESKY.decode(blank, {"mean": types.Float2(x, y), "cholesky": types.Float3(*factor)})


RATE = 1e-3
"""Initial learning rate of all variables."""

HALVED = 20_000
"""Steps between two halvings of the learning rate."""

ROUND = 20
"""Steps between two states; they take some 5 s for 900 components of 256x256 pixels and 5,000
Gaussians."""

GROUP = 8
"""Number of components in one rendering. More do not fit into the registers; fewer evaluate the
Gaussians more often."""

OPTIMIZER = Adan()


def train_jointly(
    components: tuple[Planes, ...],
    count: int,
    seed: int,
    steps: int,
    *,
    backend: str | None = None,
    state: JointState | None = None,
) -> Iterator[JointState]:
    """Fit Gaussians and their weights to the principal components of all channels.

    With the scaled components ``Phi_j`` and the value ``g_n(x)`` of Gaussian n at a pixel, the loss
    is ::

        L = 1 / (P W H)  sum_j sum_x (sum_n w_nj g_n(x) - Phi_j(x))^2

    The settings are those of the authors: uniform means with their atanh as variables, Cholesky
    factors of covariances uniform in [0, 1] + (0.5, 0, 0.5), weights uniform in [0, 1], and `Adan`
    with one learning rate.

    Parameters
    ----------
    components : tuple of C ndarrays of float32, shape (k_c, H, W)
        Components; a channel may have none.
    count : int
        Number of Gaussians, N.
    seed : int
        Seed of the random start.
    steps : int
        Total number of steps.
    backend : {"llvm", "cuda"}, optional
    state : JointState, optional
        Resume from this state, without the seed. The result has the bits of an unbroken run.

    Yields
    ------
    JointState
        The state after every `ROUND` steps and after the last step; nothing if `state` has all
        steps. A state does not change later. Between two states, `KeyboardInterrupt` may become
        another error, see `eigengs_dr.backend.feedback.defer_interrupts`.

    Raises
    ------
    ValueError
        If there is no component, sizes differ, or `state` has other components or Gaussians.

    Notes
    -----
    A step costs one rendering and one adjoint for each component. Beside the components, it needs
    4 P W H bytes for scaled components, 20 P N for weights and moments, and 20 P N for each state.
    """
    if sum(map(len, components)) == 0:
        raise ValueError("components: there are none to fit; give at least one")
    if len({planes.shape[1:] for planes in components}) > 1:
        raise ValueError("components: the channels differ in size; give one size to all")
    counts = tuple(map(len, components))
    height, width = components[0].shape[1:]
    if state is None:
        bounds = [(p.min(), p.max()) if len(p) else (0, 0) for p in components]
        rows = _start((width, height), count, sum(counts), seed, backend)
        state = JointState(0, math.nan, (width, height), np.array(bounds, "f4"), counts, rows)
    elif (state.size, state.counts, state.rows.shape[2]) != ((width, height), counts, count):
        raise ValueError("state: it has other components or another number of Gaussians; drop it")
    return _train(components, state, steps, backend)


def _start(
    size: tuple[int, int], count: int, components: int, seed: int, backend: str | None
) -> Planes:
    """Draw the rows of an initial state, with moments of 0."""
    generator = np.random.default_rng(seed)
    mean, factor = place_random(np.empty((size[1], size[0], 1)), count, generator)
    gaussians = Gaussians.from_arrays(
        mean, factor, np.zeros((count, 1)), size=size, space="data", backend=backend
    )
    rows = np.zeros((5, NUM_SHAPE_PARAMS + components, count), np.float32)
    variables = CHOLESKY.encode(gaussians)
    rows[0, :NUM_SHAPE_PARAMS] = [v.numpy() for v in (*variables["mean"], *variables["cholesky"])]
    rows[0, NUM_SHAPE_PARAMS:] = generator.uniform(0, 1, (components, count))
    return rows


def _train(
    components: tuple[Planes, ...], state: JointState, steps: int, backend: str | None
) -> Iterator[JointState]:
    """Take the remaining steps."""
    types = types_in(select(backend))
    shape = _upload(types, state.rows[:, :NUM_SHAPE_PARAMS])
    groups = list(_groups(types, state))
    targets = list(_targets(types, components, state))
    number = sum(state.counts) * math.prod(state.size)
    radius = kernel_radius(CUTOFF)
    with freeze_program(_move_group) as move, freeze_program(_move_shape) as move_shape:
        for step in range(state.step, steps):
            rate = dr.opaque(types.Float, RATE * 0.5 ** (step // HALVED))
            time = dr.opaque(types.Float, step + 1)
            current = decode_shapes(shape[0], state.size)
            values = kernel_shape(current)
            dr.eval(values)
            # New lists in every step are cheaper than larger lists that last several steps.
            lists = bin_gaussians(current)
            sums = [dr.opaque(types.Float, 0, dr.width(v)) for v in (*values, 0.0)]
            yields = (step + 1) % ROUND == 0 or step + 1 == steps
            scale = dr.opaque(types.Float, 2 / number)
            for k, target in enumerate(targets):
                groups[k], sums = move(
                    groups[k], target, values, lists, radius, scale, sums, yields, rate, time
                )
            shape = move_shape(shape, sums[:NUM_SHAPE_PARAMS], state.size, rate, time)
            if yields:
                loss = float(sums[-1][0]) / number
                rows = np.concatenate([_download(o) for o in (shape, *groups)], axis=1)
                rows = rows[:, : state.rows.shape[1]]  # without the padding of the last group
                yield state._replace(step=step + 1, loss=loss, rows=rows)


def _move_group(
    group: list,
    target: Any,
    shape: list,
    lists: TileLists,
    radius: float,
    scale: Any,
    sums: list,
    with_error: bool,
    rate: Any,
    time: Any,
) -> tuple[list, list]:
    """Move the weights of a group; add gradients of shapes (and errors, if wanted) to `sums`."""
    rows, *moments = group
    packed = pack_parameters([*shape, *rows])
    delta, squares = residual(packed, [type(target)(0)] * GROUP, lists, radius, target)
    gradient = [g * scale for g in adjoint(packed, delta, GROUP, lists, radius)]
    error = type(target)(0)
    if with_error:
        error = sum(sum_lanes(squares, lists))
    added = [s + g for s, g in zip(sums, [*gradient[:NUM_SHAPE_PARAMS], error], strict=True)]
    slopes = type(rows)(gradient[NUM_SHAPE_PARAMS:])
    rows, moments = OPTIMIZER.step(rows, slopes, tuple(moments), rate, time)
    return [rows, *moments], added


def _move_shape(shape: list, gradient: list, size: tuple[int, int], rate: Any, time: Any) -> list:
    """Move the means and factors of all Gaussians along the gradient of the kernels' parameters."""
    rows, *moments = shape
    with dr.resume_grad():
        traced = type(rows)(rows)
        dr.enable_grad(traced)
        values = kernel_shape(decode_shapes(traced, size))
        dr.backward(sum(v * g for v, g in zip(values, gradient, strict=True)))
        slopes = dr.grad(traced)
    rows, moments = OPTIMIZER.step(rows, slopes, tuple(moments), rate, time)
    return [rows, *moments]


def _upload(types: ArrayTypes, rows: Planes) -> list:
    """Copy values, moments and gradients of `Adan`, shape (5, R, N), to the device."""
    return [types.FloatX([upload(types.Float, row) for row in part]) for part in rows]


def _download(parts: list) -> Planes:
    """Copy the state of an optimiser to NumPy, as `_upload` takes it."""
    return np.stack([dr.detach(part).numpy() for part in parts])


def _groups(types: ArrayTypes, state: JointState) -> Iterator[list]:
    """Upload the state of each group of weights."""
    for first in range(NUM_SHAPE_PARAMS, state.rows.shape[1], GROUP):
        rows = state.rows[:, first : first + GROUP]
        # The padding of the last group stays 0: a zero component with zero weights has no gradient.
        yield _upload(types, np.pad(rows, [(0, 0), (0, GROUP - rows.shape[1]), (0, 0)]))


def _targets(types: ArrayTypes, components: tuple[Planes, ...], state: JointState) -> Iterator[Any]:
    """Yield the scaled components of each group, in tile layout."""
    scaled = (
        (plane - low) / (high - low) if high > low else plane * 0
        for planes, (low, high) in zip(components, state.bounds, strict=True)
        for plane in planes
    )
    while group := list(islice(scaled, GROUP)):
        planes = np.zeros((*group[0].shape, GROUP), np.float32)
        planes[..., : len(group)] = np.stack(group, axis=-1)
        yield to_tiles(types, planes, Grid(*state.size))
