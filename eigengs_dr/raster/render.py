"""Differentiable rendering of Gaussians, in forward and reverse mode.

Kernels write an image in tile layout. `render` returns it as rows of pixels, a tensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import index
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from ..backend.arrays import ArrayTypes, eval_pending_scatters, make_divisor, types_of
from ..backend.entry_points import entry_point
from ..backend.types import Float, FloatLike, Tensor, UInt, Values
from ..gaussian.channels import slices
from ..gaussian.covariance import add_variances
from ..gaussian.file import MAX_CUTOFF, Region, check_index_range, check_region
from ..gaussian.gaussians import Fitted, Gaussians, set_of
from .adjoint import adjoint
from .kernels import channel_sums, forward
from .lists import TileLists, build_lists, update_exact_exp
from .parameters import (
    EXP2_SCALE,
    KernelParameters,
    detached_shape,
    gather_run,
    kernel_radius,
    kernel_shape,
    pack_parameters,
)
from .tiles import TILE, Grid


@entry_point
def render(
    gaussians: Gaussians | Fitted,
    width: int | None = None,
    height: int | None = None,
    cutoff: float | None = None,
    lists: TileLists | None = None,
    *,
    region: Sequence[int] | None = None,
    filter: bool = True,
) -> Tensor:
    """Render a set of Gaussians, or a region of it, at any size.

    A smaller picture shows the average of the native one over each of its pixels. The result is
    differentiable with respect to mean, factor, color and background, in forward and reverse mode.
    A set in YCbCr is rendered as RGB, and sets in the spaces "linear", "radiance" and
    "log" as linear light (`picture_of` encodes it as sRGB); data is not converted. Values are not
    clamped.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    width, height : int, optional
        Size of the picture in pixels; by default the native size of the set or of the region. If
        only one is given, the native aspect ratio gives the other.
    cutoff : float, optional
        Standard deviations at which a Gaussian ends, in (0, 12]; by default the cutoff of the set.
    lists : TileLists, optional
        The result of `tile_lists` for this set, size, cutoff, region and filter, possibly of a few
        steps ago. The Gaussians may have shrunk since by any factor. By default new lists are
        built, which `drjit.freeze` cannot record.
    region : sequence of 4 int, optional
        Left, top, width and height in native pixels of the set: render this part alone.
    filter : bool, optional
        Whether an axis with fewer pixels than the native picture is averaged. False samples at the
        centres of pixels, which shows needles and patterns that the native picture does not have.
        At the native size and above, nothing is averaged.

    Returns
    -------
    TensorXf, shape (height, width, C)
        Dr.Jit tensor with the backend and the precision of the set; 1 is white.

    Raises
    ------
    ValueError
        If a side is not positive, the image is too large for 32-bit indices, the region is not
        inside the image, the cutoff is not in (0, 12], the lists are for another size, cutoff,
        region, filter or number of Gaussians, or `drjit.freeze` is recording and no lists are
        given.

    Notes
    -----
    The order of summation depends only on the input, so renderings on one machine and backend are
    bit-identical. A Gaussian is not drawn if its mean or factor is not finite. If its colour is not
    finite, pixels of the tiles that it touches may be wrong. `drjit.freeze` cannot record the
    construction of tile lists, which copies sizes to the host: build them with `tile_lists`, and
    pass them to the frozen function as an argument.

    A smaller picture averages the sums of Gaussians, in the colour space of the set: codes for
    "ycbcr" and "rgb", logarithms for "log". The box of a pixel is taken for a Gaussian of its
    variance.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> eg.render(g).shape, eg.render(g, width=16, region=(0, 2, 8, 4)).shape
    ((8, 8, 1), (8, 16, 1))
    """
    gaussians = set_of(gaussians)
    _check_rows(gaussians)
    frame = _frame(gaussians, width, height, region, filter)
    scaled = _seen(gaussians, frame, cutoff)
    parameters = decode_parameters(scaled)
    if lists is not None:
        _check_lists(lists, scaled, frame)
        lists = update_exact_exp(lists, dr.detach(parameters.shape), kernel_radius(scaled.cutoff))
    elif dr.flag(dr.JitFlag.FreezingScope):
        raise ValueError(
            "render: drjit.freeze cannot record how tile lists are built; build them with "
            "eigengs_dr.tile_lists before, and pass them to the frozen function as an argument"
        )
    else:
        lists = bin_gaussians(scaled, adjoint=dr.grad_enabled(parameters))
    image = rasterize(parameters, lists, scaled.cutoff)
    tensor = to_tensor(image, lists.grid, len(parameters.background))
    return tensor if gaussians.space.affine else gaussians.space.decode_image(tensor)


@entry_point
def tile_lists(
    gaussians: Gaussians | Fitted,
    width: int | None = None,
    height: int | None = None,
    cutoff: float | None = None,
    margin: float = 0.0,
    *,
    region: Sequence[int] | None = None,
    filter: bool = True,
) -> TileLists:
    """List the Gaussians that each tile of a rendering needs, for `render` inside `drjit.freeze`.

    Lists have no derivatives. A Gaussian that moves or grows within the margin only reaches tiles
    that list it already. Beyond the margin, the rendering and its derivatives miss the Gaussian in
    new tiles: rebuild the lists every few steps. A Gaussian may shrink by any factor: each
    rendering checks on the device whether one has become so narrow that its weights need an
    exponential at every pixel.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    width, height, cutoff : optional
        As for `render`, which must get the same values.
    margin : float, optional
        Pixels of the rendering by which Gaussians may move or grow before lists miss a tile.
    region, filter : optional
        As for `render`.

    Returns
    -------
    TileLists
        A PyTree of Dr.Jit arrays. A frozen function is recorded again if their sizes change.

    Raises
    ------
    ValueError
        As for `render`, or if the margin is negative or not finite.

    Examples
    --------
    >>> import drjit as dr
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> frozen = dr.freeze(lambda g, lists: eg.render(g, lists=lists))
    >>> frozen(g, eg.tile_lists(g)).shape
    (8, 8, 1)
    """
    gaussians = set_of(gaussians)
    _check_rows(gaussians)
    if not 0 <= margin < np.inf:
        raise ValueError(f"margin is {margin}; it must be finite and at least 0 pixels")
    frame = _frame(gaussians, width, height, region, filter)
    lists = bin_gaussians(_seen(dr.detach(gaussians), frame, cutoff), float(margin))
    return replace(lists, frame=frame)


@entry_point
def picture_of(
    gaussians: Gaussians | Fitted,
    width: int | None = None,
    height: int | None = None,
    cutoff: float | None = None,
    *,
    region: Sequence[int] | None = None,
    filter: bool = True,
) -> Any:
    """Render a set for display and comparison: as `render`, but with linear light encoded as sRGB.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    width, height, cutoff, region, filter : optional
        As for `render`.

    Returns
    -------
    ndarray, shape (height, width, C); or dict of str to ndarray
        1 is white. Negative linear light becomes 0; other values are not clamped. For a set with
        maps, a picture of each map by name.
    """
    gaussians = set_of(gaussians)
    shown = render(dr.detach(gaussians), width, height, cutoff, region=region, filter=filter)
    image = shown.numpy()
    if gaussians.maps:
        pairs = zip(gaussians.maps, slices(gaussians.maps), strict=True)
        return {m.name: m.space.display_sums(image[..., part]) for m, part in pairs}
    return gaussians.space.display(image)


def _check_rows(gaussians: Gaussians) -> None:
    """Raise ValueError for arrays of wrong shapes, with a clearer message than Dr.Jit's."""
    count = len(gaussians)
    for name, rows in (("mean", 2), ("factor", 3), ("color", gaussians.channels)):
        array = getattr(gaussians, name)
        if len(array) != rows or dr.width(array) not in (1, count):
            raise ValueError(
                f"Gaussians: {name} has shape ({dr.width(array)}, {len(array)}), expected "
                f"({count}, {rows})"
            )


