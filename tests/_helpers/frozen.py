"""Frozen renderings of scenes whose parameters change."""

import drjit as dr
import numpy as np

from _helpers.poster import mi


def render(scene, seed):
    return mi.render(scene, spp=4, seed=seed)


def check_frozen(scene, changes, most=3, draw=render):
    """Change parameters that end like names, step by step: what is frozen shows what is not.

    It may be recorded `most` times; the first calls record, all others replay.
    """
    parameters, frozen = mi.traverse(scene), dr.freeze(draw)
    for step, names in enumerate(changes):
        for name in names:
            key = next(k for k, _ in parameters if k.endswith(name))
            if name == "to_uv":
                parameters[key] = mi.ScalarTransform3f().scale(1 - 0.05 * step)
            elif name == "sky.to_world":
                turned = mi.ScalarTransform4f().rotate([0, 1, 0], 40 * step)
                parameters[key] = mi.AffineTransform4f(turned)
            else:
                parameters[key] = parameters[key] * 0.9
        parameters.update()
        found, expected = (np.array(f(scene, mi.UInt32(step))) for f in (frozen, render))
        np.testing.assert_array_equal(found, expected)
    assert frozen.n_recordings <= most
