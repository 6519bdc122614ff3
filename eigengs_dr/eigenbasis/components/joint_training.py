"""Joint training of shapes and weights of all components: EigenGS as its authors train it.

Tai et al., "EigenGS Representation: From Eigenspace to Gaussian Image Space", CVPR 2025: N splats
and a weight of every splat in every principal component descend together on the mean squared error
of the rendered components, each channel of which is scaled to [0, 1] for that.
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
"""Learning rate of everything at the start."""

HALVED = 20_000
"""Steps after which the rate is halved, again and again."""

ROUND = 20
"""Steps between two states: some 5 s for 900 components of 256x256 pixels and 5,000 splats."""

GROUP = 8
"""Components rendered at once: more outgrow the registers, fewer evaluate splats more often."""

Planes = NDArray[np.float32]


class JointState(NamedTuple):
    """All that training knows after a step; P components in all, N splats.

    Attributes
    ----------
    step : int
        Steps taken.
    loss : float
        Mean squared error over all components and pixels, scaled to [0, 1], as the last step found
        it, which is before it moved anything; NaN before the first.
    size : (int, int)
        Width and height in pixels.
    bounds : ndarray of float32, shape (C, 2)
        Smallest and largest value among the components of a channel; 0 where it has none.
    counts : tuple of C ints
        Components of each channel.
    rows : ndarray of float32, shape (5, 5 + P, N)
        Values; then m, v, n and the last gradient of `eigengs_dr.fitting.optimizers.adan.Adan`.
        Each has 5 rows for the mean and the factor in `CHOLESKY` coordinates, then a row of scaled
        weights for every component.
    """

    step: int
    loss: float
    size: tuple[int, int]
    bounds: NDArray[np.float32]
    counts: tuple[int, ...]
    rows: NDArray[np.float32]

    def gaussians(self, backend: str | None = None) -> Gaussians:
        """Return the N shapes; they have one channel of zeros, in the space "data"."""
        types = types_in(select(backend))
        return _placed(
            [upload(types.Float, row) for row in self.rows[0, :NUM_SHAPE_PARAMS]], self.size
        )

    def weights(self) -> tuple[Planes, ...]:
        """Return the weights of the components as they were given, with the scaling undone.

        With the scaled weights ``w_nj`` of splat n in component j and the bounds of its channel,
        ``psi'_nj = w_nj (max - min)`` and ``beta_j = min``.

        Returns
        -------
        tuple of C ndarrays of float32, shape (k_c, N + 1)
            Row j holds psi'_nj of all splats, then the background beta_j.
        """
        parts = np.split(self.rows[0, NUM_SHAPE_PARAMS:], np.cumsum(self.counts)[:-1])
        return tuple(
            np.pad(part * (high - low), [(0, 0), (0, 1)], constant_values=low)
            for part, (low, high) in zip(parts, self.bounds, strict=True)
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays, for a checkpoint."""
        return {name: np.asarray(value) for name, value in self._asdict().items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> JointState:
        """Rebuild a state from what `arrays` returned; going on from it gives equal bits."""
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
    """Fit splats and their weights to the principal components of all channels.

    With the scaled components ``Phi_j`` and the weight ``g_n(x)`` of splat n at a pixel::

        L = 1 / (P W H)  sum_j sum_x (sum_n w_nj g_n(x) - Phi_j(x))^2

    Settings are the authors': means uniform over the image and their atanh moved, Cholesky factors
    of covariances uniform in [0, 1] + (0.5, 0, 0.5), weights uniform in [0, 1], `Adan` with one
    rate for all.

    Parameters
    ----------
    components : tuple of C ndarrays of float32, shape (k_c, H, W)
        Some channels may have none.
    count : int
        Number of splats, N.
    seed : int
        Draws the start.
    steps : int
        Steps to take in all.
    backend : {"llvm", "cuda"}, optional
    state : JointState, optional
        Go on from here; the seed is then not used. The result has the bits of an unbroken run.

    Yields
    ------
    JointState
        After every `ROUND` steps and after the last; nothing if `state` is already there. No part
        of a state changes later. Between two of them, `KeyboardInterrupt` may become another
        error: see `eigengs_dr.backend.interrupt.defer_interrupts`.

    Raises
    ------
    ValueError
        If there is no component, sizes differ, or `state` is of other components or splats.

    Notes
    -----
    A step costs one rendering and one adjoint a component. Memory beside the components: 4 P W H
    bytes for scaled ones, 20 P N for weights and moments, and as much for every state.
    """
    if sum(map(len, components)) == 0:
        raise ValueError("components: there are none to fit")
    if len({planes.shape[1:] for planes in components}) > 1:
        raise ValueError("components: the channels differ in size")
    counts = tuple(map(len, components))
    height, width = components[0].shape[1:]
    if state is None:
        bounds = [(p.min(), p.max()) if len(p) else (0, 0) for p in components]
        rows = _start((width, height), count, sum(counts), seed, backend)
        state = JointState(0, math.nan, (width, height), np.array(bounds, "f4"), counts, rows)
    elif (state.size, state.counts, state.rows.shape[2]) != ((width, height), counts, count):
        raise ValueError("state: it is of other components or another number of splats")
    return _train(components, state, steps, backend)


def _start(
    size: tuple[int, int], count: int, components: int, seed: int, backend: str | None
) -> Planes:
    """Draw the rows of a state; all moments are 0."""
    generator = np.random.default_rng(seed)
    mean, factor = place_random(np.empty((size[1], size[0], 1)), count, generator)
    placed = Gaussians.from_arrays(
        mean, factor, np.zeros((count, 1)), size=size, space="data", backend=backend
    )
    rows = np.zeros((5, NUM_SHAPE_PARAMS + components, count), np.float32)
    variables = CHOLESKY.encode(placed)
    rows[0, :NUM_SHAPE_PARAMS] = [v.numpy() for v in (*variables["mean"], *variables["cholesky"])]
    rows[0, NUM_SHAPE_PARAMS:] = generator.uniform(0, 1, (components, count))
    return rows


def _train(
    components: tuple[Planes, ...], state: JointState, steps: int, backend: str | None
) -> Iterator[JointState]:
    """Take the steps that are missing."""
    types = types_in(select(backend))
    shape = _optimizer(types, state.rows[:, :NUM_SHAPE_PARAMS], state.step)
    groups = list(_groups(types, state))
    targets = list(_targets(types, components, state))
    number = sum(state.counts) * math.prod(state.size)
    # The derivative of the loss is the error times this; nothing where tiles overhang.
    share = np.full((*state.size[::-1], GROUP), 2 / number, np.float32)
    share = to_tiles(types, share, Grid(*state.size))
    with freeze_program(_move_group) as move:
        for step in range(state.step, steps):
            rate = dr.opaque(types.Float, RATE * 0.5 ** (step // HALVED))
            for optimizer in (shape, *groups):
                optimizer.set_learning_rate(rate)
            current = _placed(shape["rows"], state.size)
            values = kernel_shape(current)
            # Lists are built every step: less work than to enlarge them so that they last several.
            common = dr.detach(values), share, bin_gaussians(current)
            sums = [dr.opaque(types.Float, 0, dr.width(v)) for v in (*values, 0.0)]
            yields = (step + 1) % ROUND == 0 or step + 1 == steps
            for optimizer, target in zip(groups, targets, strict=True):
                sums = move(optimizer, target, common, sums, yields)
            # From the values, whose gradient all groups added to, back to the variables.
            dr.backward(sum(v * g for v, g in zip(values, sums, strict=False)))
            shape.step()
            if yields:
                loss = float(sums[-1][0]) * number / 4
                rows = np.concatenate([_rows(o) for o in (shape, *groups)], axis=1)
                rows = rows[:, : state.rows.shape[1]]  # without what fills the last group
                yield state._replace(step=step + 1, loss=loss, rows=rows)


def _move_group(optimizer: Adan, target: Any, common: tuple, sums: list, told: bool) -> list:
    """Move weights of a group; add its gradients of shapes, and squares if told, to `sums`."""
    shape, share, lists = common
    Float, radius = type(target), kernel_radius(CUTOFF)
    packed = pack_parameters([*shape, *optimizer["rows"]])
    rendered = forward(packed, [Float(0)] * GROUP, lists, radius)
    delta = (rendered - target) * share
    # By hand: backward mode would sum delta over all pixels too, for the backgrounds.
    gradient = adjoint(packed, delta, GROUP, lists, radius)
    squares = dr.squared_norm(delta) if told else Float(0)
    added = [s + g for s, g in zip(sums, [*gradient[:NUM_SHAPE_PARAMS], squares], strict=True)]
    dr.set_grad(optimizer["rows"], gradient[NUM_SHAPE_PARAMS:])
    dr.eval(added, dr.grad(optimizer["rows"]))
    optimizer.step()
    return added


def _optimizer(types: ArrayTypes, rows: Planes, step: int) -> Adan:
    """Adan after `step` steps, from values, moments and gradients of shape (5, R, N)."""
    values, *moments = (types.FloatX([upload(types.Float, row) for row in part]) for part in rows)
    optimizer = Adan(RATE, {"rows": values})
    time = dr.opaque(types.UInt, step)
    optimizer.state["rows"] = (*optimizer.state["rows"][:3], (time, *moments))
    return optimizer


def _rows(optimizer: Adan) -> Planes:
    """What `_optimizer` was made from, copied to NumPy."""
    values, _, _, (_, *moments) = optimizer.state["rows"]
    return np.stack([dr.detach(part).numpy() for part in (values, *moments)])


def _groups(types: ArrayTypes, state: JointState) -> Iterator[Adan]:
    """Make the optimiser of each group of weights."""
    for first in range(NUM_SHAPE_PARAMS, state.rows.shape[1], GROUP):
        rows = state.rows[:, first : first + GROUP]
        # What fills the last group stays: weights of 0 of a component of 0 have no gradient.
        rows = np.pad(rows, [(0, 0), (0, GROUP - rows.shape[1]), (0, 0)])
        yield _optimizer(types, rows, state.step)


def _targets(types: ArrayTypes, components: tuple[Planes, ...], state: JointState) -> Iterator[Any]:
    """Scaled components of each group, in tile layout."""
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
    """Splats with the means and factors that 5 rows of `CHOLESKY` coordinates stand for."""
    types = types_of(rows[0])
    x, y, *factor = rows
    color, background = (dr.zeros(types.FloatX, (1, n)) for n in (dr.width(x), 1))
    blank = Gaussians(types.Float2(0), types.Float3(1), color, background, *size, "data")
    return CHOLESKY.decode(blank, {"mean": types.Float2(x, y), "cholesky": types.Float3(*factor)})
