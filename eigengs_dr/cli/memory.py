"""Estimate of the memory that a fit takes, made before it starts."""

from __future__ import annotations

from pathlib import Path

from ..fitting.control import Surplus
from ..fitting.options import FitOptions
from ..image.space import YCBCR
from ..many.windows import image_size
from ..storage.memory import check_usable

BASE_BYTES = 165e6
"""Memory of Python, libLLVM and the compiled programs. This and the constants below follow the
largest resident memory of processes that fit a mosaic of photos with the backend llvm, 10 steps:

| image | channels | Gaussians | measured | estimated |
|---|---|---|---|---|
| 512x512 | 3 | 20,000 | 0.19 GB | 0.20 GB |
| 1,024x1,024 | 3 | 80,000 | 0.32 GB | 0.32 GB |
| 2,048x2,048 | 3 | 20,000 | 0.65 GB | 0.63 GB |
| 2,048x2,048 | 3 | 320,000 | 0.83 GB | 0.80 GB |
| 2,048x2,048 | 1 | 320,000 | 0.60 GB | 0.57 GB |
| 4,000x3,000 | 3 | 5,000 | 1.42 GB | 1.43 GB |
| 4,096x4,096 | 3 | 1,280,000 | 2.62 GB | 2.69 GB |"""

REPORTED_BYTES = 1_000_000_000
"""Estimated memory from which a fit reports it, in bytes."""

BYTES_PER_PIXEL = 24.0
"""Memory of the density and of the tile lists, per pixel."""

BYTES_PER_VALUE = 27.0
"""Memory of the images, per pixel and channel: nearly 7 images in single precision."""

BYTES_PER_GAUSSIAN = 600.0
"""Memory of the parameters, of the colour solve and of the lists, per Gaussian. A fit of 130,000
Gaussians on 2,048x2,048 pixels takes 65 MB more with a surplus of as many than without."""


def estimate_memory(width: int, height: int, channels: int, gaussians: int) -> int:
    """Estimate the peak memory of a process that fits one image.

    Parameters
    ----------
    width, height : int
        Size of the image in pixels.
    channels : int
    gaussians : int

    Returns
    -------
    int
        Bytes, accurate to about a sixth for sets that `eigengs_dr.fit` places. Large Gaussians
        touch more tiles and take more. The largest surplus is included, which short fits do not
        reach.
    """
    pixels = width * height
    return round(
        BASE_BYTES
        + pixels * (BYTES_PER_PIXEL + channels * BYTES_PER_VALUE)
        + Surplus().most(gaussians, pixels) * BYTES_PER_GAUSSIAN
    )


def check_memory(path: Path, settings: FitOptions, has_blocks: bool) -> str | None:
    """Check that the memory suffices for a fit, estimated from the header of the file.

    Parameters
    ----------
    path : Path or str
        Errors in the file are left to its reader.
    settings : FitOptions
    has_blocks : bool
        Whether blocks are an advice.

    Returns
    -------
    str or None
        A line with the memory, if that is large.

    Raises
    ------
    ValueError
        If this process may use less memory; the message is one line with advice.
    """
    if (size := image_size(path)) is None:
        return None
    height, width, channels = size
    pixels, channels = width * height, 3 if (settings.space or YCBCR).is_color else channels
    gaussians = (
        settings.first_try(pixels, channels) if settings.goal else settings.count_for(pixels)
    )
    needed = estimate_memory(width, height, channels, gaussians)
    what = f"{gaussians:,} Gaussians on {width}x{height} pixels"
    blocks = "fit it with --blocks 1024, " if has_blocks else ""
    advice = f"{blocks}scale the image down or use fewer Gaussians"
    check_usable(needed, f"{path}: {what}", advice)
    line = f"{what} take about {needed / 1e9:.1f} GB of memory"
    return line if needed >= REPORTED_BYTES else None
