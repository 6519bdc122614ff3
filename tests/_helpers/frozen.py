"""Frozen renderings of scenes whose parameters change."""

import drjit as dr
import numpy as np

from _helpers.poster import mi


def render(scene, seed):
    return mi.render(scene, spp=4, seed=seed)


def check_frozen(scene, changes, most=3, draw=render, plugins=()):
    """Change parameters that end like names, step by step: what is frozen shows what is not.

    It may be recorded `most` times; the first calls record, all others replay. What the plugins had
    before is kept: a replay that does not see a change would often find the new arrays where the
    old ones were.
    """
    parameters, frozen, kept = mi.traverse(scene), dr.freeze(draw), []
    for step, names in enumerate(changes):
        kept.append([dict(vars(plugin)) for plugin in plugins])
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
        found, expected = (np.array(f(scene, mi.UInt32(step))) for f in (frozen, draw))
        np.testing.assert_array_equal(found, expected)
    assert frozen.n_recordings <= most
