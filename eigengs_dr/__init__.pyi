"""The public names of eigengs_dr; the package and type checkers read this file."""

from . import paper as paper
from . import plugins as plugins
from .backend.interrupts import Interrupted as Interrupted
from .backend.recording import exclusive as exclusive
from .backend.selection import BackendError as BackendError
from .cluster import ClusterError as ClusterError
from .eigenbasis.basis import Eigenbasis as Eigenbasis
from .eigenbasis.eigengs import EigenGS as EigenGS
from .fitting.coarse import COARSE_TO_FINE as COARSE_TO_FINE
from .fitting.coarse import Coarse as Coarse
from .fitting.fit import Fit as Fit
from .fitting.fit import fit as fit
from .fitting.loss import Loss as Loss
from .fitting.method import DEFAULT as DEFAULT
from .fitting.method import Method as Method
from .fitting.options import Goal as Goal
from .fitting.options import level_counts as level_counts
from .fitting.problem import Map as Map
from .gaussian.gaussians import Gaussians as Gaussians
from .gaussian.gaussians import concatenate as concatenate
from .gaussian.gaussians import from_tensors as from_tensors
from .gaussian.gaussians import to_tensors as to_tensors
from .image.io import load_image as load_image
from .image.io import sample as sample
from .image.io import save_image as save_image
from .image.metrics import ms_ssim as ms_ssim
from .image.metrics import psnr as psnr
from .image.metrics import ssim as ssim
from .image.pixels import ImageError as ImageError
from .many.fit_large import LargeFit as LargeFit
from .many.fit_large import fit_large as fit_large
from .many.fit_many import fit_many as fit_many
from .many.images import ImageRow as ImageRow
from .packing.pack import load as load
from .packing.pack import pack as pack
from .plugins import register_plugins as register_plugins
from .raster.render import picture_of as picture_of
from .raster.render import render as render
from .raster.render import tile_lists as tile_lists
from .relight.model import Relightable as Relightable
from .scene.fit_scene import fit_for_scene as fit_for_scene
from .version import __version__ as __version__
from .viewer.view import to_html as to_html
from .viewer.view import view as view

__all__ = [
    "COARSE_TO_FINE",
    "DEFAULT",
    "BackendError",
    "ClusterError",
    "Coarse",
    "EigenGS",
    "Eigenbasis",
    "Fit",
    "Gaussians",
    "Goal",
    "ImageError",
    "ImageRow",
    "Interrupted",
    "LargeFit",
    "Loss",
    "Map",
    "Method",
    "Relightable",
    "concatenate",
    "exclusive",
    "fit",
    "fit_for_scene",
    "fit_large",
    "fit_many",
    "from_tensors",
    "level_counts",
    "load",
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
    "to_html",
    "to_tensors",
    "view",
]
