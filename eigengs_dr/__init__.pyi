"""The public names of eigengs_dr; `lazy_loader` and type checkers read this file."""

from . import paper as paper
from . import plugins as plugins
from .backend.executor import ClusterError
from .backend.interrupts import Interrupted
from .backend.recording import exclusive
from .backend.selection import BackendError
from .codec.packing import pack
from .eigenbasis.eigengs import EigenGS
from .eigenbasis.pca.basis import Eigenbasis
from .fitting.coarse import COARSE_TO_FINE, Coarse
from .fitting.fit import Fit, FitInterrupted, fit
from .fitting.loss import Loss
from .fitting.maps import Map
from .fitting.method import DEFAULT, Method
from .fitting.options import Goal, level_counts
from .gaussian.gaussians import Gaussians, concatenate, from_tensors, to_tensors
from .image.io import load_image, sample, save_image
from .image.metrics import ms_ssim, psnr, ssim
from .image.pixels import ImageError
from .many.fit_large import LargeFit, fit_large
from .many.fit_many import fit_many
from .many.manifest import ImageRow
from .plugins import register_plugins
from .raster.render import picture_of, render, tile_lists
from .scene.convert import convert_scene
from .scene.fit_scene import fit_for_scene
from .version import __version__ as __version__
from .viewer.view import view

__all__ = [
    "COARSE_TO_FINE",
    "DEFAULT",
    "BackendError",
    "ClusterError",
    "Coarse",
    "EigenGS",
    "Eigenbasis",
    "Fit",
    "FitInterrupted",
    "Gaussians",
    "Goal",
    "ImageError",
    "ImageRow",
    "Interrupted",
    "LargeFit",
    "Loss",
    "Map",
    "Method",
    "concatenate",
    "convert_scene",
    "exclusive",
    "fit",
    "fit_for_scene",
    "fit_large",
    "fit_many",
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
    "tile_lists",
    "to_tensors",
    "view",
]
