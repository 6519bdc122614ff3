"""The file of an eigenbasis: contents and checks."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...image.color import BASIS_SPACES
from ...storage import npz
from .incremental import EXAMPLES

FORMAT, VERSION = "eigengs_dr.eigenbasis", 1

ENERGY_TOLERANCE = 1e-5
"""Relative tolerance between the sum of the eigenvalues and the variance."""

MAX_ENTRIES = 1 << 28
"""Most elements of an array: 16 examples of 2,000x2,000 pixels have fewer."""

LAYOUT: dict[str, npz.Field] = {
    "mean": npz.Field("f4", 3, MAX_ENTRIES),
    "variance": npz.Field("f8", 1),
    "count": npz.Field("i8", 0),
    "space": npz.Field("U", 0),
    "examples": npz.Field("f4", 4, MAX_ENTRIES),
    **{f"eigenvalues{c}": npz.Field("f8", 1) for c in range(3)},
}
"""Arrays of a file, except the components, whose shapes follow from these."""


def write_basis(path: str | os.PathLike[str], basis: Any) -> None:
    """Write an `eigengs_dr.Eigenbasis`, all or nothing; see its `save`."""
    arrays: dict[str, NDArray[Any]] = {
        "mean": basis.mean,
        "variance": basis.variance,
        "count": np.array(basis.count),
        "space": np.array(basis.space),
        "examples": basis.examples,
    }
    for c, pair in enumerate(zip(basis.components, basis.eigenvalues, strict=True)):
        arrays[f"components{c}"], arrays[f"eigenvalues{c}"] = pair
    npz.write(path, FORMAT, VERSION, arrays, compressed=False)


def read_basis(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the fields of an `eigengs_dr.Eigenbasis`; see its `load`."""
    path = Path(path)
    head = npz.read(path, FORMAT, VERSION, LAYOUT)
    try:
        _check(head)
        values = tuple(head.pop(f"eigenvalues{c}") for c in range(3))
        components = _components(path, values, head["mean"].shape)
    except npz.BadValue as error:
        raise ValueError(f"{path}: {error}") from None
    return {
        **head,
        "count": int(head["count"]),
        "space": str(head["space"]),
        "components": components,
        "eigenvalues": values,
    }


def _check(head: dict[str, NDArray[Any]]) -> None:
    """Raise `npz.BadValue` unless the arrays of a file make a basis."""
    mean, variance, examples = head["mean"], head["variance"], head["examples"]
    if len(mean) != 3 or 0 in mean.shape:
        raise npz.BadValue(f"mean has shape {mean.shape}, expected (3, H, W)")
    if variance.shape != (3,):
        raise npz.BadValue(f"variance has shape {variance.shape}, expected (3,)")
    if examples.shape[1:] != (*mean.shape[1:], 3) or len(examples) > EXAMPLES:
        expected = f"(n, {mean.shape[1]}, {mean.shape[2]}, 3) with n <= {EXAMPLES}"
        raise npz.BadValue(f"examples has shape {examples.shape}, expected {expected}")
    for name, array in head.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise npz.BadValue(f"{name} holds values that are not finite")
    for c in range(3):
        values = head[f"eigenvalues{c}"]
        require_descending(f"eigenvalues{c}", values)
        if len(values) > mean[0].size:
            raise npz.BadValue(f"eigenvalues{c} has {len(values)} values, more than pixels")
        if values.sum() > variance[c] * (1 + ENERGY_TOLERANCE):
            raise npz.BadValue(f"eigenvalues{c} add up to more than variance {c}")
    if head["count"] < 1:
        raise npz.BadValue(f"count is {head['count']}, expected at least 1")
    if head["space"] not in BASIS_SPACES:
        raise npz.BadValue(f"space is '{head['space']}', expected one of {', '.join(BASIS_SPACES)}")


def require_descending(name: str, values: NDArray[np.float64]) -> None:
    """Raise `npz.BadValue` unless eigenvalues descend and are not negative."""
    if (values < 0).any() or (np.diff(values) > 0).any():
        raise npz.BadValue(f"{name} must descend and not be negative")


def _components(
    path: Path, eigenvalues: Sequence[NDArray[np.float64]], shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], ...]:
    """Read one component for each eigenvalue of each channel."""
    shapes = {f"components{c}": (len(e), *shape[1:]) for c, e in enumerate(eigenvalues)}
    layout = {key: npz.Field("f4", 3, math.prod(s)) for key, s in shapes.items()}
    arrays = npz.read(path, FORMAT, VERSION, layout)
    for key, expected in shapes.items():
        if arrays[key].shape != expected:
            raise npz.BadValue(f"{key} has shape {arrays[key].shape}, expected {expected}")
        if not np.isfinite(arrays[key]).all():
            raise npz.BadValue(f"{key} holds values that are not finite")
    return tuple(arrays.values())
