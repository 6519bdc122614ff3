"""State of a joint training: rows of variables, as Gaussians and weights or as plain arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.arrays import types_in, types_of, upload
from ...backend.selection import select
from ...fitting.parameterization import CHOLESKY
from ...gaussian.gaussians import Gaussians
from ...raster.parameters import NUM_SHAPE_PARAMS

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
