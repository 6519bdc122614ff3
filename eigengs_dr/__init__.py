"""EigenGS for Dr.Jit and Mitsuba: images as sums of differentiable 2D Gaussians.

Importing the package starts no backend and sets no Mitsuba variant: what it offers is imported when
it is first used, because Dr.Jit loads libLLVM while it is imported.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .backend.selection import BackendError, prepare

if TYPE_CHECKING:
    from .codec.bit_allocation import Receipt, pack
    from .eigenbasis.basis import Eigenbasis
    from .eigenbasis.eigengs import EigenGS
    from .fitting.fit import Fit, fit
    from .fitting.levels import fit_levels, level_counts
    from .gaussian.gaussians import Gaussians, concatenate
    from .gaussian.tensors import from_tensors, to_tensors
    from .image.io import load_image, sample, save_image
    from .image.metrics import ms_ssim, psnr, ssim
    from .plugins import register_plugins
    from .raster.render import picture_of, render
    from .scene.fit_scene import fit_for_scene

__all__ = [
    "BackendError",
    "EigenGS",
    "Eigenbasis",
    "Fit",
    "Gaussians",
    "Receipt",
    "concatenate",
    "fit",
    "fit_for_scene",
    "fit_levels",
    "from_tensors",
    "level_counts",
    "load_image",
    "ms_ssim",
    "pack",
    "picture_of",
    "psnr",
    "register_plugins",
    "render",
    "sample",
    "save_image",
    "ssim",
    "to_tensors",
]

__version__ = "0.1.0"

_HOMES = {
    "eigengs": ("EigenGS",),
    "fitting": ("Fit", "fit"),
    "gaussians": ("Gaussians", "concatenate"),
    "images": ("load_image", "sample", "save_image"),
    "levels": ("fit_levels", "level_counts"),
    "metrics": ("ms_ssim", "psnr", "ssim"),
    "packing": ("Receipt", "pack"),
    "pca": ("Eigenbasis",),
    "plugins": ("register_plugins",),
    "rendering": ("picture_of", "render"),
    "scenefit": ("fit_for_scene",),
    "tensors": ("from_tensors", "to_tensors"),
}

prepare()  # before anything imports Dr.Jit, which looks for libLLVM once


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    for module, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f".{module}", __name__), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
