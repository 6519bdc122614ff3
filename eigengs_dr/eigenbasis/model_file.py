"""The file of an EigenGS model: contents and checks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import Gaussians
from ..image.color import BASIS_SPACES
from ..storage import npz
from ..storage.npz import Field
from .pca.basis_file import ENERGY_TOLERANCE, require_descending

FORMAT, VERSION = "eigengs_dr.model", 2

MAX_ENTRIES = 1 << 28
"""Most elements of an array: 300 components of a million Gaussians have about as many."""

MAX_WEIGHT = 1e6
"""Largest valid colour or weight; 1 is white."""

MAX_PSNR = 200.0
"""Largest valid PSNR in dB, positive or negative; no real PSNR comes near."""

LAYOUT_V1: dict[str, Field] = {
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
}
"""Arrays of a file of version 1: kind and number of dimensions."""

LAYOUT: dict[str, Field] = {
    **LAYOUT_V1,
    "variance": Field("f8", 1),
    "held_out": Field("f8", 1),
    "split_reason": Field("U", 0),
}
"""Arrays of a file; version 2 added the last three, for the truncation curve and the split."""


def write_model(path: str | os.PathLike[str], model: Any) -> None:
    """Write the file of a model, all or nothing; see `eigengs_dr.EigenGS.save`."""
    npz.write(path, FORMAT, VERSION, to_members(model))


def read_members(path: str | os.PathLike[str], backend: str | None) -> dict[str, Any]:
    """Read a file, and return the arguments of `eigengs_dr.EigenGS`; see `EigenGS.load`."""
    version = npz.read_version(path, FORMAT, VERSION)
    arrays = npz.read(path, FORMAT, VERSION, LAYOUT_V1 if version < 2 else LAYOUT)
    try:
        return from_members(arrays, backend)
    except ValueError as error:
        raise ValueError(f"{Path(path)}: {error}") from None


def to_members(model: Any) -> dict[str, NDArray[Any]]:
    """Convert a model to the arrays of its file.

    Weights are stored in half precision; each component is scaled by its largest weight. The
    rounding error is at least 60 dB below the image.

    Parameters
    ----------
    model : EigenGS

    Raises
    ------
    ValueError
        If the Gaussians have another cutoff than the default: the file does not hold it.
    """
    if model.gaussians.cutoff != CUTOFF:
        raise ValueError(f"the cutoff is {model.gaussians.cutoff}; a model is saved with {CUTOFF}")
    arrays = {key: v.astype(np.float32) for key, v in model.gaussians.to_arrays().items()}
    members: dict[str, NDArray[Any]] = {
        **arrays,
        "size": np.array([model.gaussians.width, model.gaussians.height], np.int64),
        "space": np.array(model.gaussians.space),
        "mean_image": model.mean_image.astype(np.float16),
        "split": np.array([model.low, model.low_components], np.int64),
        "split_reason": np.array(model.split_reason),
        "variance": model.variance.astype(np.float64),
        "held_out": model.held_out.astype(np.float64),
    }
    for c, (weights, values) in enumerate(zip(model.weights, model.eigenvalues, strict=True)):
        scale = np.abs(weights).max(axis=1, initial=1e-30)
        members[f"weights{c}"] = (weights / scale[:, None]).astype(np.float16)
        members[f"scale{c}"] = scale.astype(np.float32)
        members[f"eigenvalues{c}"] = values.astype(np.float64)
    return members


def from_members(arrays: dict[str, NDArray[Any]], backend: str | None) -> dict[str, Any]:
    """Check the arrays of a file and convert them to the fields of a model.

    Parameters
    ----------
    arrays : dict of str to ndarray
        Arrays with the types and dimensions of `LAYOUT` or `LAYOUT_V1`.
    backend : {"llvm", "cuda"}, optional

    Returns
    -------
    dict of str to object
        Arguments of `eigengs_dr.EigenGS`.

    Raises
    ------
    ValueError
        If an array is invalid; the message names the key and the expected value.
    """
    for key, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{key} holds values that are not finite")
    if str(arrays["space"]) not in BASIS_SPACES:
        raise ValueError(f"space is {str(arrays['space'])!r}, expected {' or '.join(BASIS_SPACES)}")
    _require("size", arrays["size"], (2,))
    gaussians = Gaussians.from_arrays(
        arrays["mean"],
        arrays["factor"],
        arrays["color"],
        arrays["background"],
        size=tuple(arrays["size"].tolist()),
        space=str(arrays["space"]),
        backend=backend,
    )
    count = len(gaussians)
    _require("color", arrays["color"], (count, 3))
    for c in range(3):
        components = len(arrays[f"weights{c}"])
        if components > gaussians.width * gaussians.height:
            raise ValueError(f"weights{c} has {components} components, more than there are pixels")
        _require(f"weights{c}", arrays[f"weights{c}"], (components, count + 1))
        _require(f"scale{c}", arrays[f"scale{c}"], (components,))
        _require(f"eigenvalues{c}", arrays[f"eigenvalues{c}"], (components,))
        require_descending(f"eigenvalues{c}", arrays[f"eigenvalues{c}"])
    _require("mean_image", arrays["mean_image"], (3, gaussians.height, gaussians.width))
    _require("split", arrays["split"], (2,))
    low, low_components = arrays["split"].tolist()
    most = max(len(arrays[f"weights{c}"]) for c in range(3))
    if not (0 <= low < count and 0 <= low_components <= most):
        raise ValueError(
            f"split is {low}, {low_components}; expected up to {count - 1} Gaussians and {most} "
            "components"
        )
    with np.errstate(over="ignore"):  # the check below refuses infinity
        weights = tuple(
            arrays[f"weights{c}"].astype(np.float32) * arrays[f"scale{c}"][:, None]
            for c in range(3)
        )
    values = {f"weights{c} times scale{c}": rows for c, rows in enumerate(weights)}
    values |= {key: arrays[key] for key in ("color", "background")}
    for name, rows in values.items():
        if not np.abs(rows).max(initial=0) <= MAX_WEIGHT:
            raise ValueError(f"{name} exceeds {MAX_WEIGHT:g}, which no image needs")
    return {
        "gaussians": gaussians,
        "weights": weights,
        "eigenvalues": tuple(arrays[f"eigenvalues{c}"] for c in range(3)),
        "mean_image": arrays["mean_image"].astype(np.float32),
        "low": low,
        "low_components": low_components,
        **_optional_members(arrays),
    }


def _optional_members(arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Check and return the fields of version 2; none for version 1."""
    if "variance" not in arrays:
        return {}
    variance, held_out = arrays["variance"], arrays["held_out"]
    if len(variance):  # empty in a model from a file of version 1
        _require("variance", variance, (3,))
    for c, total in enumerate(variance):
        if not 0 <= arrays[f"eigenvalues{c}"].sum() <= total * (1 + ENERGY_TOLERANCE):
            raise ValueError(f"eigenvalues{c} add up to more than variance {c}")
    if len(held_out):  # where images were held out
        _require("held_out", held_out, (1 + sum(len(arrays[f"scale{c}"]) for c in range(3)),))
    falls = np.diff(held_out) < -1e-9  # the logarithm rounds by less
    if falls.any() or (np.abs(held_out) > MAX_PSNR).any():
        raise ValueError(f"held_out must ascend, within {MAX_PSNR:g} dB")
    reason = str(arrays["split_reason"])
    if not (reason.isascii() and reason.isprintable()):
        raise ValueError("split_reason holds characters that are not printed; expected ASCII")
    return {"variance": variance, "held_out": held_out, "split_reason": reason}


def _require(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
