"""Environments of Gaussians, the bitmaps of their pictures, and scenes that they light."""

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")

import eigengs_dr as eg  # noqa: E402
from _helpers.arrays import upload_rows  # noqa: E402
from _helpers.poster import camera  # noqa: E402
from _helpers.texture import backend  # noqa: E402

WIDTH, HEIGHT = 64, 32


def sky(space="radiance", channels=3, seed=0, count=40, deviation=(2.0, 5.0), size=(WIDTH, HEIGHT)):
    """A smooth set of light above 0, which does not end at the seam."""
    rng = np.random.default_rng(seed)
    width, _ = size
    mean = rng.uniform(0, size, (count, 2))
    factor = np.stack([1 / rng.uniform(*deviation, count) for _ in range(3)], axis=1)
    factor[:, 1] = rng.uniform(-0.05, 0.05, count)
    color = rng.uniform(0.1, 1.5, (count, channels)) * (0.25 if space == "log" else 1)
    mean = np.concatenate([mean + np.array([k * width, 0]) for k in (-1, 0, 1)])
    near = (mean[:, 0] > -20) & (mean[:, 0] < width + 20)
    return eg.Gaussians.from_arrays(
        mean[near],
        np.tile(factor, (3, 1))[near],
        np.tile(color, (3, 1))[near],
        np.full(channels, 0.2),
        size=size,
        space=space,
        backend=backend(),
    )


def directions(u, v):
    """Directions of points of the picture, shape (3, n): the convention of an envmap."""
    theta, phi = np.pi * v, 2 * np.pi * u
    return np.stack(
        [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)]
    ).astype(np.float32)


def seen(emitter, d):
    """Light from directions, shape (n, channels)."""
    si = dr.zeros(mi.SurfaceInteraction3f, d.shape[1])
    si.wi = -mi.Vector3f(*upload_rows(mi.Float, d))
    return np.array(emitter.eval(si)).T


def lit(emitter, integrator="path", side=24):
    """A shiny ball on a disk under an environment."""
    depth = {} if integrator == "direct" else {"max_depth": 4}
    at = mi.ScalarTransform4f()
    coat = {"type": "principled", "base_color": {"type": "rgb", "value": 0.6}, "roughness": 0.3}
    floor = at.translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(2)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, **depth},
            "sensor": camera([0, 1, 5], side, fov=60),
            "ball": {"type": "sphere", "bsdf": coat},
            "floor": {"type": "disk", "to_world": floor},
            "sky": emitter,
        }
    )


def uniform(count, seed=0):
    """Samples of the unit square."""
    rng = np.random.default_rng(seed)
    return mi.Point2f(*(mi.Float(rng.random(count, np.float32)) for _ in "uv"))
