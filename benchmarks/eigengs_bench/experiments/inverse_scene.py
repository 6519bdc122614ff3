"""A poster on a wall, under a lamp, and photos of it: the scene of `inverse`."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.color import to_coded, to_linear

DEPTH = 3
"""Longest path: from the lamp to the poster at once, or over the floor."""

SUBPIXELS = 2
"""Lookups along a side of a pixel of the recovered poster. With 2, every texel of a bitmap of up
to four times the size counts."""

PHOTO_SAMPLES = 1024
"""Samples a pixel of a photo without noise."""

LEFT, FRONT, RIGHT = (-2.4, 0.4, 3.0), (0, 0, 3.8), (2.4, -0.4, 3.0)
GRAZING = (3.5, 0.3, 1.4)
"""Places of cameras; the poster spans -1 to 1 along x and y."""


class Condition(NamedTuple):
    """What is known of the poster.

    Attributes
    ----------
    cameras : tuple of (float, float, float)
        Where they stand.
    side : int
        Pixels along a side of a photo.
    samples : int
        Samples a pixel of a photo: its noise.
    hidden : bool
        Whether a board covers the right half of the poster.
    aperture : float
        Radius of the lens. Above 0, all of the poster is out of focus.
    fov : float
        Field of view in degrees.
    """

    cameras: tuple[tuple[float, float, float], ...] = (LEFT, FRONT, RIGHT)
    side: int = 128
    samples: int = PHOTO_SAMPLES
    hidden: bool = False
    aperture: float = 0.0
    fov: float = 36.0


CONDITIONS = {
    "cameras": Condition(),
    "grazing": Condition(cameras=(GRAZING,), side=72, aperture=0.08, fov=27.0),
    "hidden": Condition(hidden=True),
    "noise": Condition(samples=4),
}

POSTER = "poster.bsdf.reflectance"
"""Name of the unknown texture among the parameters of a scene."""


def scene_of(condition: Condition, texture: Any) -> Any:
    """Load the scene with a texture on the poster; all cameras share one wide film.

    Parameters
    ----------
    condition : Condition
    texture : mitsuba.Texture

    Returns
    -------
    mitsuba.Scene
    """
    at = mi.ScalarTransform4f()
    # Rows of an image run down, v of a rectangle runs up.
    upright = at.scale([1, -1, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": DEPTH},
        "sensor": _cameras(condition),
        "poster": _rectangle(upright, {"type": "diffuse", "reflectance": texture}),
        "wall": _rectangle(at.translate([0, 0, -0.01]).scale(5), _grey(0.5)),
        "floor": _rectangle(at.translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(5), _grey(0.4)),
        "lamp": {
            "type": "rectangle",
            "to_world": at.look_at([1.5, 3, 3], [0, 0, 0], [0, 1, 0]).scale(0.7),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 40.0}},
        },
    }
    if condition.hidden:
        board = at.translate([1, 0, 0.005]).scale([1, 1.2, 1])
        scene["board"] = _rectangle(board, _grey(0.2))
    return mi.load_dict(scene)


def photograph(condition: Condition, image: NDArray[np.float32]) -> tuple[Any, Any]:
    """Render the photos of a poster, and its texture: a bitmap, which no method uses as it is.

    Parameters
    ----------
    condition : Condition
    image : ndarray of float32, shape (H, W, 3)
        RGB.

    Returns
    -------
    photos : TensorXf, shape (side, cameras x side, 3)
        Linear light.
    texture : mitsuba.Texture
    """
    texture = bitmap(to_linear(image.clip(0, 1)))
    scene = scene_of(condition, texture)
    # Another seed than those of the steps: noise that a method could reproduce is no noise.
    return dr.detach(mi.render(scene, spp=condition.samples, seed=1 << 20)), texture


def bitmap(pixels: NDArray[np.float32]) -> Any:
    """Load pixels in linear light, shape (H, W, 3), as a texture with derivatives."""
    data = mi.TensorXf(np.ascontiguousarray(pixels))
    return mi.load_dict({"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"})


def head_on(texture: Any, width: int, height: int) -> NDArray[np.float32]:
    """Look at a texture from the front, in even light.

    Returns
    -------
    ndarray of float32, shape (height, width, 3)
        RGB: the mean of linear light over every pixel, coded.
    """
    columns, rows = width * SUBPIXELS, height * SUBPIXELS
    with dr.suspend_grad():
        i = dr.arange(mi.UInt32, columns * rows)
        si = dr.zeros(mi.SurfaceInteraction3f, columns * rows)
        si.uv = mi.Point2f((i % columns + 0.5) / columns, (i // columns + 0.5) / rows)
        color = np.array(texture.eval_3(si)).T
    blocks = color.reshape(height, SUBPIXELS, width, SUBPIXELS, 3)
    return to_coded(blocks.mean(axis=(1, 3)).clip(0, 1).astype(np.float32))


def _cameras(condition: Condition) -> dict[str, Any]:
    side, count = condition.side, len(condition.cameras)
    batch: dict[str, Any] = {"type": "batch", "film": _film(count * side, side)}
    for number, place in enumerate(condition.cameras):
        batch[f"camera{number}"] = {
            "type": "thinlens" if condition.aperture else "perspective",
            "fov": condition.fov,
            "to_world": mi.ScalarTransform4f().look_at(place, [0, 0, 0], [0, 1, 0]),
            "film": _film(side, side),
        }
        if condition.aperture:
            focus = {"aperture_radius": condition.aperture, "focus_distance": 2.0}
            batch[f"camera{number}"].update(focus)
    return batch


def _film(width: int, height: int) -> dict[str, Any]:
    # A box: every sample counts for its own pixel alone.
    kind = {"type": "hdrfilm", "pixel_format": "rgb", "rfilter": {"type": "box"}}
    return {**kind, "width": width, "height": height}


def _rectangle(place: Any, bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def _grey(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}
