"""A set of Gaussians as Dr.Jit tensors, for optimisers and other frameworks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import drjit as dr

from ..backend.arrays import types_of
from ..backend.recording import exclusive
from .gaussians import Gaussians

FIELDS = {"mean": 2, "factor": 3, "color": 0, "background": 0}
"""Parameters of a set, with their numbers of columns; 0 means the number of channels."""


@exclusive()
def to_tensors(gaussians: Gaussians) -> dict[str, Any]:
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
        count = 1 if name == "background" else len(gaussians)
        whole = type(rows)([row + dr.zeros(types.Float, count) for row in rows])
        tensors[name] = types.Tensor(dr.ravel(whole, order="F"), (count, len(rows)))
    tensors["background"] = tensors["background"][0]
    return tensors


@exclusive()
def from_tensors(tensors: Mapping[str, Any], like: Gaussians) -> Gaussians:
    """Create a set from tensors; differentiable. The inverse of `to_tensors`.

    Parameters
    ----------
    tensors : mapping of str to TensorXf
        Any of mean, factor, color and background, with the shapes that `to_tensors` returns. Other
        keys are ignored.
    like : Gaussians
        Set that gives the size, the space, the cutoff and the parameters that `tensors` lacks.

    Returns
    -------
    Gaussians
        Values are not checked; `Gaussians.bounded` clips them.

    Raises
    ------
    ValueError
        If shapes do not fit each other.
    TypeError
        If a value is no tensor of Dr.Jit.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> brighter = eg.from_tensors({"color": 2 * eg.to_tensors(g)["color"]}, like=g)
    """
    given = {name: tensors[name] for name in FIELDS if name in tensors}
    counts = [given[name].shape[0] for name in ("mean", "factor", "color") if name in given]
    # The number of Gaussians may only differ from `like` if all of its Gaussians are replaced.
    count = max(counts) if len(counts) == 3 else len(like)
    for name, tensor in given.items():
        if not dr.is_tensor_v(tensor):
            raise TypeError(
                f"{name} is a {type(tensor).__module__}.{type(tensor).__name__}, expected a tensor "
                "of Dr.Jit; drjit.wrap makes them for functions of PyTorch and JAX"
            )
        columns = FIELDS[name] or like.channels
        expected = (columns,) if name == "background" else (count, columns)
        if tuple(tensor.shape) != expected or not count:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {expected}")
    return replace(like, **{name: _rows(getattr(like, name), t) for name, t in given.items()})


def _rows(like: Any, tensor: Any) -> Any:
    """Return the columns of a tensor as a nested array with the type of `like`."""
    types = types_of(like)
    number = tensor.shape[-1]
    values = types.Float(tensor.array)  # of another precision, perhaps
    index = dr.arange(types.UInt, dr.width(values) // number) * number
    return type(like)([dr.gather(types.Float, values, index + k) for k in range(number)])
