"""Images from tile layout to rows of pixels."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend.arithmetic import make_divisor
from ..backend.arrays import ArrayTypes, types_of
from .binning.tiles import Grid
from .layout import gather_run


def to_tensor(image: Any, grid: Grid, channels: int) -> Any:
    """Convert an image from tile layout to a tensor (height, width, channels); differentiable."""
    types = types_of(image)
    rows = dr.custom(_Rows, image, grid, channels)
    if grid.overhangs:
        rows = _crop(types, rows, grid, channels)
    return types.Tensor(rows, (grid.height, grid.width, channels))


def _crop(types: ArrayTypes, rows: Any, grid: Grid, channels: int) -> Any:
    """Cut the image out of rows of whole tiles; differentiable.

    Numbers are in arrays, as in `_Rows`: slices of tensors compile a program for every size.
    """
    index = dr.arange(types.UInt, grid.height * grid.width * channels)
    length = dr.opaque(types.UInt, grid.width * channels)
    over = dr.opaque(types.UInt, (grid.nx * grid.tile[0] - grid.width) * channels)
    # The quotient of indices up to 2^32, exact in double precision.
    Double = dr.float64_array_t(types.Float)
    row = types.UInt((Double(index) + 0.5) / Double(length))
    return dr.gather(types.Float, rows, index + row * over, mode=dr.ReduceMode.NoConflicts)


class _Rows(dr.CustomOp):
    """Permutation from tile layout to rows of pixels; the transpose permutes back."""

    def eval(self, image: Any, grid: Grid, channels: int) -> Any:
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

    def _permute(self, values: Any, source: Any, target: Any) -> Any:
        types = types_of(values)
        result = dr.empty(types.Float, self.run * dr.width(source))
        dr.scatter(result, types.FloatX(gather_run(types, values, source, self.run, True)), target)
        return result
