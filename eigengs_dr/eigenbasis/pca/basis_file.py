"""The file of an eigenbasis: contents and checks."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...backend.types import Record
from ...image.space import FAMILY_SPACES
from ...storage import npz

if TYPE_CHECKING:
    from .basis import Eigenbasis

FORMAT, VERSION = "eigengs_dr.eigenbasis", 2

ENERGY_TOLERANCE = 1e-5
"""Relative tolerance between the sum of the eigenvalues and the variance."""

MAX_ENTRIES = 1 << 28
"""Largest number of elements of the mean image."""

LAYOUT: dict[str, npz.Field] = {
    "mean": npz.Field("f4", 3, MAX_ENTRIES),
    "variance": npz.Field("f8", 1),
    "count": npz.Field("i8", 0),
    "space": npz.Field("U", 0),
    **{f"eigenvalues{c}": npz.Field("f8", 1) for c in range(3)},
}
"""Arrays of a file, except the components, whose shapes follow from these."""


def write_basis(path: str | os.PathLike[str], basis: Eigenbasis) -> None:
    """Write an `eigengs_dr.Eigenbasis` atomically; see its `save`."""
    fields = ("mean", "variance", "count", "space")
    arrays = {name: np.asarray(getattr(basis, name)) for name in fields}
    for c, pair in enumerate(zip(basis.components, basis.eigenvalues, strict=True)):
        arrays[f"components{c}"], arrays[f"eigenvalues{c}"] = pair
    npz.write(path, FORMAT, VERSION, arrays, compressed=False)


def read_basis(path: str | os.PathLike[str]) -> Record:
    """Read the fields of an `eigengs_dr.Eigenbasis`; see its `load`."""
    head = npz.read(path, FORMAT, VERSION, LAYOUT)
    height, width = head["mean"].shape[1:]
    counts = [len(head[f"eigenvalues{c}"]) for c in range(3)]
    shapes = {"mean": (3, max(1, height), max(1, width)), "variance": (3,)}
    components = {f"components{c}": (k, height, width) for c, k in enumerate(counts)}
    layout = {key: npz.Field("f4", 3, math.prod(shape)) for key, shape in components.items()}
    try:
        check_arrays(head, shapes)
        if head["count"] < 1:
            raise npz.BadValue(f"count is {head['count']}, expected at least 1")
        arrays = npz.read(path, FORMAT, VERSION, layout)
        check_arrays(arrays | head, components)
    except npz.BadValue as error:
        raise ValueError(f"{Path(path)}: {error}") from None
    eigenvalues = tuple(head.pop(f"eigenvalues{c}") for c in range(3))
    numbers = {"count": int(head["count"]), "space": str(head["space"])}
    return {**head, **numbers, "components": tuple(arrays.values()), "eigenvalues": eigenvalues}


def check_arrays(arrays: Mapping[str, NDArray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise `npz.BadValue` unless arrays of a basis or a model are valid.

    They must be finite and have these shapes. Eigenvalues must descend, and match the variance.
    """
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise npz.BadValue(f"{name} holds values that are not finite")
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise npz.BadValue(f"{name} has shape {arrays[name].shape}, expected {shape}")
    if arrays["space"] not in FAMILY_SPACES:
        known = ", ".join(FAMILY_SPACES)
        raise npz.BadValue(f"space is {str(arrays['space'])!r}, expected one of {known}")
    pixels = arrays.get("mean_image", arrays["mean"])[0].size
    for c in range(3):
        values = arrays[f"eigenvalues{c}"]
        if len(values) > pixels:
            raise npz.BadValue(f"eigenvalues{c} has {len(values)} values, more than pixels")
        if (values < 0).any() or (np.diff(values) > 0).any():
            raise npz.BadValue(f"eigenvalues{c} must descend and not be negative")
        # A model may have no variance.
        total = arrays["variance"][c] if len(arrays["variance"]) else np.inf
        if values.sum() > total * (1 + ENERGY_TOLERANCE):
            raise npz.BadValue(f"eigenvalues{c} add up to more than variance {c}")
