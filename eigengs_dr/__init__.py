"""EigenGS for Dr.Jit and Mitsuba: images as sums of differentiable 2D Gaussians.

Importing the package starts no backend and sets no Mitsuba variant.
"""

from .backend import BackendError, prepare

prepare()  # before anything imports Dr.Jit, which looks for libLLVM once

from .gaussians import Gaussians, concatenate  # noqa: E402
from .images import load_image, sample, save_image  # noqa: E402
from .metrics import ms_ssim, psnr, ssim  # noqa: E402
from .rendering import render  # noqa: E402

__all__ = [
    "BackendError",
    "Gaussians",
    "concatenate",
    "load_image",
    "ms_ssim",
    "psnr",
    "render",
    "sample",
    "save_image",
    "ssim",
]

__version__ = "0.1.0"
