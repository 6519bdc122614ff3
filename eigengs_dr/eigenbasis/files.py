"""The files of a basis and of a model: contents and checks."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..backend.types import Arrays, Record, Singles
from ..gaussian.file import CUTOFF, SetData, check, check_suffix
from ..gaussian.gaussians import Gaussians
from ..image.space import FAMILY_SPACES, space_of
from ..storage import npz
from ..storage.npz import BadValue, Field, check_values, file_errors

BASIS_FORMAT, BASIS_VERSION = "eigengs_dr.eigenbasis", 2

MODEL_FORMAT, MODEL_VERSION = "eigengs_dr.model", 3

MAX_ENTRIES = 1 << 28
"""Largest number of elements of the mean image, and of an array of a model: 300 components of a
million Gaussians need about this."""

ENERGY_TOLERANCE = 1e-5
"""Relative tolerance between the sum of the eigenvalues and the variance."""

MAX_WEIGHT = 1e6
"""Largest valid colour or weight; 1 is white."""

MAX_PSNR = 200.0
"""Largest valid absolute PSNR in dB, far above any actual PSNR."""

FAMILY_LAYOUT: dict[str, Field] = {
    "space": Field("U", 0),
    "variance": Field("f8", 1),
    **{f"eigenvalues{c}": Field("f8", 1) for c in range(3)},
}
"""Arrays of both files."""

BASIS_LAYOUT = FAMILY_LAYOUT | {"mean": Field("f4", 3, MAX_ENTRIES), "count": Field("i8", 0)}
"""Arrays of a basis, except the components, whose shapes follow from these."""

MODEL_LAYOUT = FAMILY_LAYOUT | {
    "mean": Field("f4", 2),
    "factor": Field("f4", 2),
    "color": Field("f4", 2),
    "background": Field("f4", 1),
    "size": Field("i8", 1),
    "mean_image": Field("f2", 3, MAX_ENTRIES),
    "split": Field("i8", 1),
    "held_out": Field("f8", 1),
    **{f"weights{c}": Field("f2", 2, MAX_ENTRIES) for c in range(3)},
    **{f"scale{c}": Field("f4", 1) for c in range(3)},
}
"""Arrays of a model."""


def write_basis(path: str | os.PathLike[str], fields: Record) -> None:
    """Write the fields of an `eigengs_dr.Eigenbasis` atomically; see its `save`."""
    check_suffix(path)
    arrays = {name: np.asarray(fields[name]) for name in ("mean", "variance", "count", "space")}
    pairs = zip(fields["components"], fields["eigenvalues"], strict=True)
    for c, (components, eigenvalues) in enumerate(pairs):
        arrays |= {f"components{c}": components, f"eigenvalues{c}": eigenvalues}
    npz.write(path, BASIS_FORMAT, BASIS_VERSION, arrays, compressed=False)


def read_basis(path: str | os.PathLike[str]) -> Record:
    """Read the fields of an `eigengs_dr.Eigenbasis`; see its `load`."""
    head = npz.read(path, BASIS_FORMAT, BASIS_VERSION, BASIS_LAYOUT)
    height, width = head["mean"].shape[1:]
    shapes = {"mean": (3, max(1, height), max(1, width)), "variance": (3,)}
    components = {f"components{c}": (len(head[f"eigenvalues{c}"]), height, width) for c in range(3)}
    layout = {key: Field("f4", 3, math.prod(shape)) for key, shape in components.items()}
    with file_errors(path):
        check_arrays(head, shapes)
        if head["count"] < 1:
            raise BadValue(f"count is {head['count']}, expected at least 1")
        arrays = npz.read(path, BASIS_FORMAT, BASIS_VERSION, layout)
        check_arrays(arrays | head, components)
    return {
        "mean": head["mean"],
        "components": tuple(arrays.values()),
        "eigenvalues": _channels(head, "eigenvalues"),
        "variance": head["variance"],
        "count": int(head["count"]),
        "space": str(head["space"]),
    }


def write_model(path: str | os.PathLike[str], fields: Record) -> None:
    """Write the fields of an `eigengs_dr.EigenGS` atomically; see its `save`."""
    check_suffix(path)
    arrays = model_arrays(fields)
    with file_errors(path):
        check_model(arrays)
    npz.write(path, MODEL_FORMAT, MODEL_VERSION, arrays)


def read_model(path: str | os.PathLike[str], backend: str | None) -> Record:
    """Read the fields of an `eigengs_dr.EigenGS`; see its `load`."""
    arrays = npz.read(path, MODEL_FORMAT, MODEL_VERSION, MODEL_LAYOUT)
    with file_errors(path):
        weights = check_model(arrays)
    low, low_components = arrays["split"].tolist()
    return {
        "gaussians": Gaussians.from_data(_set_of(arrays), backend),
        "weights": weights,
        "eigenvalues": _channels(arrays, "eigenvalues"),
        "mean_image": arrays["mean_image"].astype(np.float32),
        "low": low,
        "low_components": low_components,
        "variance": arrays["variance"],
        "held_out": arrays["held_out"],
    }


def model_arrays(fields: Record) -> Arrays:
    """Convert the fields of a model to the arrays of its file.

    Weights are stored in half precision, with each component scaled by its largest weight. The
    rounding error is at least 60 dB below the image.

    Raises
    ------
    ValueError
        If the Gaussians do not have the default cutoff, because the file does not store it.
    """
    gaussians: Gaussians = fields["gaussians"]
    if gaussians.cutoff != CUTOFF:
        raise ValueError(
            f"the cutoff is {gaussians.cutoff}; a model can only be saved with {CUTOFF}"
        )
    arrays: Arrays = {
        **{key: values.astype(np.float32) for key, values in gaussians.to_arrays().items()},
        "size": np.array([gaussians.width, gaussians.height], np.int64),
        "space": np.array(gaussians.space),
        "mean_image": fields["mean_image"].astype(np.float16),
        "split": np.array([fields["low"], fields["low_components"]], np.int64),
        "variance": fields["variance"].astype(np.float64),
        "held_out": fields["held_out"].astype(np.float64),
    }
    pairs = zip(fields["weights"], fields["eigenvalues"], strict=True)
    for c, (weights, values) in enumerate(pairs):
        scale = np.abs(weights).max(axis=1, initial=1e-30)
        arrays[f"weights{c}"] = (weights / scale[:, None]).astype(np.float16)
        arrays[f"scale{c}"] = scale.astype(np.float32)
        arrays[f"eigenvalues{c}"] = values.astype(np.float64)
    return arrays


def check_model(arrays: Arrays) -> tuple[Singles, ...]:
    """Check the arrays of a model, and return the weights of each channel.

    Raises
    ------
    BadValue
        If an array is invalid; the message names the key and the expected value.
    """
    counts = [len(rows) for rows in _channels(arrays, "weights")]
    number, size = len(arrays["mean"]), tuple(arrays["size"].tolist())
    variance, held_out = arrays["variance"], arrays["held_out"]
    shapes: dict[str, tuple[int, ...]] = {
        "size": (2,),
        "mean_image": (3, *size[::-1]),
        "color": (number, 3),
        "split": (2,),
    }
    for c, k in enumerate(counts):
        shapes |= {f"weights{c}": (k, number + 1), f"scale{c}": (k,), f"eigenvalues{c}": (k,)}
    if len(variance):
        shapes["variance"] = (3,)
    if len(held_out):
        shapes["held_out"] = (1 + sum(counts),)
    check_arrays(arrays, shapes)
    low, low_components = arrays["split"].tolist()
    if not (0 <= low < number and 0 <= low_components <= max(counts)):
        raise BadValue(
            f"split is {low}, {low_components}; expected up to {number - 1} Gaussians and "
            f"{max(counts)} components"
        )
    descends = np.diff(held_out) < -1e-9  # rounding of the logarithm is smaller
    if descends.any() or (np.abs(held_out) > MAX_PSNR).any():
        raise BadValue(f"held_out must ascend, within {MAX_PSNR:g} dB")
    check(_set_of(arrays))
    pairs = zip(_channels(arrays, "weights"), _channels(arrays, "scale"), strict=True)
    with np.errstate(over="ignore"):  # the check below rejects infinity
        weights = tuple(rows.astype(np.float32) * scale[:, None] for rows, scale in pairs)
    values = {f"weights{c} times scale{c}": rows for c, rows in enumerate(weights)}
    values |= {key: arrays[key] for key in ("color", "background")}
    for name, rows in values.items():
        if not np.abs(rows).max(initial=0) <= MAX_WEIGHT:
            raise BadValue(f"{name} exceeds the limit of {MAX_WEIGHT:g}")
    return weights


def check_arrays(arrays: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise `BadValue` unless arrays of a basis or a model are valid.

    They must be finite and have these shapes. Eigenvalues must descend, and match the variance.
    """
    check_values(arrays, shapes)
    if arrays["space"] not in FAMILY_SPACES:
        known = ", ".join(FAMILY_SPACES)
        raise BadValue(f"space is {str(arrays['space'])!r}, expected one of {known}")
    pixels = arrays.get("mean_image", arrays["mean"])[0].size
    # A model may have no variance.
    totals = arrays["variance"] if len(arrays["variance"]) else np.full(3, np.inf)
    for c, (values, total) in enumerate(zip(_channels(arrays, "eigenvalues"), totals, strict=True)):
        if len(values) > pixels:
            raise BadValue(f"eigenvalues{c} has {len(values)} values, more than pixels")
        if (values < 0).any() or (np.diff(values) > 0).any():
            raise BadValue(f"eigenvalues{c} must descend and not be negative")
        if values.sum() > total * (1 + ENERGY_TOLERANCE):
            raise BadValue(f"eigenvalues{c} add up to more than variance {c}")


def _channels(arrays: Arrays, name: str) -> tuple[NDArray, ...]:
    """Return the arrays of a name, of all channels."""
    return tuple(arrays[f"{name}{c}"] for c in range(3))


def _set_of(arrays: Arrays) -> SetData:
    """Return the set that the arrays of a model hold."""
    parts = {key: arrays[key] for key in ("mean", "factor", "color", "background")}
    return SetData(parts, tuple(arrays["size"].tolist()), space_of(str(arrays["space"])))
