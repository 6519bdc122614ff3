"""A set of Gaussians as Dr.Jit tensors and back: what optimisers and other frameworks hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import drjit as dr

from ..backend.arrays import types_of
from .gaussians import Gaussians

FIELDS = {"mean": 2, "factor": 3, "color": 0, "background": 0}
"""Parameters of a set, with their columns; 0 stands for the number of channels."""


def to_tensors(gaussians: Gaussians) -> dict[str, Any]:
    """Write the parameters of a set as tensors, differentiably.

    Parameters
    ----------
    gaussians : Gaussians

    Returns
    -------
    dict of str to TensorXf
        mean (N, 2), factor (N, 3), color (N, C) and background (C,), as `Gaussians.from_arrays`
        takes them.

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


def from_tensors(tensors: Mapping[str, Any], like: Gaussians) -> Gaussians:
    """Make a set of tensors, differentiably: the inverse of `to_tensors`.

    Parameters
    ----------
    tensors : mapping of str to TensorXf
        Any of mean, factor, color and background, shaped as `to_tensors` returns them; other keys
        are ignored.
    like : Gaussians
        Gives the size, the space and the parameters that `tensors` lacks.

    Returns
    -------
    Gaussians
        Values are not checked: see `Gaussians.bounded`.

    Raises
    ------
    ValueError
        If shapes do not fit each other.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> brighter = eg.from_tensors({"color": 2 * eg.to_tensors(g)["color"]}, like=g)
    """
    given = {name: tensors[name] for name in FIELDS if name in tensors}
    counts = [given[name].shape[0] for name in ("mean", "factor", "color") if name in given]
    # Splats may be more or fewer than in `like` where nothing of it is left.
    count = max(counts) if len(counts) == 3 else len(like)
    for name, tensor in given.items():
        columns = FIELDS[name] or like.channels
        expected = (columns,) if name == "background" else (count, columns)
        if tuple(tensor.shape) != expected or not count:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {expected}")
    return replace(like, **{name: _rows(getattr(like, name), t) for name, t in given.items()})


def _rows(like: Any, tensor: Any) -> Any:
    """Columns of a tensor as an array of arrays of the type of `like`."""
    types = types_of(like)
    number = tensor.shape[-1]
    index = dr.arange(types.UInt, dr.width(tensor.array) // number) * number
    return type(like)([dr.gather(types.Float, tensor.array, index + k) for k in range(number)])
