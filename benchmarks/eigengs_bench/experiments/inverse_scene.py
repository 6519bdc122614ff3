"""A poster on a wall, under a lamp, and photos of it: the scene of `inverse`."""

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.image.color import to_coded, to_linear

DEPTH = 3  # longest path: from the lamp to the poster at once, or over the floor
SUBPIXELS = 2  # lookups along a side of a pixel of the recovered poster

# Places of cameras; the poster spans -1 to 1 along x and y.
LEFT, FRONT, RIGHT, GRAZING = (-2.4, 0.4, 3.0), (0, 0, 3.8), (2.4, -0.4, 3.0), (3.5, 0.3, 1.4)


class Condition(NamedTuple):
    """What photos are like: places of cameras, pixels a side, samples a pixel (their noise).

    `hidden` puts a board before the right half; with an aperture the poster is out of focus.
    """

    cameras: tuple[tuple[float, float, float], ...] = (LEFT, FRONT, RIGHT)
    side: int = 128
    samples: int = 1024
    hidden: bool = False
    aperture: float = 0.0
    fov: float = 36.0


CONDITIONS = {
    "cameras": Condition(),
    "grazing": Condition(cameras=(GRAZING,), side=72, aperture=0.08, fov=27.0),
    "hidden": Condition(hidden=True),
    "noise": Condition(samples=4),
}

POSTER = "poster.bsdf.reflectance"  # name of the unknown texture among the parameters of a scene


def scene_of(condition: Condition, texture: Any) -> Any:
    """Load the scene with a texture on the poster; all cameras share one wide film."""
    at = mi.ScalarTransform4f()
    upright = at.scale([1, -1, 1])  # rows of an image run down, v of a rectangle runs up
    lamp = at.look_at([1.5, 3, 3], [0, 0, 0], [0, 1, 0]).scale(0.7)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 40.0}}
    scene = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": DEPTH},
        "sensor": _cameras(condition),
        "poster": _rectangle(upright, {"type": "diffuse", "reflectance": texture}),
        "wall": _rectangle(at.translate([0, 0, -0.01]).scale(5), _grey(0.5)),
        "floor": _rectangle(at.translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(5), _grey(0.4)),
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": light},
    }
    if condition.hidden:
        scene["board"] = _rectangle(at.translate([1, 0, 0.005]).scale([1, 1.2, 1]), _grey(0.2))
    return mi.load_dict(scene)


def photograph(condition: Condition, image: NDArray[np.float32]) -> tuple[Any, Any]:
    """Render the photos of a poster, side by side in linear light, and return its texture too."""
    texture = bitmap(to_linear(image.clip(0, 1)))
    scene = scene_of(condition, texture)
    # Another seed than those of the steps: noise that a method could reproduce is no noise.
    return dr.detach(mi.render(scene, spp=condition.samples, seed=1 << 20)), texture


def bitmap(pixels: NDArray[np.float32]) -> Any:
    """Load pixels in linear light, shape (H, W, 3), as a texture with derivatives."""
    data = mi.TensorXf(np.ascontiguousarray(pixels))
    return mi.load_dict({"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"})


def head_on(texture: Any, width: int, height: int) -> NDArray[np.float32]:
    """Look at a texture from the front: RGB of shape (height, width, 3), means of linear light."""
    columns, rows = width * SUBPIXELS, height * SUBPIXELS
    with dr.suspend_grad():
        i = dr.arange(mi.UInt32, columns * rows)
        si = dr.zeros(mi.SurfaceInteraction3f, columns * rows)
        si.uv = mi.Point2f((i % columns + 0.5) / columns, (i // columns + 0.5) / rows)
        color = np.array(texture.eval_3(si)).T
    blocks = color.reshape(height, SUBPIXELS, width, SUBPIXELS, 3)
    return to_coded(blocks.mean(axis=(1, 3)).clip(0, 1).astype(np.float32))


def _cameras(condition: Condition) -> dict[str, Any]:
    side, lens = condition.side, dict[str, Any](type="perspective")
    if condition.aperture:
        lens = {"type": "thinlens", "aperture_radius": condition.aperture, "focus_distance": 2.0}
    film: dict[str, Any] = {"type": "hdrfilm", "pixel_format": "rgb", "width": side, "height": side}
    film["rfilter"] = {"type": "box"}  # every sample counts for its own pixel alone
    batch: dict[str, Any] = {"type": "batch"}
    batch["film"] = {**film, "width": len(condition.cameras) * side}
    for number, place in enumerate(condition.cameras):
        view = mi.ScalarTransform4f().look_at(place, [0, 0, 0], [0, 1, 0])
        camera = {**lens, "fov": condition.fov, "to_world": view, "film": film}
        batch[f"camera{number}"] = camera
    return batch


def _rectangle(place: Any, bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def _grey(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}