def _check_lists(lists: TileLists, gaussians: Gaussians, frame: Frame) -> None:
    """Raise ValueError if lists are for another frame, number of Gaussians or cutoff."""
    assert lists.pieces is not None
    listed = lists.grid.width, lists.grid.height, dr.width(lists.pieces.number)
    expected = gaussians.width, gaussians.height, len(gaussians)
    if listed != expected:
        raise ValueError(
            "render: the lists are for {}x{} pixels and {} Gaussians, ".format(*listed)
            + "the rendering has {}x{} and {}; rebuild them with tile_lists".format(*expected)
        )
    if lists.radius != kernel_radius(gaussians.cutoff):
        raise ValueError(
            f"render: the lists are for the cutoff {lists.radius / EXP2_SCALE:g}, the rendering "
            f"has {gaussians.cutoff:g}; rebuild them with tile_lists"
        )
    if lists.frame != frame:
        raise ValueError(
            "render: the lists are for another region or filter; rebuild them with tile_lists"
        )


class Frame(NamedTuple):
    """What a rendering shows: a region in native pixels, at a size, averaged if it is smaller."""

    region: Region
    size: tuple[int, int]
    filter: bool


def _frame(
    gaussians: Gaussians,
    width: int | None,
    height: int | None,
    region: Sequence[int] | None,
    filter: bool,
) -> Frame:
    native = gaussians.width, gaussians.height
    part = check_region("region", (0, 0, *native) if region is None else region, native)
    size = _size(part[2:], width, height)
    return Frame(part, size, bool(filter) and (size[0] < part[2] or size[1] < part[3]))


