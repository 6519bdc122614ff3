"""What a page knows of a set and of a model: arrays in base64, with colours decoded to RGB."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..eigenbasis.eigengs import EigenGS
from ..gaussian.file import check
from ..gaussian.gaussians import Gaussians
from ..image.color import YCBCR_TO_RGB, decode

MAX_GAUSSIANS = 1 << 20
"""Most Gaussians of a page; those of a photo take 43 bytes each."""


def check_count(count: int) -> None:
    """Raise ValueError if a page cannot show so many Gaussians."""
    if count > MAX_GAUSSIANS:
        raise ValueError(
            f"{count:,} Gaussians are too many for a page; the most is {MAX_GAUSSIANS:,}"
        )


def describe_set(gaussians: Gaussians, levels: Sequence[int] = ()) -> dict[str, Any]:
    """Return the arrays of a set for a page.

    Parameters
    ----------
    gaussians : Gaussians
    levels : sequence of int, optional
        Numbers of first Gaussians that make a whole image each, ascending.

    Raises
    ------
    ValueError
        If the set has too many Gaussians or values that are not valid, or a level is out of range.
    """
    check_count(len(gaussians))
    data = gaussians.data()
    check(data)
    marks = [int(n) for n in levels]
    if marks != sorted(set(marks)) or (marks and not 1 <= marks[0] <= marks[-1] <= len(gaussians)):
        raise ValueError(f"levels are {marks}; expected ascending numbers up to {len(gaussians)}")
    color, background = decoded(gaussians)
    return {
        "width": gaussians.width,
        "height": gaussians.height,
        "cutoff": gaussians.cutoff,
        "levels": marks,
        "mean": to_text(data.arrays["mean"]),
        "factor": to_text(data.arrays["factor"]),
        "color": to_text(color),
        "background": background.tolist(),
    }


def decoded(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the colours (N, C) and the background (C,) of a set, decoded to RGB."""
    arrays = gaussians.to_arrays()
    black = np.zeros_like(arrays["background"])
    rows = np.vstack([arrays["color"], arrays["background"], black]).astype(np.float64)
    rgb = np.stack(decode(gaussians.space, list(rows.T)), axis=1)
    return rgb[:-2] - rgb[-1], rgb[-2]


def to_text(array: NDArray[np.floating], kind: str = "<f4") -> str:
    """Return the bytes of an array in base64."""
    return b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()


LIGHTS = {"linear": 1, "radiance": 1, "log": 2, "normal": 3}
"""What sums are, by space: 1 linear light, 2 logarithms of light, 3 normals; 0 codes and data."""


def channel_views(channels: int) -> list[tuple[str, tuple[int, int, int]]]:
    """Return names and triples of channels to look at.

    Examples
    --------
    >>> channel_views(3), channel_views(2)
    ([('Colour', (0, 1, 2))], [('1', (0, 0, 0)), ('2', (1, 1, 1))])
    """
    if channels == 3:
        return [("Colour", (0, 1, 2))]
    single = [(str(c + 1), (c, c, c)) for c in range(channels)]
    return [*([("1, 2, 3 as red, green, blue", (0, 1, 2))] if channels > 3 else []), *single]


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
    space, counts = model.gaussians.space, kept_counts(model)
    channels = []
    for name, weights, values, count in zip(
        NAMES[space], model.weights, model.eigenvalues, counts, strict=True
    ):
        scales = np.abs(weights[:count]).max(axis=1, initial=0)
        scales = np.where(scales > 0, scales, 1)
        text = to_text(weights[:count] / scales[:, None], "<f2")
        deviations = np.sqrt(values[:count]).tolist()
        found = {"deviations": deviations, "scales": scales.tolist(), "weights": text}
        channels.append({"name": name, **found})
    photo = None
    if image is not None:
        color, background = decoded(model.encode(image))
        scores = [  # coefficients in standard deviations
            (own[:count] / np.sqrt(np.maximum(values[:count], np.finfo(float).tiny))).tolist()
            for own, values, count in zip(
                model.project(image), model.eigenvalues, counts, strict=True
            )
        ]
        photo = {"color": to_text(color), "background": background.tolist(), "scores": scores}
    matrix = YCBCR_TO_RGB if space == "ycbcr" else np.eye(3)
    return {"matrix": matrix.tolist(), "channels": channels, "photo": photo}


def kept_counts(model: EigenGS) -> list[int]:
    """Return how many components of each channel a page has: those with the largest variances."""
    fitting = MAX_BYTES // (2 * (len(model.gaussians) + 1))
    variances = [np.inf, *np.sort(np.concatenate(model.eigenvalues))[::-1]]
    least = variances[min(fitting, len(variances) - 1)]
    return [max(min(FEWEST, len(v)), int((v >= least).sum())) for v in model.eigenvalues]


def describe_share(model: EigenGS) -> str:
    """Return a sentence on what the page leaves out of a model; empty if it has everything."""
    counts, whole = kept_counts(model), sum(model.components)
    if sum(counts) == whole:
        return ""
    kept = sum(v[:n].sum() for v, n in zip(model.eigenvalues, counts, strict=True))
    total = sum(v.sum() for v in model.eigenvalues)
    return (
        f"A random image uses the first {sum(counts)} of {whole} components, "
        f"with {kept / total:.0%} of their variance."
    )
