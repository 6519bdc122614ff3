"""The file of an EigenGS model: contents and checks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..backend.types import Record
from ..gaussian.file import CUTOFF, SetData, check
from ..gaussian.gaussians import Gaussians
from ..image.space import space_of
from ..storage import npz
from ..storage.npz import Field
from .pca.basis_file import check_arrays

if TYPE_CHECKING:
    from .eigengs import EigenGS

FORMAT, VERSION = "eigengs_dr.model", 3

MAX_ENTRIES = 1 << 28
"""Largest number of elements of an array: 300 components of a million Gaussians need about this."""

MAX_WEIGHT = 1e6
"""Largest valid colour or weight; 1 is white."""

MAX_PSNR = 200.0
"""Largest valid absolute PSNR in dB, far above any actual PSNR."""

LAYOUT: dict[str, Field] = {
    "mean": Field("f4", 2),
    "factor": Field("f4", 2),
    "color": Field("f4", 2),
    "background": Field("f4", 1),
    "size": Field("i8", 1),
    "space": Field("U", 0),
    "mean_image": Field("f2", 3, MAX_ENTRIES),
    "split": Field("i8", 1),
    **{f"weights{c}": Field("f2", 2, MAX_ENTRIES) for c in range(3)},
    **{f"scale{c}": Field("f4", 1) for c in range(3)},
    **{f"eigenvalues{c}": Field("f8", 1) for c in range(3)},
    "variance": Field("f8", 1),
    "held_out": Field("f8", 1),
}
"""Arrays of a file, with their types and numbers of dimensions."""


def write_model(path: str | os.PathLike[str], model: EigenGS) -> None:
    """Write the file of a model atomically; see `eigengs_dr.EigenGS.save`."""
    members = to_members(model)
    try:
        check_members(members)
    except ValueError as error:
        raise ValueError(f"{Path(path)}: {error}") from None
    npz.write(path, FORMAT, VERSION, members)


def read_members(path: str | os.PathLike[str], backend: str | None) -> Record:
    """Read a file, and return the arguments of `eigengs_dr.EigenGS`; see `EigenGS.load`."""
    arrays = npz.read(path, FORMAT, VERSION, LAYOUT)
    try:
        return from_members(arrays, backend)
    except ValueError as error:
        raise ValueError(f"{Path(path)}: {error}") from None


def to_members(model: EigenGS) -> dict[str, NDArray]:
    """Convert a model to the arrays of its file.

    Weights are stored in half precision, with each component scaled by its largest weight. The
    rounding error is at least 60 dB below the image.

    Raises
    ------
    ValueError
        If the Gaussians do not have the default cutoff, because the file does not store it.
    """
    if model.gaussians.cutoff != CUTOFF:
        raise ValueError(
            f"the cutoff is {model.gaussians.cutoff}; a model can only be saved with {CUTOFF}"
        )
    arrays = {key: v.astype(np.float32) for key, v in model.gaussians.to_arrays().items()}
    members: dict[str, NDArray] = {
        **arrays,
        "size": np.array([model.gaussians.width, model.gaussians.height], np.int64),
        "space": np.array(model.gaussians.space),
        "mean_image": model.mean_image.astype(np.float16),
        "split": np.array([model.low, model.low_components], np.int64),
        "variance": model.variance.astype(np.float64),
        "held_out": model.held_out.astype(np.float64),
    }
    for c, (weights, values) in enumerate(zip(model.weights, model.eigenvalues, strict=True)):
        scale = np.abs(weights).max(axis=1, initial=1e-30)
        members[f"weights{c}"] = (weights / scale[:, None]).astype(np.float16)
        members[f"scale{c}"] = scale.astype(np.float32)
        members[f"eigenvalues{c}"] = values.astype(np.float64)
    return members


def from_members(arrays: dict[str, NDArray], backend: str | None) -> Record:
    """Check the arrays of a file, and convert them to the arguments of `eigengs_dr.EigenGS`.

    Errors as for `check_members`.
    """
    weights = check_members(arrays)
    low, low_components = arrays["split"].tolist()
    return {
        "gaussians": Gaussians.from_data(_set_of(arrays), backend),
        "weights": weights,
        "eigenvalues": tuple(arrays[f"eigenvalues{c}"] for c in range(3)),
        "mean_image": arrays["mean_image"].astype(np.float32),
        "low": low,
        "low_components": low_components,
        "variance": arrays["variance"],
        "held_out": arrays["held_out"],
    }


def _set_of(arrays: dict[str, NDArray]) -> SetData:
    """Return the set that the arrays of a file hold."""
    parts = {key: arrays[key] for key in ("mean", "factor", "color", "background")}
    return SetData(parts, tuple(arrays["size"].tolist()), space_of(str(arrays["space"])))


def check_members(arrays: dict[str, NDArray]) -> tuple[NDArray[np.float32], ...]:
    """Check the arrays of a file, and return the weights of each channel.

    Raises
    ------
    ValueError
        If an array is invalid; the message names the key and the expected value.
    """
    counts = [len(arrays[f"weights{c}"]) for c in range(3)]
    number, size = len(arrays["mean"]), tuple(arrays["size"].tolist())
    shapes: dict[str, tuple[int, ...]] = {
        "size": (2,),
        "mean_image": (3, *size[::-1]),
        "color": (number, 3),
        "split": (2,),
    }
    for c, k in enumerate(counts):
        columns = {f"weights{c}": (k, number + 1), f"scale{c}": (k,), f"eigenvalues{c}": (k,)}
        shapes |= columns
    variance, held_out = (arrays[key] for key in ("variance", "held_out"))
    if len(variance):
        shapes["variance"] = (3,)
    if len(held_out):
        shapes["held_out"] = (1 + sum(counts),)
    check_arrays(arrays, shapes)
    low, low_components = arrays["split"].tolist()
    if not (0 <= low < number and 0 <= low_components <= max(counts)):
        raise ValueError(
            f"split is {low}, {low_components}; expected up to {number - 1} Gaussians and "
            f"{max(counts)} components"
        )
    descends = np.diff(held_out) < -1e-9  # rounding of the logarithm is smaller
    if descends.any() or (np.abs(held_out) > MAX_PSNR).any():
        raise ValueError(f"held_out must ascend, within {MAX_PSNR:g} dB")
    check(_set_of(arrays))
    with np.errstate(over="ignore"):  # the check below rejects infinity
        weights = tuple(
            arrays[f"weights{c}"].astype(np.float32) * arrays[f"scale{c}"][:, None]
            for c in range(3)
        )
    values = {f"weights{c} times scale{c}": rows for c, rows in enumerate(weights)}
    values |= {key: arrays[key] for key in ("color", "background")}
    for name, rows in values.items():
        if not np.abs(rows).max(initial=0) <= MAX_WEIGHT:
            raise ValueError(f"{name} exceeds the limit of {MAX_WEIGHT:g}")
    return weights
