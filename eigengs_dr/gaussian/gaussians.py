"""Sets of 2D Gaussians: parameters, bounds, and operations on whole sets."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from operator import index
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..backend.arrays import types_in, types_of, upload, upload_rows
from ..backend.display import to_html
from ..backend.recording import exclusive
from ..backend.selection import select
from ..storage.npz import BadValue
from .bounds import clip_parameters
from .file import CUTOFF, SetData, check, read, write


@dataclass(repr=False, eq=False)
class Gaussians:
    """N two-dimensional Gaussians and a constant background: an image of any size.

    ``I(x) = background + sum_n color_n exp(-1/2 |F_n (x - mean_n)|^2)`` with
    ``F = [[a, b], [0, c]]``. The covariance ``(F^T F)^-1`` is positive definite for any a, c > 0. x
    points right, y points down, and pixel centres are at +0.5. The class is a PyTree: `drjit.eval`,
    `drjit.enable_grad`, `drjit.grad` and similar functions traverse it.

    Attributes
    ----------
    mean : Array2f, shape (2, N)
        Pixels of the native size.
    factor : Array3f, shape (3, N)
        a, b, c in 1 / pixels.
    color : ArrayXf, shape (C, N)
        C channels; 1 is white.
    background : ArrayXf, shape (C, 1)
        Value of every pixel before the Gaussians are added.
    width, height : int
        Native size in pixels.
    space : str
        Colour space of the channels, one of `eigengs_dr.image.color.SPACES`.
    cutoff : float
        Standard deviations at which a Gaussian ends, in (0, 12]. The error at a point is at most
        ``exp(-cutoff^2 / 2)`` times the sum of the absolute colours of the Gaussians that end
        before it.

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
    @exclusive()
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
        dtype: DTypeLike = np.float32,
    ) -> Gaussians:
        """Create a set from NumPy arrays.

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
        space, cutoff : optional
            See `Gaussians`.
        backend : {"llvm", "cuda"}, optional
            By default "cuda" if the machine has a CUDA GPU, else "llvm".
        dtype : {numpy.float32, numpy.float64}, optional
            Precision of the arrays, of renderings and of derivatives.

        Raises
        ------
        ValueError
            If shapes do not fit each other, or a value is not finite or out of range.
        """
        arrays = {"mean": mean, "factor": factor, "color": color}
        if background is not None:
            arrays["background"] = background
        kind = np.dtype(dtype)
        if kind not in (np.float32, np.float64):
            raise ValueError(f"Gaussians: dtype is {kind}; give numpy.float32 or numpy.float64")
        checked = {k: np.asarray(v, kind) for k, v in arrays.items()}
        checked.setdefault("background", np.zeros(checked["color"].shape[1:], kind))
        try:
            size = tuple(index(side) for side in size)  # type: ignore[assignment]
        except TypeError:
            raise ValueError(
                f"Gaussians: size is {size}; give whole pixels, as (640, 480)"
            ) from None
        try:
            check(SetData(checked, size, space, cutoff))
        except BadValue as error:
            raise ValueError(f"Gaussians: {error}") from None
        types = types_in(select(backend), 8 * kind.itemsize)
        return cls(
            mean=types.Float2(*_columns(types, checked["mean"])),
            factor=types.Float3(*_columns(types, checked["factor"])),
            color=types.FloatX(_columns(types, checked["color"])),
            background=types.FloatX(_columns(types, checked["background"][None])),
            width=size[0],
            height=size[1],
            space=space,
            cutoff=float(cutoff),  # a NumPy scalar would promote Dr.Jit arrays to float64
        )

    @classmethod
    def from_data(
        cls, data: SetData, backend: str | None = None, dtype: DTypeLike = np.float32
    ) -> Gaussians:
        """Create a set from the content of a file; for the arguments see `from_arrays`."""
        arrays: dict[str, Any] = data.arrays
        return cls.from_arrays(
            **arrays,
            size=data.size,
            space=data.space,
            backend=backend,
            cutoff=data.cutoff,
            dtype=dtype,
        )

    def data(self) -> SetData:
        """Return the content for a file."""
        return SetData(self.to_arrays(), (self.width, self.height), self.space, self.cutoff)

    @exclusive()
    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return mean (N, 2), factor (N, 3), color (N, C) and background (C,) as NumPy arrays."""
        n = len(self)
        return {
            "mean": _rows(self.mean, n),
            "factor": _rows(self.factor, n),
            "color": _rows(self.color, n),
            "background": _rows(self.background, 1)[0],
        }

    def __repr__(self) -> str:
        size = f"{len(self)}, {self.width}x{self.height} pixels, {self.channels} channels"
        return f"Gaussians({size}, {self.space!r}, cutoff={self.cutoff:g})"

    _repr_html_ = to_html  # what a notebook shows

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return max(dr.width(self.mean), dr.width(self.factor), dr.width(self.color))

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.color)

    @exclusive()
    def __getitem__(self, selection: Any) -> Gaussians:
        """Select Gaussians by a slice, an integer array or a boolean mask; differentiable.

        The result has the same background.

        Raises
        ------
        IndexError
            If the index is out of range or has another type.
        ValueError
            If the selection is empty.
        """
        types = types_of(self.mean)
        kept = np.atleast_1d(np.arange(len(self), dtype=np.uint32)[selection])
        if not kept.size:
            raise ValueError("Gaussians: the selection is empty; select at least one Gaussian")
        chosen = upload(types.UInt, kept)

        def pick(rows: Any) -> Any:
            whole = [broadcast(row, len(self)) for row in rows]
            return type(rows)([dr.gather(types.Float, row, chosen) for row in whole])

        return replace(self, mean=pick(self.mean), factor=pick(self.factor), color=pick(self.color))

    @exclusive()
    def scaled(self, width: int, height: int) -> Gaussians:
        """Scale the picture to another native size, in pixels; differentiable.

        Raises
        ------
        ValueError
            If a side is not positive.
        """
        if width < 1 or height < 1:
            raise ValueError(f"size {width}x{height}: both sides must be at least 1 pixel")
        if (width, height) == (self.width, self.height):
            return self
        types = types_of(self.mean)
        # In arrays: as literals they would compile the program for every size.
        sx, sy, rx, ry = (
            dr.opaque(types.Float, ratio)
            for ratio in (
                width / self.width,
                height / self.height,
                self.width / width,
                self.height / height,
            )
        )
        a, b, c = self.factor
        return replace(
            self,
            mean=types.Float2(self.mean[0] * sx, self.mean[1] * sy),
            factor=types.Float3(a * rx, b * ry, c * ry),
            width=width,
            height=height,
        )

    @exclusive()
    def bounded(self, size: tuple[Any, Any] | None = None) -> Gaussians:
        """Clip every parameter to its bounds, see `eigengs_dr.gaussian.bounds.clip_parameters`.

        Parameters
        ----------
        size : pair of Float, shape (1,), optional
            The native width and height in arrays, if a frozen program shall serve every size.
        """
        types = types_of(self.mean)
        if size is None:
            size = dr.opaque(types.Float, self.width), dr.opaque(types.Float, self.height)
        parameters = self.mean, self.factor, self.color, self.background
        mean, factor, color, background = clip_parameters(*parameters, *size)
        return replace(self, mean=mean, factor=factor, color=color, background=background)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set as an ``.npz`` file in single precision, completely or not at all.

        Raises
        ------
        ValueError
            If the suffix is ``.egs``; use `eigengs_dr.pack` for such files.
        OSError
            If the file cannot be written; an existing file does not change.
        """
        write(path, self.data())

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        backend: str | None = None,
        sections: int | None = None,
        dtype: DTypeLike = np.float32,
    ) -> Gaussians:
        """Read a set that `save` or `eigengs_dr.pack` wrote.

        Parameters
        ----------
        path : path-like
        backend : {"llvm", "cuda"}, optional
            As for `from_arrays`.
        sections : int, optional
            Number of sections to read from the start of an ``.egs`` file, which may end after
            them. By default all sections.
        dtype : {numpy.float32, numpy.float64}, optional
            As for `from_arrays`. Files hold single precision.

        Raises
        ------
        ValueError
            If the file has another format or a newer version, is damaged, has fewer sections, or
            holds invalid values. One line names the file and the key.
        OSError
            If the file cannot be opened.
        """
        return cls.from_data(read(Path(path), sections), backend, dtype)


def broadcast(row: Any, count: int) -> Any:
    """Repeat a row with a single entry `count` times."""
    return row + dr.zeros(type(row), count)


def _columns(types: Any, array: NDArray[Any]) -> list:
    return upload_rows(types.Float, array.T)


def _rows(rows: Any, count: int) -> NDArray[Any]:
    """Stack Dr.Jit rows, which may have a single entry, to an array of shape (count, rows)."""
    columns = [np.broadcast_to(dr.detach(row).numpy(), count) for row in rows]
    return np.stack(columns, axis=1)
