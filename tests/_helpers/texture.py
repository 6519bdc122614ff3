"""Textures, where they are looked up, and a small scene with one."""

import drjit as dr
import numpy as np
import pytest

from _helpers.sets import SIZE, random_scene

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
from _helpers.arrays import upload_rows  # noqa: E402
from _helpers.poster import camera  # noqa: E402
from eigengs_dr.plugins import texture_of  # noqa: E402


def backend():
    """Name of the backend of the current variant."""
    return mi.variant().split("_")[0]


def gaussians(space="linear", channels=3, seed=0, quiet=True):
    """A small set; a quiet one stays inside [0, 1], so that no value is clamped."""
    scene = random_scene(seed, channels=channels)
    if quiet:
        scene = scene._replace(
            color=0.04 * scene.color, background=np.full(channels, 0.5, np.float32)
        )
    return scene.on(backend(), space=space)


def texture(g, **properties):
    """The texture of a set."""
    return mi.load_dict({**texture_of(g), **properties})


def at(u, v, count=1):
    """Surface interactions at texture coordinates."""
    si = dr.zeros(mi.SurfaceInteraction3f, max(count, dr.width(u), dr.width(v)))
    si.uv = mi.Point2f(u, v)
    return si


def in_front(si, distance=1.0):
    """The same points, seen at a right angle from a distance; uv are units of the world."""
    si.t, si.wi, si.sh_frame = distance, mi.Vector3f(0, 0, 1), mi.Frame3f([0, 0, 1])
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    return si


def texel_centres(size=SIZE):
    """Surface interactions at the centres of all texels."""
    v, u = np.mgrid[: size[1], : size[0]] + 0.5
    return at(*upload_rows(mi.Float, (u.ravel() / size[0], v.ravel() / size[1])))


def picture(rows, size=SIZE):
    """Values at all texels as an image, shape (H, W, C)."""
    return np.stack([np.array(r) for r in rows], -1).reshape(size[1], size[0], -1)


def small_scene(bsdf, integrator="path", side=12, spp=32, emitter=None):
    """A textured wall under a lamp."""
    depth = {} if integrator == "direct" else {"max_depth": 3}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(1.5)}
    wall |= {"bsdf": bsdf} if bsdf else {"emitter": emitter}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, **depth},
            "sensor": camera([1, 1, 3.5], side, spp=spp),
            "wall": wall,
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, -2, 0]).rotate([1, 0, 0], -90),
            },
            "lamp": {
                "type": "sphere",
                "center": [0, 3, 3],
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 8.0}},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
        }
    )