def _size(native: tuple[int, int], width: int | None, height: int | None) -> tuple[int, int]:
    for name, side in (("width", width), ("height", height)):
        if side is not None and index(side) < 1:
            raise ValueError(f"{name} is {side}; it must be at least 1 pixel")
    if width is None and height is None:
        return native
    if width is None:
        assert height is not None
        width = max(1, round(height * native[0] / native[1]))
    if height is None:
        height = max(1, round(width * native[1] / native[0]))
    return index(width), index(height)


def _seen(gaussians: Gaussians, frame: Frame, cutoff: float | None) -> Gaussians:
    """Return the set whose native picture, sampled at centres of pixels, is a rendering."""
    (left, top, columns, rows), (width, height), filter = frame
    check_index_range(width, height, gaussians.channels, TILE)
    if filter:
        gaussians = filter_by_box(gaussians, (columns / width, rows / height))
    if frame.region != (0, 0, gaussians.width, gaussians.height):
        types = types_of(gaussians.mean)
        x, y = (dr.opaque(types.Float, v) for v in (left, top))
        mean = types.Float2(gaussians.mean[0] - x, gaussians.mean[1] - y)
        gaussians = replace(gaussians, mean=mean, width=columns, height=rows)
    scaled = gaussians.scaled(width, height)
    # A NumPy scalar would promote Dr.Jit arrays to float64.
    return scaled if cutoff is None else replace(scaled, cutoff=float(cutoff))


def filter_by_box(gaussians: Gaussians, times: tuple[float, float]) -> Gaussians:
    """Return a set whose values at points are averages over boxes; differentiable.

    The mean of k pixels in a row has a variance of ``(k^2 - 1) / 12`` pixels squared. It is added
    to each Gaussian, whose colour is scaled to keep its integral.

    Parameters
    ----------
    gaussians : Gaussians
    times : (float, float)
        Native pixels of a box along x and along y; at 1 and below, nothing is averaged.
    """
    if max(times) <= 1:
        return gaussians
    types = types_of(gaussians.mean)
    # In arrays: as literals, every size would compile a program of its own.
    variances = (dr.opaque(types.Float, max(k * k - 1, 0) / 12) for k in times)
    factor, amplitude = add_variances(*gaussians.factor, *variances)
    color = type(gaussians.color)([c * amplitude for c in gaussians.color])
    return replace(gaussians, factor=types.Float3(*factor), color=color)


