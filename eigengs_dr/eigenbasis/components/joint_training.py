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
from ...fitting.optimizers.adan import Adan
from ...fitting.optimizers.parameterization import CHOLESKY
from ...fitting.placement.random import place_random
from ...gaussian.file import CUTOFF
from ...gaussian.gaussians import Gaussians
from ...raster.kernels import adjoint, forward
from ...raster.layout import pack_parameters
from ...raster.parameters import NUM_SHAPE_PARAMS, kernel_radius, kernel_shape
from ...raster.render import bin_gaussians, to_tiles
from ...raster.tiles import Grid

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
        Variables; then m, v, n and the last gradient of `eigengs_dr.fitting.optimizers.adan.Adan`.
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
        return _placed(
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
        another error, see `eigengs_dr.backend.interrupt.defer_interrupts`.

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
    shape = _optimizer(types, state.rows[:, :NUM_SHAPE_PARAMS], state.step)
    groups = list(_groups(types, state))
    targets = list(_targets(types, components, state))
    number = sum(state.counts) * math.prod(state.size)
    # The derivative of the loss is the error times this share; it is 0 outside the image.
    share = np.full((*state.size[::-1], GROUP), 2 / number, np.float32)
    share = to_tiles(types, share, Grid(*state.size))
    with freeze_program(_move_group) as move:
        for step in range(state.step, steps):
            rate = dr.opaque(types.Float, RATE * 0.5 ** (step // HALVED))
            for optimizer in (shape, *groups):
                optimizer.set_learning_rate(rate)
            current = _placed(shape["rows"], state.size)
            values = kernel_shape(current)
            # New lists in every step are cheaper than larger lists that last several steps.
            common = dr.detach(values), share, bin_gaussians(current)
            sums = [dr.opaque(types.Float, 0, dr.width(v)) for v in (*values, 0.0)]
            yields = (step + 1) % ROUND == 0 or step + 1 == steps
            for optimizer, target in zip(groups, targets, strict=True):
                sums = move(optimizer, target, common, sums, yields)
            # The sums are the gradient of the values; this continues it to the variables.
            dr.backward(sum(v * g for v, g in zip(values, sums, strict=False)))
            shape.step()
            if yields:
                loss = float(sums[-1][0]) * number / 4
                rows = np.concatenate([_rows(o) for o in (shape, *groups)], axis=1)
                rows = rows[:, : state.rows.shape[1]]  # without the padding of the last group
                yield state._replace(step=step + 1, loss=loss, rows=rows)


def _move_group(optimizer: Adan, target: Any, common: tuple, sums: list, told: bool) -> list:
    """Move the weights of a group; add gradients of shapes, and errors if `told`, to `sums`."""
    shape, share, lists = common
    Float, radius = type(target), kernel_radius(CUTOFF)
    packed = pack_parameters([*shape, *optimizer["rows"]])
    rendered = forward(packed, [Float(0)] * GROUP, lists, radius)
    delta = (rendered - target) * share
    # By hand, because backward mode would also sum delta over all pixels, for the backgrounds.
    gradient = adjoint(packed, delta, GROUP, lists, radius)
    squares = dr.squared_norm(delta) if told else Float(0)
    added = [s + g for s, g in zip(sums, [*gradient[:NUM_SHAPE_PARAMS], squares], strict=True)]
    dr.set_grad(optimizer["rows"], gradient[NUM_SHAPE_PARAMS:])
    dr.eval(added, dr.grad(optimizer["rows"]))
    optimizer.step()
    return added


def _optimizer(types: ArrayTypes, rows: Planes, step: int) -> Adan:
    """Restore Adan after `step` steps from values, moments and gradients, shape (5, R, N)."""
    values, *moments = (types.FloatX([upload(types.Float, row) for row in part]) for part in rows)
    optimizer = Adan(RATE, {"rows": values})
    time = dr.opaque(types.UInt, step)
    optimizer.state["rows"] = (*optimizer.state["rows"][:3], (time, *moments))
    return optimizer


def _rows(optimizer: Adan) -> Planes:
    """Copy the state of an optimiser to NumPy, as `_optimizer` takes it."""
    values, _, _, (_, *moments) = optimizer.state["rows"]
    return np.stack([dr.detach(part).numpy() for part in (values, *moments)])


def _groups(types: ArrayTypes, state: JointState) -> Iterator[Adan]:
    """Make the optimiser of each group of weights."""
    for first in range(NUM_SHAPE_PARAMS, state.rows.shape[1], GROUP):
        rows = state.rows[:, first : first + GROUP]
        # The padding of the last group stays 0: a zero component with zero weights has no gradient.
        rows = np.pad(rows, [(0, 0), (0, GROUP - rows.shape[1]), (0, 0)])
        yield _optimizer(types, rows, state.step)


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


def _placed(rows: Any, size: tuple[int, int]) -> Gaussians:
    """Decode 5 rows of `CHOLESKY` coordinates to Gaussians without colour."""
    types = types_of(rows[0])
    x, y, *factor = rows
    color, background = (dr.zeros(types.FloatX, (1, n)) for n in (dr.width(x), 1))
    blank = Gaussians(types.Float2(0), types.Float3(1), color, background, *size, "data")
    return CHOLESKY.decode(blank, {"mean": types.Float2(x, y), "cholesky": types.Float3(*factor)})
