"""How close one lookup comes to the mean over a pixel: the prefilter beside mip maps."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from skimage.transform import downscale_local_mean

from eigengs_bench.harness.store import Progress, Row
from eigengs_bench.harness.timing import Image
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.fit import fit
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.color import to_coded
from eigengs_dr.plugins import register_plugins, texture_of
from eigengs_dr.raster.render import render

TEXTURES = ("brick", "grass", "gravel", "astronaut")  # photos of scikit-image, 512 x 512 pixels
# Texels across a pixel, and how many times longer the pixel is along the slant of the surface.
PIXELS = ((1, 1), (4, 1), (16, 1), (1, 4), (1, 16), (4, 4), (4, 16))
TAPS = 16  # most lookups of the anisotropic filter, as graphics cards have
GAUSSIANS, STEPS = 20_000, 200  # of the fits
LOOKUPS = 8192  # pixels, at random positions and directions
SUBPIXELS = 8  # lookups of the reference along the short side of a pixel
ANGLE = 0.01  # of a pixel in radians; it is small, and cancels out

Floats = NDArray[np.float64]


class Pixels(NamedTuple):
    """Pixels on a texture: position of a sample (n, 2), sides as columns (n, 2, 2), in texels.

    The first side is `slant` times `texels` long, the second one `texels`.
    """

    sample: Floats
    sides: Floats
    texels: float
    slant: float


def run(images: Mapping[str, Image], progress: Progress = lambda *_: None) -> list[Row]:
    """Return a row a kind of pixel: the PSNR (RGB) of one lookup a pixel, over all images.

    Images are squares whose side is a power of two. Samples lie anywhere in their pixels, as those
    of a renderer. The truth is the mean of the Gaussians over the pixel; the mip map holds the
    rendered Gaussians.
    """
    mi.set_variant("cuda_ad_rgb" if "cuda" in select().__name__ else "llvm_ad_rgb")
    register_plugins()
    rows: list[Row] = [{"texels": texels, "slant": slant} for texels, slant in PIXELS]
    errors = []
    for done, (name, image) in enumerate(images.items()):
        side = len(image)
        if image.shape[1] != side or side & (side - 1):
            raise ValueError(f"{name}: {image.shape[1]}x{side} pixels; use a square of 2^n pixels")
        errors.append(_errors(fit(image, GAUSSIANS, STEPS, space="linear").gaussians))
        progress("images", done + 1, len(images))
    for row, *each in zip(rows, *errors, strict=True):
        for method in each[0]:
            row[method] = -10 * math.log10(np.mean([error[method] for error in each]))
    return rows


def _errors(gaussians: Gaussians) -> list[dict[str, float]]:
    """Return mean squared errors by method, for each kind of pixel."""
    side = gaussians.width
    levels = mip_map(render(gaussians).numpy().clip(0, 1))
    points, filtered = (
        mi.load_dict(texture_of(gaussians, wrap_mode="mirror", prefilter=angle))
        for angle in (0.0, ANGLE)
    )
    rows = []
    for texels, slant in PIXELS:
        seen = some_pixels(side, texels, slant)
        truth = to_coded(mean_over(partial(look, points, side), seen))
        found = {
            "point": look(points, side, seen.sample),
            "trilinear": trilinear(levels, seen),
            "anisotropic": trilinear(levels, seen, TAPS),
            "prefilter": look(filtered, side, seen.sample, seen),
        }
        rows.append(
            {
                method: float(np.square(to_coded(values.clip(0, 1)) - truth).mean())
                for method, values in found.items()
            }
        )
    return rows


def some_pixels(side: int, texels: float, slant: float) -> Pixels:
    """Draw pixels at random places and directions, and a sample in each."""
    rng = np.random.default_rng(0)
    turn = rng.uniform(0, math.pi, LOOKUPS)
    along = np.stack([np.cos(turn), np.sin(turn)], 1)
    across = np.stack([-np.sin(turn), np.cos(turn)], 1)
    sides = texels * np.stack([slant * along, across], 2)
    return Pixels(rng.random((LOOKUPS, 2)) * side, sides, texels, slant)


def mean_over(look_at: Callable[[Floats], Floats], seen: Pixels) -> Floats:
    """Return means over pixels whose centres lie around the samples, by a grid of lookups."""
    inside = np.random.default_rng(1).random((LOOKUPS, 2)) - 0.5  # of the sample in its pixel
    along, across = round(SUBPIXELS * seen.slant), SUBPIXELS
    total = np.zeros((LOOKUPS, 3))
    for i in range(along):
        for j in range(across):
            shift = np.array([(i + 0.5) / along, (j + 0.5) / across]) - 0.5 - inside
            total += look_at(seen.sample + np.einsum("nij,nj->ni", seen.sides, shift))
    return total / (along * across)


def mip_map(picture: Image) -> list[Image]:
    """Return the levels of a square picture whose side is a power of two: means of 2 x 2 texels."""
    levels = [picture]
    while len(levels[-1]) > 1:
        levels.append(downscale_local_mean(levels[-1], (2, 2, 1)))
    return levels


def trilinear(levels: list[Image], seen: Pixels, taps: int = 1) -> Floats:
    """Look a mip map up: linearly in both directions, and between two levels.

    The level is that of the longer side of a pixel. Up to `taps` lookups along this side are
    averaged; then the level is that of a part of the side, but none finer than the short side.
    """
    count = min(taps, round(seen.slant))
    level = math.log2(max(seen.texels * seen.slant / count, 1))
    low = min(int(level), len(levels) - 2)
    total = np.zeros((LOOKUPS, 3))
    for tap in range(count):
        at = seen.sample + ((tap + 0.5) / count - 0.5) * seen.sides[:, :, 0]
        for number, share in ((low, 1 - (level - low)), (low + 1, level - low)):
            grid = (at / 2**number - 0.5).T[::-1]
            for c in range(3):
                plane = levels[number][..., c]
                total[:, c] += share * map_coordinates(plane, grid, order=1, mode="reflect")
    return total / count


def look(texture: Any, side: int, at: Floats, seen: Pixels | None = None) -> Floats:
    """Evaluate a texture at positions in texels, shape (n, 2); with pixels, as they see it."""
    with dr.suspend_grad():
        si = dr.zeros(mi.SurfaceInteraction3f, len(at))
        si.uv = mi.Point2f((at / side).T.astype(np.float32))
        if seen is not None:  # the plane z = 0 with the side 1, so far off that the pixel fits
            cosine = 1 / seen.slant
            along = math.sqrt(1 - cosine**2) / (seen.texels * seen.slant) * seen.sides[:, :, 0].T
            toward = np.vstack([along, np.full(len(at), cosine)])
            si.wi = mi.Vector3f(toward.astype(np.float32))
            si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
            si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
            si.t = mi.Float(seen.texels / (ANGLE * side))
        return np.array(texture.eval_3(si), np.float64).T
