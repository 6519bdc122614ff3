"""A poster in a scene, and the cameras that see it."""

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

import eigengs_dr as eg  # noqa: E402

FOV, SIDE, TEXELS = 40.0, 24, 32
NAME = "poster.bsdf.reflectance"


def camera(place, side=SIDE, *, fov=FOV, target=(0, 0, 0), up=(0, 1, 0), spp=4, **film):
    """A camera that by default looks at the middle of the poster."""
    size = {"width": side, "height": side, "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "to_world": mi.ScalarTransform4f().look_at(place, target, up),
        "film": {"type": "hdrfilm", **size, **film},
        "sampler": {"type": "independent", "sample_count": spp},
    }


def picture(side=TEXELS):
    """Random colours, shape (side, side, 3)."""
    values = np.random.default_rng(1).uniform(0, 1, (side, side, 3))
    return values.astype(np.float32)


def bitmap(pixels=None, **properties):
    """A bitmap texture of linear values."""
    data = mi.TensorXf(picture() if pixels is None else pixels)
    properties = {"wrap_mode": "clamp", **properties}
    return {"type": "bitmap", "data": data, "raw": True, **properties}


def scene_of(*cameras, texture=None, **others):
    """A poster from -1 to 1 in the plane z = 0."""
    poster = {
        "type": "rectangle",
        "bsdf": {"type": "diffuse", "reflectance": texture or bitmap()},
    }
    sensors = {f"camera{n}": c for n, c in enumerate(cameras)}
    lamp = {"type": "constant"}
    return mi.load_dict({"type": "scene", **sensors, "lamp": lamp, "poster": poster, **others})


def board(left, right):
    """Something in front of the poster, from left to right."""
    at = mi.ScalarTransform4f().translate([(left + right) / 2, 0, 0.001])
    to_world = at.scale([(right - left) / 2, 2, 1])
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.2}}
    return {"type": "rectangle", "to_world": to_world, "bsdf": grey}


def pixel_at(distance, texels=TEXELS, side=SIDE):
    """Texels along a side of a pixel, from the front: two units of the world are all texels."""
    return 2 * distance * np.tan(np.radians(FOV / 2)) / side * texels / 2


def albedo(scene):
    """What an independent renderer of the same pixels sees, shape (H, W, 3)."""
    aov = mi.load_dict({"type": "aov", "aovs": "a:albedo", "nested": {"type": "direct"}})
    return np.array(mi.render(scene, integrator=aov, spp=1024))[..., -3:]


def photo(side=48):
    """A photo of a few pixels, shape (side, side, 3)."""
    return eg.sample("astronaut")[: 8 * side : 8, : 8 * side : 8]


def quad(folder, matrix, flipped=False, normals=False):
    """A parallelogram, its corners `matrix` times (2 u - 1, 2 v - 1); faces may be turned over."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    normal = np.cross(*matrix.T)
    order = [1, 4, 3, 2] if flipped else [1, 2, 3, 4]
    lines = [f"v {x} {y} {z}" for x, y, z in (2 * corners - 1) @ matrix.T]
    lines += [f"vt {u} {v}" for u, v in corners]
    lines += [f"vn {normal[0]} {normal[1]} {normal[2]}"] if normals else []
    names = [f"{k}/{k}/1" if normals else f"{k}/{k}" for k in order]
    lines += [f"f {names[0]} {names[k]} {names[k + 1]}" for k in (1, 2)]
    path = folder / "quad.obj"
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path), "flip_tex_coords": False}