def decode_parameters(gaussians: Gaussians) -> KernelParameters:
    """Return the parameters of a set with its colours decoded to RGB; differentiable.

    Decoding is affine, so it suffices to convert N colours and the background instead of all
    pixels.
    """
    decode = gaussians.space.decode if gaussians.space.affine else list
    black = decode([0.0] * gaussians.channels)
    color = [c - k for c, k in zip(decode(list(gaussians.color)), black, strict=True)]
    background = decode(list(gaussians.background))
    return KernelParameters(kernel_shape(gaussians), color, background)


def bin_gaussians(
    gaussians: Gaussians,
    pad: FloatLike = 0.0,
    growth: float = 1.0,
    adjoint: bool = True,
    images: int = 1,
) -> TileLists:
    """List the Gaussians of every tile of the image at native size.

    Parameters
    ----------
    gaussians : Gaussians or Fit
    pad : float or Float, shape (N,), optional
        Pixels by which ellipses are enlarged, so that the lists stay valid while Gaussians move.
    growth : float, optional
        Factor by which ellipses are enlarged, so that the lists stay valid while Gaussians grow.
    adjoint : bool, optional
        Whether the lists are used for reverse-mode differentiation too.
    images : int, optional
        Number of images of a batch, see `Grid`.

    Returns
    -------
    TileLists

    Raises
    ------
    ValueError
        If the cutoff is not in (0, 12].
    """
    cutoff = gaussians.cutoff
    if not 0 < cutoff <= MAX_CUTOFF:
        raise ValueError(f"cutoff is {cutoff}; it must be above 0 and at most {MAX_CUTOFF:g}")
    grid = Grid(gaussians.width, gaussians.height, images=images)
    shape = detached_shape(gaussians)
    return build_lists(shape, kernel_radius(cutoff), grid, pad, growth, adjoint)


def rasterize(parameters: KernelParameters, lists: TileLists, cutoff: float) -> Float:
    """Sum Gaussians to an image in tile layout: the differentiable operation behind `render`.

    Parameters
    ----------
    parameters : KernelParameters
    lists : TileLists
        Lists of these Gaussians. Padded lists stay valid as long as the ellipses move and grow by
        less than the padding.
    cutoff : float
        Standard deviations.

    Returns
    -------
    Float, shape (tiles * pixels * channels,)
        In the tile layout of `eigengs_dr.raster.kernels`; `to_tensor` converts it to an image.
    """
    values = [*parameters.shape, *parameters.color]
    return dr.custom(_Rasterize, values, parameters.background, lists, kernel_radius(cutoff))


class _Rasterize(dr.CustomOp):
    """``I = background + sum_n c_n w_n`` with the derivatives of `eigengs_dr.raster.kernels`."""

    def eval(self, values: list, background: list, lists: TileLists, radius: float) -> Float:
        self.lists, self.radius, self.channels = lists, radius, len(background)
        self.packed = pack_parameters(values)
        return forward(self.packed, background, lists, radius)

    def forward(self) -> None:
        tangent = pack_parameters(self.grad_in("values"))
        start = self.grad_in("background")
        self.set_grad_out(forward(self.packed, start, self.lists, self.radius, tangent))

    def backward(self) -> None:
        delta = self.grad_out()
        gradient = adjoint(self.packed, delta, self.channels, self.lists, self.radius)
        self.set_grad_in("values", gradient)
        self.set_grad_in("background", channel_sums(delta, self.channels, self.lists.grid))


