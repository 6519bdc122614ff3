"""A set of 2D Gaussians: its parameters and their bounds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import index
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.arrays import types_in, types_of, upload, upload_rows
from ..backend.selection import select
from ..storage.npz import BadValue
from .file import CUTOFF, SetData, check, read, write

MIN_DEVIATION = 0.25
"""Smallest standard deviation along an axis of the factor, in pixels: what is narrower falls
between pixel centres, and its gradient with it."""


@dataclass
class Gaussians:
    """N two-dimensional Gaussians and a constant background: an image of any size.

    ``I(x) = background + sum_n color_n exp(-1/2 |F_n (x - mean_n)|^2)``, ``F = [[a, b], [0, c]]``:
    the covariance of a splat is ``(F^T F)^-1``, positive definite for any a, c > 0. x points right
    and y down, and pixel centres are at +0.5.

    A PyTree: functions such as `drjit.eval`, `drjit.enable_grad` or `drjit.grad` traverse it.

    Attributes
    ----------
    mean : Array2f, shape (2, N)
        Pixels of the native size.
    factor : Array3f, shape (3, N)
        a, b, c in 1 / pixels.
    color : ArrayXf, shape (C, N)
        C = 1, 3 or 4 (or any other number) channels; 1 is white.
    background : ArrayXf, shape (C, 1)
        Value of every pixel before the splats are added.
    width, height : int
        Native size in pixels.
    space : str
        What the channels mean, one of `eigengs_dr.image.color.SPACES`.
    cutoff : float
        Standard deviations after which a Gaussian ends, in (0, 12]. The error at a point is at most
        ``exp(-cutoff^2 / 2)`` times the sum of the absolute colours that are left out there.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> len(g), g.channels
    (1, 1)
    """

    mean: Any
    factor: Any
    color: Any
    background: Any
    width: int
    height: int
    space: str = "ycbcr"
    cutoff: float = CUTOFF

    @classmethod
    def from_arrays(
        cls,
        mean: ArrayLike,
        factor: ArrayLike,
        color: ArrayLike,
        background: ArrayLike | None = None,
        *,
        size: tuple[int, int],
        space: str = "ycbcr",
        backend: str | None = None,
        cutoff: float = CUTOFF,
    ) -> Gaussians:
        """Upload NumPy arrays.

        Parameters
        ----------
        mean : array_like, shape (N, 2)
            x, y in pixels.
        factor : array_like, shape (N, 3)
            a, b, c in 1 / pixels.
        color : array_like, shape (N, C)
        background : array_like, shape (C,), optional
            Zero by default.
        size : (int, int)
            Native width and height in pixels.
        space : str, optional
        backend : {"llvm", "cuda"}, optional
        cutoff : float, optional
            Standard deviations after which a Gaussian ends, in (0, 12].

        Raises
        ------
        ValueError
            If shapes do not fit each other, a or c is not positive, or a value is not finite.
        """
        arrays = {"mean": mean, "factor": factor, "color": color}
        if background is not None:
            arrays["background"] = background
        checked = {k: np.asarray(v, np.float32) for k, v in arrays.items()}
        checked.setdefault("background", np.zeros(checked["color"].shape[1:], np.float32))
        try:
            check(SetData(checked, size, space, cutoff))
        except BadValue as error:
            raise ValueError(f"Gaussians: {error}") from None
        types = types_in(select(backend))
        return cls(
            mean=types.Float2(*_columns(types, checked["mean"])),
            factor=types.Float3(*_columns(types, checked["factor"])),
            color=types.FloatX(_columns(types, checked["color"])),
            background=types.FloatX(_columns(types, checked["background"][None])),
            width=index(size[0]),
            height=index(size[1]),
            space=space,
            cutoff=float(cutoff),  # a NumPy scalar would promote everything to float64
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Download mean (N, 2), factor (N, 3), color (N, C) and background (C,) as NumPy arrays."""
        n = len(self)
        return {
            "mean": _rows(self.mean, n),
            "factor": _rows(self.factor, n),
            "color": _rows(self.color, n),
            "background": _rows(self.background, 1)[0],
        }

    def __len__(self) -> int:
        """Count the splats."""
        return max(dr.width(self.mean), dr.width(self.factor), dr.width(self.color))

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.color)

    def __getitem__(self, selection: Any) -> Gaussians:
        """Select splats by a slice, an integer array or a boolean mask; the background stays.

        Differentiable with respect to the parameters of the splats that are kept.

        Raises
        ------
        IndexError
            If the index is out of range or of another kind.
        ValueError
            If nothing is selected.
        """
        types = types_of(self.mean)
        kept = np.atleast_1d(np.arange(len(self), dtype=np.uint32)[selection])
        if not kept.size:
            raise ValueError("Gaussians: the selection is empty; a set has at least one splat")
        chosen = upload(types.UInt, kept)

        def pick(rows: Any) -> Any:
            whole = [_broadcast(row, len(self)) for row in rows]
            return type(rows)([dr.gather(types.Float, row, chosen) for row in whole])

        return replace(self, mean=pick(self.mean), factor=pick(self.factor), color=pick(self.color))

    def scaled(self, width: int, height: int) -> Gaussians:
        """Return the same picture with another native size, in pixels.

        Raises
        ------
        ValueError
            If a side is not positive.
        """
        if width < 1 or height < 1:
            raise ValueError(f"size {width}x{height}: both sides must be at least 1 pixel")
        if (width, height) == (self.width, self.height):
            return self
        sx, sy = width / self.width, height / self.height
        types = types_of(self.mean)
        a, b, c = self.factor
        return replace(
            self,
            mean=types.Float2(self.mean[0] * sx, self.mean[1] * sy),
            factor=types.Float3(a * (1 / sx), b * (1 / sy), c * (1 / sy)),
            width=width,
            height=height,
        )

    def bounded(self) -> Gaussians:
        """Return the set with every parameter inside its bounds, whatever a step did to it.

        Means stay in the image, a and c between 1 / (twice the longer side) and 1 /
        `MIN_DEVIATION`, b within +-1 / `MIN_DEVIATION`: the inverse covariance then has ``det = (a
        c)^2 > 0``. Values that are not finite are replaced: a mean by the middle, a factor by the
        bound, a colour by 0.
        """
        types = types_of(self.mean)
        low, high = 1 / (2 * max(self.width, self.height)), 1 / MIN_DEVIATION

        def inside(x: Any, low: float, high: float, otherwise: float) -> Any:
            return dr.select(dr.isfinite(x), dr.clip(x, low, high), otherwise)

        a, b, c = self.factor
        return replace(
            self,
            mean=types.Float2(
                inside(self.mean[0], 0.0, float(self.width), 0.5 * self.width),
                inside(self.mean[1], 0.0, float(self.height), 0.5 * self.height),
            ),
            factor=types.Float3(
                inside(a, low, high, high), inside(b, -high, high, 0.0), inside(c, low, high, high)
            ),
            color=dr.select(dr.isfinite(self.color), self.color, 0),
            background=dr.select(dr.isfinite(self.background), self.background, 0),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set as an ``.npz`` file in single precision, all or nothing.

        Raises
        ------
        ValueError
            If the suffix is ``.egs``, which `eigengs_dr.pack` writes.
        OSError
            If the file cannot be written; an existing one is then as before.
        """
        size = (self.width, self.height)
        write(path, SetData(self.to_arrays(), size, self.space, self.cutoff))

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        backend: str | None = None,
        sections: int | None = None,
    ) -> Gaussians:
        """Read a set that `save` or `eigengs_dr.pack` wrote.

        Parameters
        ----------
        path : path-like
        backend : {"llvm", "cuda"}, optional
        sections : int, optional
            Read so many sections of a packed file, from the first; what follows them may be
            missing. By default all.

        Raises
        ------
        ValueError
            If the file is not one of these, is damaged, newer than this package, or holds values
            that are not finite or do not fit together: one line that names file and key. If it
            has not so many sections.
        OSError
            If it cannot be opened.
        """
        arrays, size, space, cutoff = read(Path(path), sections)
        return cls.from_arrays(**arrays, size=size, space=space, backend=backend, cutoff=cutoff)


def concatenate(sets: Sequence[Gaussians]) -> Gaussians:
    """Join sets of splats; backgrounds add, so that rendering the result is the sum of renderings.

    Parameters
    ----------
    sets : sequence of Gaussians
        At least one; all of the same native size, space, cutoff, channels and backend.

    Raises
    ------
    ValueError
        If there is none, or they differ.
    """
    if not sets:
        raise ValueError("concatenate: no sets were given")
    first = sets[0]
    kinds = {(g.width, g.height, g.space, g.cutoff, g.channels, type(g.mean)) for g in sets}
    if len(kinds) > 1:
        raise ValueError(
            "concatenate: sets differ in size, space, cutoff, channels or backend; "
            "bring them to one size with scaled() first"
        )
    if len(sets) == 1:
        return first

    def join(name: str) -> Any:
        parts = [getattr(g, name) for g in sets]
        rows = [
            dr.concat([_broadcast(part[k], len(g)) for part, g in zip(parts, sets, strict=True)])
            for k in range(len(parts[0]))
        ]
        return type(parts[0])(*rows) if name != "color" else type(parts[0])(rows)

    return replace(
        first,
        mean=join("mean"),
        factor=join("factor"),
        color=join("color"),
        background=sum((g.background for g in sets[1:]), first.background),
    )


def _broadcast(row: Any, count: int) -> Any:
    """Give a row that may be a single number `count` entries."""
    return row + dr.zeros(type(row), count)


def _columns(types: Any, array: NDArray[Any]) -> list:
    return upload_rows(types.Float, array.T)


def _rows(rows: Any, count: int) -> NDArray[Any]:
    """Stack Dr.Jit rows, some of which may be literals, to a (count, rows) array."""
    columns = [np.broadcast_to(dr.detach(row).numpy(), count) for row in rows]
    return np.stack(columns, axis=1)
