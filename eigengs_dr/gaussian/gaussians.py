"""Sets of 2D Gaussians: parameters, bounds, and operations on whole sets.

A set is created from NumPy arrays, a file, Dr.Jit tensors, or several other sets. It represents
one image, or several maps that share means and shapes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..backend.arrays import eval_pending_scatters, types_in, types_of, upload, upload_rows
from ..backend.entry_points import class_of_entry_points, entry_point
from ..backend.messages import shown
from ..backend.selection import BackendError, select
from ..backend.types import Array2f, Array3f, Float, FloatLike, Rows, Tensor, UInt
from ..image.pixels import check_size
from ..image.space import YCBCR, Space, space_of
from ..storage.npz import BadValue
from .channels import TextureMap, find_map
from .file import CUTOFF, Arrays, SetData, check, read_set, write_set

MIN_DEVIATION = 0.25
"""Smallest standard deviation along an axis of the factor, in pixels. A narrower Gaussian can lie
between pixel centres, where it has no gradient."""


def notebook_html(value: object) -> str:
    """Return HTML of a set, a fit, a basis or a model, by the public name of what lies above."""
    import eigengs_dr as eg

    return eg.to_html(value)


@class_of_entry_points
@dataclass(repr=False, eq=False)
class Gaussians:
    """N two-dimensional Gaussians and a constant background, which represent an image.

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
    space : Space
        What the channels mean, one of `eigengs_dr.image.space.SPACES`: a string, its name.
    cutoff : float
        Standard deviations at which a Gaussian ends, in (0, 12]. The error at a point is at most
        ``exp(-cutoff^2 / 2)`` times the sum of the absolute colours of the Gaussians that end
        before it.
    maps : tuple of TextureMap
        Groups of channels, if the set has several maps, as a material has: each is a name, a
        space, a number of channels and the weight of its errors, 1 by default, as in
        ``("albedo", "linear", 3, 0.5)``. ``gaussians["albedo"]`` is then the set of one
        map, and `space` is "data", because each map has its own. Together, maps have at most 16
        channels.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> len(g), g.channels
    (1, 1)
    """

    mean: Array2f
    factor: Array3f
    color: Rows
    background: Rows
    width: int
    height: int
    space: Space = YCBCR
    cutoff: float = CUTOFF
    maps: tuple[TextureMap, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.space, Space) and self.width:  # `drjit.grad` makes 0 of it
            self.space = space_of(self.space)

    @classmethod
    def from_arrays(
        cls,
        mean: ArrayLike,
        factor: ArrayLike,
        color: ArrayLike,
        background: ArrayLike | None = None,
        *,
        size: tuple[int, int],
        space: str = YCBCR,
        backend: str | None = None,
        cutoff: float = CUTOFF,
        dtype: DTypeLike = np.float32,
        maps: Sequence[TextureMap] = (),
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
        space, cutoff, maps : optional
            See `Gaussians`.
        backend : {"llvm", "cuda"}, optional
            By default "cuda" if the machine has a CUDA GPU, else "llvm".
        dtype : {numpy.float32, numpy.float64}, optional
            Precision of the arrays, of renderings and of derivatives.

        Raises
        ------
        TypeError
            If an array does not hold numbers, or an argument has another type.
        ValueError
            If shapes do not match, or a value is out of range or not finite.
        """
        arrays = _arrays(mean, factor, color, background)
        content = SetData(arrays, size, space, cutoff, tuple(maps))  # type: ignore[arg-type]
        return cls.from_data(content, backend, dtype)

    @classmethod
    def from_data(
        cls, data: SetData, backend: str | None = None, dtype: DTypeLike = np.float32
    ) -> Gaussians:
        """Create a set from the content of a file; for the arguments see `from_arrays`."""
        kind = np.dtype(dtype)
        if kind not in (np.float32, np.float64):
            raise ValueError(f"Gaussians: dtype is {kind}; give numpy.float32 or numpy.float64")
        if bad := [name for name, values in data.arrays.items() if np.iscomplexobj(values)]:
            raise ValueError(f"Gaussians: {bad[0]} is complex; pass real numbers")
        arrays = {name: np.asarray(values, kind) for name, values in data.arrays.items()}
        arrays.setdefault("background", np.zeros(arrays["color"].shape[1:], kind))
        width, height = check_size(data.size)
        try:
            data = check(data._replace(arrays=arrays, size=(width, height)))
        except BadValue as error:
            raise ValueError(f"Gaussians: {error}") from None
        types = types_in(select(backend), 8 * kind.itemsize)
        return cls(
            mean=types.Float2(upload_rows(types.Float, arrays["mean"].T)),
            factor=types.Float3(upload_rows(types.Float, arrays["factor"].T)),
            color=types.FloatX(upload_rows(types.Float, arrays["color"].T)),
            background=types.FloatX(upload_rows(types.Float, arrays["background"][:, None])),
            width=width,
            height=height,
            space=data.space,
            cutoff=float(data.cutoff),  # a NumPy scalar would promote Dr.Jit arrays to float64
            maps=data.maps,
        )

    def data(self) -> SetData:
        """Return the content for a file."""
        size = self.width, self.height
        return SetData(self.to_arrays(), size, self.space, self.cutoff, self.maps)

    def to_arrays(self) -> Arrays:
        """Return mean (N, 2), factor (N, 3), color (N, C) and background (C,) as NumPy arrays."""

        def stacked(rows: Rows, count: int) -> NDArray[np.floating]:
            columns = [np.broadcast_to(dr.detach(row).numpy(), count) for row in rows]
            return np.stack(columns, axis=1)

        parameters = {"mean": self.mean, "factor": self.factor, "color": self.color}
        arrays = {name: stacked(rows, len(self)) for name, rows in parameters.items()}
        return arrays | {"background": stacked(self.background, 1)[0]}

    def __reduce__(self) -> tuple:
        """Pickle the set as NumPy arrays, without derivatives."""
        types = types_of(self.mean)
        kind = np.dtype(f"f{types.bits // 8}")
        return _received, (self.data(), types.backend, kind)

    def __repr__(self) -> str:
        if not self.width:  # `drjit.grad` keeps arrays alone; it makes 0 of sizes and names
            return f"Gaussians({len(self)}, derivatives)"
        size = f"{len(self)}, {self.width}x{self.height} pixels"
        kind = f"{self.channels} channels, {self.space!r}"
        if self.maps:
            kind = f"maps {', '.join(m.name for m in self.maps)}"
        return f"Gaussians({size}, {kind}, cutoff={self.cutoff:g})"

    _repr_html_ = notebook_html  # what a notebook shows

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return max(dr.width(self.mean), dr.width(self.factor), dr.width(self.color))

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.color)

    def __getitem__(self, selection: Any) -> Gaussians:
        """Select Gaussians by a slice, an integer array or a boolean mask, or a map by its name.

        Differentiable. The result has the background of the set. The set of a map has all
        Gaussians, and shares the memory of their means and shapes.

        Raises
        ------
        IndexError
            If the index is out of range, or has another type or more axes.
        ValueError
            If the selection is empty.
        KeyError
            If there is no such map; the message lists the names.
        """
        if isinstance(selection, str):
            return self._map(selection)
        kept = np.atleast_1d(np.arange(len(self), dtype=np.uint32)[selection])
        if kept.ndim > 1:
            raise IndexError(f"Gaussians: the index has shape {kept.shape}; give one axis")
        if not kept.size:
            raise ValueError("Gaussians: the selection is empty; select at least one Gaussian")
        return take(self, upload(types_of(self.mean).UInt, kept))

    def _map(self, name: str) -> Gaussians:
        try:
            texture_map, part = find_map(self.maps, name)
        except BadValue as error:
            raise KeyError(f"Gaussians: {error}") from None
        kind = type(self.color)
        color, background = kind(list(self.color)[part]), kind(list(self.background)[part])
        return replace(self, color=color, background=background, space=texture_map.space, maps=())

    def scaled(self, width: int, height: int) -> Gaussians:
        """Scale the image to another native size, in pixels; differentiable.

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
        # In arrays: as literals, every size would compile a program of its own.
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

    def bounded(self, size: tuple[Float, Float] | None = None) -> Gaussians:
        """Clip every parameter to its bounds.

        Means are clipped to the image, a and c to the range from 1 / (twice the longer side) to 1 /
        `MIN_DEVIATION`, and b to +-1 / `MIN_DEVIATION`. Values that are not finite are replaced: a
        mean by the centre of the image, a and c by 1 / `MIN_DEVIATION`, b and colours by 0.

        Parameters
        ----------
        size : pair of Float, shape (1,), optional
            The native width and height in arrays, for a frozen program that serves every size.
        """
        types = types_of(self.mean)
        if size is None:
            size = dr.opaque(types.Float, self.width), dr.opaque(types.Float, self.height)
        # In double precision, because cuda divides approximately in single.
        longer = dr.float64_array_t(types.Float)(dr.maximum(*size))
        low, high = types.Float(0.5 / longer), 1 / MIN_DEVIATION

        def inside(x: Float, low: FloatLike, high: FloatLike, otherwise: FloatLike) -> Float:
            return dr.select(dr.isfinite(x), dr.clip(x, low, high), otherwise)

        a, b, c = self.factor
        mean = [inside(x, 0.0, side, 0.5 * side) for x, side in zip(self.mean, size, strict=True)]
        factor = inside(a, low, high, high), inside(b, -high, high, 0.0), inside(c, low, high, high)
        return replace(
            self,
            mean=types.Float2(mean),
            factor=types.Float3(*factor),
            color=dr.select(dr.isfinite(self.color), self.color, 0),
            background=dr.select(dr.isfinite(self.background), self.background, 0),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set atomically as an ``.npz`` file in single precision.

        Raises
        ------
        ValueError
            If the suffix is ``.egs``; use `eigengs_dr.pack` for such files.
        OSError
            If the file cannot be written; an existing file does not change.
        """
        write_set(path, self.data())

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
            As for `from_arrays`. Files are in single precision.

        Raises
        ------
        ValueError
            If the file has another format or a newer version, is damaged, has fewer sections, or
            holds invalid values. One line names the file and the key.
        OSError
            If there is no such file, it is a folder, or it cannot be opened.
        """
        return cls.from_data(read_set(Path(path), sections), backend, dtype)


def _arrays(
    mean: ArrayLike, factor: ArrayLike, color: ArrayLike, background: ArrayLike | None
) -> Arrays:
    """Return the arrays of a set by their names; refuse what holds no real numbers."""
    given = {"mean": mean, "factor": factor, "color": color, "background": background}
    if background is None:
        del given["background"]
    arrays = {name: np.asarray(values) for name, values in given.items()}
    for name, array in arrays.items():
        if array.dtype.kind not in "biufc":
            raise TypeError(f"Gaussians: {name} is {shown(given[name])}; give real numbers")
    return arrays


def _received(data: SetData, backend: str, kind: DTypeLike) -> Gaussians:
    """Unpickle a set, which may come from a machine with a GPU."""
    try:
        return Gaussians.from_data(data, backend, kind)
    except BackendError:
        return Gaussians.from_data(data, None, kind)


def take(gaussians: Gaussians, index: UInt) -> Gaussians:
    """Return the Gaussians of an index; differentiable, and usable in a frozen program."""
    Float = types_of(gaussians.mean).Float

    def pick(rows: Rows) -> Rows:
        return type(rows)([dr.gather(Float, row, index) for row in broadcast_rows(rows, gaussians)])

    mean, factor, color = map(pick, (gaussians.mean, gaussians.factor, gaussians.color))
    return replace(gaussians, mean=mean, factor=factor, color=color)


def broadcast_rows(rows: Rows, gaussians: Gaussians) -> list[Float]:
    """Return rows with one entry per Gaussian; a row of length 1 is broadcast."""
    return [row + dr.zeros(type(row), len(gaussians)) for row in rows]


@entry_point
def concatenate(sets: Sequence[Gaussians]) -> Gaussians:
    """Concatenate sets and add their backgrounds.

    In the spaces "rgb", "linear", "radiance" and "data", the picture of the result is the sum of
    theirs; the others decode sums, and not by a linear function.

    Parameters
    ----------
    sets : sequence of Gaussians
        At least one. All must have the same native size, space, cutoff, channels, maps and backend.

    Returns
    -------
    Gaussians
        The Gaussians of the first set, then those of the second, and so on. A single set is
        returned unchanged. Values are not checked; `Gaussians.bounded` clips them.

    Raises
    ------
    TypeError
        If it is no list or tuple of sets.
    ValueError
        If there are no sets, or they differ in one of these properties.
    """
    if not sets:
        raise ValueError("concatenate: no sets were given; pass at least one")
    first = sets[0]
    kinds = {(g.width, g.height, g.space, g.cutoff, g.channels, g.maps, type(g.mean)) for g in sets}
    if len(kinds) > 1:
        raise ValueError(
            "concatenate: sets differ in size, space, cutoff, channels or backend; "
            "bring them to one size with scaled() first"
        )
    if len(sets) == 1:
        return first

    def join(name: str) -> Rows:
        parts = zip(*(broadcast_rows(getattr(g, name), g) for g in sets), strict=True)
        return type(getattr(first, name))([dr.concat(part) for part in parts])

    joined = replace(
        first,
        mean=join("mean"),
        factor=join("factor"),
        color=join("color"),
        background=sum((g.background for g in sets[1:]), first.background),
    )
    dr.eval(joined)  # leaves no pending scatters, see `eval_pending_scatters`
    return joined


def like(
    gaussians: Gaussians,
    mean: ArrayLike,
    factor: ArrayLike,
    color: ArrayLike,
    background: ArrayLike | None = None,
) -> Gaussians:
    """Create a set from NumPy arrays, with the size, space, cutoff and backend of another set.

    For the arrays and errors see `eigengs_dr.Gaussians.from_arrays`.
    """
    size = gaussians.width, gaussians.height
    arrays = _arrays(mean, factor, color, background)
    data = SetData(arrays, size, gaussians.space, gaussians.cutoff)
    return Gaussians.from_data(data, types_of(gaussians.mean).backend)


class Fitted(Protocol):
    """An object with the set of a fit, such as `eigengs_dr.Fit`."""

    @property
    def gaussians(self) -> Gaussians:
        """The set of Gaussians."""

    @property
    def mean_image(self) -> NDArray[np.float32] | None:
        """Pixels to add to renderings of the set."""


def set_of(source: Gaussians | Fitted) -> Gaussians:
    """Return a set, or the set of a fit.

    Raises
    ------
    TypeError
        If the source is neither.
    ValueError
        If the fit has a mean image of pixels, which the set lacks.
    """
    if isinstance(source, Gaussians):
        return source
    if not hasattr(source, "trace") or not hasattr(source, "gaussians"):
        raise TypeError(
            f"{type(source).__name__} is not a set of Gaussians; pass Gaussians, which "
            "Gaussians.load reads from a file, or a Fit"
        )
    if source.mean_image is not None:
        raise ValueError("the fit has a mean image of pixels, which its set lacks; use .gaussians")
    return source.gaussians


FIELDS = {"mean": 2, "factor": 3, "color": 0, "background": 0}
"""Parameters of a set, with their numbers of columns; 0 means the number of channels."""


@entry_point
def to_tensors(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return the parameters of a set as tensors; differentiable.

    Parameters
    ----------
    gaussians : Gaussians

    Returns
    -------
    dict of str to TensorXf
        mean (N, 2), factor (N, 3), color (N, C) and background (C,), as in
        `Gaussians.from_arrays`.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> {name: tensor.shape for name, tensor in eg.to_tensors(g).items()}
    {'mean': (1, 2), 'factor': (1, 3), 'color': (1, 1), 'background': (1,)}
    """
    types = types_of(gaussians.mean)
    tensors = {}
    for name in FIELDS:
        rows = getattr(gaussians, name)
        rows = eval_pending_scatters(
            list(rows) if name == "background" else broadcast_rows(rows, gaussians)
        )
        joint = dr.ravel(types.FloatX(rows), order="F")
        tensors[name] = types.Tensor(joint, (dr.width(joint) // len(rows), len(rows)))
    tensors["background"] = tensors["background"][0]
    return tensors


@entry_point
def from_tensors(tensors: Mapping[str, Tensor], like: Gaussians) -> Gaussians:
    """Create a set from tensors; differentiable. The inverse of `to_tensors`.

    Parameters
    ----------
    tensors : mapping of str to TensorXf
        Any of mean, factor, color and background, with the shapes that `to_tensors` returns. Other
        keys are ignored.
    like : Gaussians
        Set from which the size, the space, the cutoff and missing parameters are taken.

    Returns
    -------
    Gaussians
        Values are not checked; `Gaussians.bounded` clips them.

    Raises
    ------
    ValueError
        If shapes do not match.
    TypeError
        If a value is not a Dr.Jit tensor of floats, or `tensors` is no mapping.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> brighter = eg.from_tensors({"color": 2 * eg.to_tensors(g)["color"]}, like=g)
    """
    given = {name: tensors[name] for name in FIELDS if name in tensors}
    for name, tensor in given.items():
        if not (dr.is_tensor_v(type(tensor)) and dr.is_float_v(type(tensor))):
            raise TypeError(
                f"{name} is a {type(tensor).__module__}.{type(tensor).__name__}, expected a Dr.Jit "
                "tensor of floats; drjit.wrap converts those of PyTorch and JAX functions"
            )
    counts = [given[name].shape[0] for name in ("mean", "factor", "color") if name in given]
    # The number of Gaussians may differ from `like` only if all parameters of Gaussians are given.
    count = max(counts) if len(counts) == 3 else len(like)
    for name, tensor in given.items():
        columns = FIELDS[name] or like.channels
        expected = (columns,) if name == "background" else (count, columns)
        if tuple(tensor.shape) != expected or not count:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {expected}")

    def rows(name: str) -> Rows:
        old: Rows = getattr(like, name)
        return _columns_of(old, given[name]) if name in given else old

    return replace(
        like,
        mean=rows("mean"),
        factor=rows("factor"),
        color=rows("color"),
        background=rows("background"),
    )


def _columns_of(like: Rows, tensor: Tensor) -> Rows:
    """Return the columns of a tensor as a nested array with the type of `like`."""
    types = types_of(like)
    number = tensor.shape[-1]
    values = types.Float(tensor.array)  # the tensor may have another precision
    index = dr.arange(types.UInt, dr.width(values) // number) * number
    return type(like)([dr.gather(types.Float, values, index + k) for k in range(number)])


def one_image(gaussians: Gaussians) -> Gaussians:
    """Return a set of one image unchanged, and reject a set with maps.

    Raises
    ------
    ValueError
        If the set has maps; the message lists them.
    """
    if gaussians.maps:
        names = ", ".join(m.name for m in gaussians.maps)
        first = gaussians.maps[0].name
        raise ValueError(f"the set has the maps {names}; choose one, e.g. gaussians[{first!r}]")
    return gaussians


def with_colors(gaussians: Gaussians, coefficients: NDArray[np.float64], space: Space) -> Gaussians:
    """Return Gaussians of the same shapes with new colours.

    Parameters
    ----------
    gaussians : Gaussians
    coefficients : ndarray, shape (N + 1, C)
        Colours of the Gaussians; the last row is the background.
    space : Space
    """
    types = types_of(gaussians.mean)
    rows = coefficients.astype(np.float32).T
    uploaded = upload_rows(types.Float, [*rows[:, :-1], *rows[:, -1:]])
    return replace(
        gaussians,
        color=types.FloatX(uploaded[: len(rows)]),
        background=types.FloatX(uploaded[len(rows) :]),
        space=space,
    )