def to_tiles(types: ArrayTypes, image: Values) -> Float:
    """Upload an image (height, width, channels) in tile layout; pixels outside it are 0.

    The images (M, height, width, channels) of a batch follow each other. Each lane gathers one
    value; the source holds interleaved pixels, or planes that `numpy.moveaxis` presents as pixels.
    """
    height, width, channels = image.shape[-3:]
    grid = Grid(width, height, images=len(image) if image.ndim == 4 else 1)
    planes = np.moveaxis(image, -1, -3)
    if planes.flags.c_contiguous:
        source, strides = planes, (width, 1, height * width)
    else:
        source, strides = np.ascontiguousarray(image), (width * channels, channels, 1)
    # Sizes are in arrays, so that one program serves all images with this number of channels.
    steps = (dr.opaque(types.UInt, stride) for stride in strides)
    layout, count = grid.in_arrays(types), grid.tiles * grid.pixels * channels
    index = dr.arange(types.UInt, count)
    pixel, channel = index // channels, index % channels
    column, row = layout.pixel(pixel)
    place = sum(n * step for n, step in zip((row, column, channel), steps, strict=True))
    number = layout.image_of(pixel // grid.pixels)
    if number is not None:
        place += number * dr.opaque(types.UInt, height * width * channels)
    flat = types.Float(source.reshape(-1))
    result = dr.gather(types.Float, flat, place, layout.inside(column, row))
    dr.eval(result)
    dr.sync_thread()  # the source may share the caller's memory
    return result


def to_tensor(image: Float, grid: Grid, channels: int) -> Tensor:
    """Convert an image from tile layout to a tensor (height, width, channels); differentiable."""
    types = types_of(image)
    rows = dr.custom(_Rows, image, grid, channels)
    if grid.overhangs:
        rows = _crop(types, rows, grid, channels)
    eval_pending_scatters([rows])
    return types.Tensor(rows, (grid.height, grid.width, channels))


def _crop(types: ArrayTypes, rows: Float, grid: Grid, channels: int) -> Float:
    """Crop rows of complete tiles to the image; differentiable.

    Numbers are in arrays, as in `_Rows`: slices of tensors compile a program for every size.
    """
    index = dr.arange(types.UInt, grid.height * grid.width * channels)
    length = dr.opaque(types.UInt, grid.width * channels)
    over = dr.opaque(types.UInt, (grid.nx * grid.tile[0] - grid.width) * channels)
    # The quotient of indices below 2^32 is exact in double precision.
    Double = dr.float64_array_t(types.Float)
    row = types.UInt((Double(index) + 0.5) / Double(length))
    return dr.gather(types.Float, rows, index + row * over, mode=dr.ReduceMode.NoConflicts)


class _Rows(dr.CustomOp):
    """Permutation from tile layout to rows of pixels; its transpose is the inverse permutation."""

    def eval(self, image: Float, grid: Grid, channels: int) -> Float:
        types = types_of(image)
        runs = dr.arange(types.UInt, grid.nx * grid.ny * grid.tile[1])
        columns = make_divisor(types, grid.nx)  # in arrays, for programs that serve every size
        row, column = columns.divmod(runs)
        tile_row, inner = row // grid.tile[1], row % grid.tile[1]
        self.by_row = runs
        self.by_tile = (tile_row * columns.divisor + column) * grid.tile[1] + inner
        self.run = grid.tile[0] * channels
        return self._permute(image, self.by_tile, self.by_row)

    def forward(self) -> None:
        self.set_grad_out(self._permute(self.grad_in("image"), self.by_tile, self.by_row))

    def backward(self) -> None:
        self.set_grad_in("image", self._permute(self.grad_out(), self.by_row, self.by_tile))

    def _permute(self, values: Float, source: UInt, target: UInt) -> Float:
        types = types_of(values)
        result = dr.empty(types.Float, self.run * dr.width(source))
        dr.scatter(result, types.FloatX(gather_run(types, values, source, self.run, True)), target)
        return result
