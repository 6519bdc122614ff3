"""What the file of an EigenGS model holds, and the checks before it is believed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..gaussian.gaussians import Gaussians
from ..image.folder import BASIS_SPACES
from ..storage.npz import Field
from .basis_file import ENERGY_TOLERANCE, require_descending

FORMAT, VERSION = "eigengs_dr.model", 2

MAX_ENTRIES = 1 << 28
"""Largest array: 300 components of a million splats."""

MAX_WEIGHT = 1e6
"""Largest colour or weight that is believed; 1 is white."""

MAX_PSNR = 200.0
"""Beyond all PSNR, of good and of bad."""

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
"""What a file of version 1 holds: the kind and the number of dimensions of each array."""

LAYOUT: dict[str, Field] = {
    **LAYOUT_V1,
    "variance": Field("f8", 1),
    "held_out": Field("f8", 1),
    "split_reason": Field("U", 0),
}
"""What a file holds: since version 2 also how the error falls, and why splats are split."""


def layout_of(version: int) -> dict[str, Field]:
    """Return what a file of a version that can be read holds."""
    return LAYOUT_V1 if version < 2 else LAYOUT


def to_members(model: Any) -> dict[str, NDArray[Any]]:
    """Turn a model into the arrays of its file.

    Weights are in half precision, each component scaled by its largest weight: what rounding adds
    to an image is 60 dB and more below it.

    Parameters
    ----------
    model : EigenGS
    """
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
    """Turn the arrays of a file into the fields of a model, once all of them fit together.

    Parameters
    ----------
    arrays : dict of str to ndarray
        Of the types and dimensions of `LAYOUT`, or of `LAYOUT_V1`.
    backend : {"llvm", "cuda"}, optional

    Returns
    -------
    dict of str to object
        Arguments of `eigengs_dr.EigenGS`.

    Raises
    ------
    ValueError
        One line that names the key and what was expected.
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
            f"split is {low}, {low_components}; expected up to {count - 1} splats and {most} "
            "components"
        )
    with np.errstate(over="ignore"):  # what overflows is refused
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
    """Check what files tell since version 2; nothing of an older one."""
    if "variance" not in arrays:
        return {}
    variance, held_out = arrays["variance"], arrays["held_out"]
    if len(variance):  # unknown in a model that came from an older file
        _require("variance", variance, (3,))
    for c, total in enumerate(variance):
        if not 0 <= arrays[f"eigenvalues{c}"].sum() <= total * (1 + ENERGY_TOLERANCE):
            raise ValueError(f"eigenvalues{c} add up to more than variance {c}")
    if len(held_out):  # where images were held out
        _require("held_out", held_out, (1 + sum(len(arrays[f"scale{c}"]) for c in range(3)),))
    falls = np.diff(held_out) < -1e-9  # that much is rounding of the logarithm
    if falls.any() or (np.abs(held_out) > MAX_PSNR).any():
        raise ValueError(f"held_out must ascend, within {MAX_PSNR:g} dB")
    reason = str(arrays["split_reason"])
    if not (reason.isascii() and reason.isprintable()):
        raise ValueError("split_reason holds characters that are not printed")
    return {"variance": variance, "held_out": held_out, "split_reason": reason}


def _require(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
