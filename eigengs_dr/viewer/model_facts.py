"""What a page knows of a model: the first components, and a photo on them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.eigengs import EigenGS
from ..image.color import YCBCR_TO_RGB
from .set_facts import decoded, to_text

MAX_BYTES = 1 << 20
"""Most bytes of weights in a page, before base64; each takes 2."""

FEWEST = 8
"""Components of each channel that a page has in any case: those with a slider."""

NAMES = {
    "ycbcr": ("Brightness (Y)", "Yellow to blue (Cb)", "Green to red (Cr)"),
    "rgb": ("Red", "Green", "Blue"),
}
"""What the channels of a model are called, by its space."""


def describe_model(model: EigenGS, image: NDArray[np.float32] | None = None) -> dict[str, Any]:
    """Return the components of a model for a page.

    Parameters
    ----------
    model : EigenGS
    image : ndarray of float32, shape (H, W, 3), optional
        A photo in sRGB, to encode and to move along the components.
    """
    space = model.gaussians.space
    matrix = YCBCR_TO_RGB if space == "ycbcr" else np.eye(3)
    channels = [
        _describe_channel(name, weights[:count], values[:count])
        for name, weights, values, count in zip(
            NAMES[space], model.weights, model.eigenvalues, kept_counts(model), strict=True
        )
    ]
    photo = None if image is None else _describe_photo(model, image)
    return {"matrix": matrix.tolist(), "channels": channels, "photo": photo}


def kept_counts(model: EigenGS) -> list[int]:
    """Return how many components of each channel a page has: those with the largest variances."""
    fitting = MAX_BYTES // (2 * (len(model.gaussians) + 1))
    variances = np.sort(np.concatenate(model.eigenvalues))[::-1]
    least = (
        variances[fitting - 1] if 0 < fitting <= len(variances) else np.inf if not fitting else 0
    )
    return [max(min(FEWEST, len(v)), int((v >= least).sum())) for v in model.eigenvalues]


def describe_share(model: EigenGS) -> str:
    """Return a sentence on what the page leaves out of a model; empty if it has everything."""
    counts, whole = kept_counts(model), sum(model.components)
    if sum(counts) == whole:
        return ""
    kept = sum(float(v[:n].sum()) for v, n in zip(model.eigenvalues, counts, strict=True))
    total = sum(float(v.sum()) for v in model.eigenvalues)
    return (
        f"A random image uses the first {sum(counts)} of {whole} components, "
        f"with {kept / total:.0%} of their variance."
    )


def _describe_channel(
    name: str, weights: NDArray[np.float32], eigenvalues: NDArray[np.float64]
) -> dict[str, Any]:
    scales = np.abs(weights).max(axis=1, initial=0)
    scales = np.where(scales > 0, scales, 1)
    return {
        "name": name,
        "deviations": np.sqrt(eigenvalues).tolist(),
        "scales": scales.tolist(),
        "weights": to_text(weights / scales[:, None], "<f2"),
    }


def _describe_photo(model: EigenGS, image: NDArray[np.float32]) -> dict[str, Any]:
    """Return the best colours for a photo, and its scores: coefficients in standard deviations."""
    color, background = decoded(model.encode(image))
    scores = [
        (coefficients[:count] / np.sqrt(np.maximum(values[:count], np.finfo(float).tiny))).tolist()
        for coefficients, values, count in zip(
            model.project(image), model.eigenvalues, kept_counts(model), strict=True
        )
    ]
    return {"color": to_text(color, "<f4"), "background": background.tolist(), "scores": scores}
