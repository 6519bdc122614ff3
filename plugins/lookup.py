"""What lookups of ``gaussian_texture`` read, and the lookups over a footprint.

A material that looks a point up twice pays once. A BSDF looks its textures up in its evaluation
and again in its sampling, often in one recorded program. Dr.Jit merges equal gathers of a bitmap,
but not equal loops. Textures of the maps of one file share a table, so they share lookups too:
the weights of the Gaussians are summed once for all channels.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import indices_of, scope, upload
from eigengs_dr.backend.types import Bool, Float, Record
from eigengs_dr.raster.evaluate import inverted
from eigengs_dr.raster.lookup.cells import CellLists, cell_side, list_cells
from eigengs_dr.raster.lookup.coding import Coding, encode_rows
from eigengs_dr.raster.lookup.footprint import bound_covariance
from eigengs_dr.raster.lookup.points import Packed, invert
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered, where_any
from eigengs_dr.raster.lookup.pyramid import (
    GaussianPyramid,
    build_pyramid,
    is_minified,
    levels_of,
    pyramid_mean,
    sum_pyramid,
)
from eigengs_dr.raster.lookup.size_classes import SizeClasses, classify_by_size
from eigengs_dr.raster.parameters import KernelParameters, kernel_radius

from .color import keep_finite


@dataclass(frozen=True)
class Lists:
    """What lookups need of the shapes of Gaussians, whatever their colours.

    Attributes
    ----------
    cells : CellLists
        The Gaussians near every point of an image.
    sizes : SizeClasses or None
        The Gaussians near every footprint; None without a prefilter.
    """

    cells: CellLists
    sizes: SizeClasses | None


class Memory(NamedTuple):
    """What a texture holds, see the property ``memory`` of the plugins.

    Attributes
    ----------
    name : str
    coded : bool
        Whether rows of Gaussians are words of `eigengs_dr.raster.lookup.coding` until one changes.
    coarser : int
        Factor of the sides of cells.
    """

    name: str
    coded: bool = True
    coarser: int = 1


MEMORIES = {
    memory.name: memory
    for memory in (Memory("exact", coded=False), Memory("normal"), Memory("small", coarser=2))
}


def list_gaussians(
    shape: list, size: tuple[int, int], cutoff: float, wrap: str, filtered: bool, memory: Memory
) -> Lists:
    """List Gaussians for lookups at points or, if `filtered`, over footprints.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        See `eigengs_dr.raster.parameters.KernelParameters`.
    size : (int, int)
    cutoff, wrap, filtered, memory
        See the properties of the texture.
    """
    if filtered:
        sizes = classify_by_size(shape, *size, cutoff, wrap, memory.coarser)
        return Lists(sizes.cells, sizes)  # slopes and the survey look at points
    level = shape, cell_side(*size, dr.width(shape), memory.coarser)
    return Lists(list_cells([level], *size, kernel_radius(cutoff)), None)


@dataclass(frozen=True, eq=False)
class Table:
    """What lookups read.

    Attributes
    ----------
    lists : Lists
    packed : Packed
    background : list of Float, shape (1,)
    pyramid : GaussianPyramid or None
        None without a prefilter.
    average : list of Float, shape (1,)
        Mean of the sums; empty without a prefilter.
    """

    lists: Lists
    packed: Packed
    background: list
    pyramid: GaussianPyramid | None
    average: list

    def parameters(self) -> KernelParameters:
        """Return the Gaussians in the order of the set, as the rows hold them."""
        cells, packed = self.lists.cells, self.packed
        row = upload(mi.UInt32, cells.rows_of(np.arange(cells.count)))
        return KernelParameters(*packed.decode(*packed.gather(row)), self.background)


def make_table(
    lists: Lists,
    cutoff: float,
    inputs: Record,
    decode: Callable[[Record], KernelParameters],
    coded_for: tuple[int, int] | None = None,
) -> Table:
    """Compute what lookups read; derivatives flow back to the `inputs` of `decode`.

    Rows are coded for a size of the picture if the set allows it and there are no derivatives.
    """
    cells, sizes = lists.cells, lists.sizes
    derivatives = dr.grad_enabled(inputs)

    def compute(inputs: Record) -> Record:
        parameters = decode(inputs)
        shape, color = parameters.shape, [keep_finite(c) for c in parameters.color]
        coded = None if derivatives else coded_for
        rows, coding = _rows(cells, shape, color, bool(sizes), coded)
        background = [keep_finite(b) for b in parameters.background]
        arrays: Record = {"packed": rows, "background": background}
        arrays |= {"coding": coding} if coding else {}
        dr.eval(arrays)
        if sizes is not None:
            packed = Packed(rows, len(color), cutoff, inverted=True, coding=coding)
            pyramid = build_pyramid(sizes, packed)
            arrays |= {"values": pyramid.values, "average": pyramid_mean(pyramid)}
            dr.eval(arrays["average"])
        return arrays

    arrays = derived(inputs, compute)
    background, pyramid = arrays["background"], None
    channels = len(background)
    if sizes is not None:
        levels = levels_of(sizes.width, sizes.height, cells.count, sizes.wrap)
        pyramid = GaussianPyramid(sizes.wrap, channels, levels, arrays["values"], mi.Float(1))
        pyramid = pyramid if derivatives else pyramid.halved()
    coding, filtered = arrays.get("coding"), sizes is not None
    packed = Packed(arrays["packed"], channels, cutoff, inverted=filtered, coding=coding)
    return Table(lists, packed, background, pyramid, arrays.get("average", []))


def _rows(
    cells: CellLists, shape: list, color: list, filtered: bool, size: tuple[int, int] | None
) -> tuple[Float, Coding | None]:
    """Return the rows of Gaussians as sums read them, and what decodes those for a size."""
    stored = inverted(shape) if filtered else shape
    encoded = encode_rows(shape, stored, color, size) if size else None
    if encoded is None:
        return cells.pack(*(invert(shape, color) if filtered else (shape, color))), None
    coding, words = encoded
    return cells.pack_rows(words, coding.blank), coding


class _Lookups(threading.local):
    """The lookups of this thread since its last change of scope, by what they depend on.

    Dr.Jit starts another scope with every nested call, loop and branch. A result may be used again
    only if there was none since, but for the loops of the lookups themselves: else it could belong
    to a branch that has ended.
    """

    def __init__(self) -> None:
        self.scope = -1
        self.results: dict[tuple, tuple[list, list]] = {}


_lookups = _Lookups()


def reused(
    table: Table,
    where: tuple,
    si: mi.SurfaceInteraction3f,
    inputs: tuple,
    look_up: Callable[[], list],
) -> list:
    """Return the result of a lookup, from an earlier one with the same inputs if there is one.

    Parameters
    ----------
    table : Table
    where : tuple
        Properties of the texture on which the lookup depends.
    si : mitsuba.SurfaceInteraction3f
    inputs : tuple of str
        Attributes of `si` on which the lookup depends.
    look_up : callable
        Makes the result, for all lanes of the program: of two callers, one may need other lanes.

    Returns
    -------
    list of Float
        Never shared where there are gradients: they must not cross `drjit.isolate_grad`.
    """
    if not _is_traced():
        return look_up()
    arrays = [table.packed.values, *(getattr(si, name) for name in inputs)]
    if dr.grad_enabled(arrays):
        return look_up()
    backend = dr.backend_v(mi.Float)
    if scope(backend) != _lookups.scope:
        _lookups.results.clear()
    # The arrays keep their indices, so that no other variable has them.
    key = (where, *indices_of(arrays))
    if key not in _lookups.results:
        _lookups.results[key] = look_up(), arrays
    _lookups.scope = scope(backend)
    return _lookups.results[key][0]


def _is_traced() -> bool:
    """Return whether Dr.Jit traces a program that is not frozen.

    In wavefronts a result would take memory. A recording of a frozen program ends the process if
    results of an earlier program are freed meanwhile.
    """
    return dr.flag(dr.JitFlag.SymbolicScope) and not dr.flag(dr.JitFlag.FreezingScope)


def sum_over_footprint(
    table: Table, column: tuple, row: tuple, active: Bool, seen: tuple[list, Bool]
) -> list:
    """Average the sum of Gaussians over the footprint around a point.

    Parameters
    ----------
    table : Table
        With a pyramid.
    column, row : tuple of 2 Float
        x and y in pixels, with the slopes 1 or -1, from `eigengs_dr.raster.lookup.points.fold`, or
        of a clamped image from `near_image`.
    active : Bool
    seen : tuple
        From `eigengs_dr.plugins.cone.seen_metric`.

    Returns
    -------
    list of Float
        One sum for each channel, without the background.
    """
    # The slopes of `fold` turn a footprint in mirrored images.
    (x, sx), (y, sy) = column, row
    sizes, pyramid = table.lists.sizes, table.pyramid
    assert sizes and pyramid
    sx, sy = sx * sizes.width, sy * sizes.height
    inverse, valid = seen
    unit, blind = bound_covariance(inverse)
    squares = (sx * sx, sx * sy, sy * sy)
    footprint = [dr.select(valid, f * s, 0) for f, s in zip(unit, squares, strict=True)]
    # A clamped image never shows its mean: the largest footprint includes its border too.
    blind &= valid & (sizes.wrap != "clamp")
    distant = is_minified(pyramid, footprint)
    near, wide = active & ~distant, active & distant & ~blind

    sharp = sum_prefiltered(sizes, table.packed, x, y, footprint, near)
    far = where_any(
        wide,
        lambda: sum_pyramid(pyramid, x, y, footprint, wide),
        [mi.Float(0)] * pyramid.channels,
        (pyramid.values, x, y, *footprint),
    )
    sums = [dr.select(distant, f, n) for f, n in zip(far, sharp, strict=True)]
    return [dr.select(blind, m, s) for m, s in zip(table.average, sums, strict=True)]


# ---------------------------------------------------------------------------------------------
#  What lookups read, one operation of the graph of derivatives
#
#  `mitsuba.render` differentiates the renderer as one operation whose inputs are the parameters.
#  In forward mode, the derivatives of all that textures have computed from them must be known by
#  then. Dr.Jit walks from the parameters to the operations in the order in which these were made.
#  So one operation, made before the rendering, must lead from the parameters to all that lookups
#  read: of a chain of several, only the first would come before the renderer, and the derivative
#  be 0.
# ---------------------------------------------------------------------------------------------


def derived(inputs: Record, compute: Callable[[Record], Record]) -> Record:
    """Return ``compute(inputs)``; derivatives flow through one operation, in both modes.

    Parameters
    ----------
    inputs : dict of str to TensorXf
    compute : callable
        Returns a dict of arrays.
    """
    if not dr.grad_enabled(inputs):
        return compute(inputs)
    return dr.custom(_Derived, inputs, compute)


class _Derived(dr.CustomOp):
    """The operation of `derived`: it keeps its own graph and walks it in both modes."""

    def eval(self, inputs: Record, compute: Callable[[Record], Record]) -> Record:
        """Compute the arrays; `inputs` come without their derivatives."""
        self.inputs = {name: type(value)(value) for name, value in inputs.items()}
        with dr.resume_grad():
            dr.enable_grad(self.inputs)
            self.outputs = compute(self.inputs)
        return dr.detach(self.outputs)

    def forward(self) -> None:
        """Push the derivatives of the parameters through the graph."""
        if "values" in self.outputs:  # loops of a pyramid, which Dr.Jit 1.5 walks backward only
            raise RuntimeError(
                "no forward mode of Gaussians with a prefilter; use drjit.backward, or "
                "prefilter = 0"
            )
        dr.set_grad(self.inputs, self.grad_in("inputs"))
        self.set_grad_out(self._walk(dr.ADMode.Forward, self.inputs, self.outputs))

    def backward(self) -> None:
        """Pull the derivatives of the results back."""
        dr.set_grad(self.outputs, self.grad_out())
        self.set_grad_in("inputs", self._walk(dr.ADMode.Backward, self.outputs, self.inputs))

    def _walk(self, mode: dr.ADMode, source: Record, target: Record) -> Record:
        dr.enqueue(mode, source)
        dr.traverse(mode, dr.ADFlag.ClearInterior | dr.ADFlag.ClearInput)
        derivatives = dr.grad(target)
        dr.clear_grad(target)
        return derivatives
