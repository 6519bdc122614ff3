"""Lookups that are made once though a material asks twice."""

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
from _helpers.texture import at, gaussians, small_scene, texture  # noqa: E402
from eigengs_dr.plugins import gaussian_texture, texture_of  # noqa: E402
from eigengs_dr.plugins import lookup as reuse  # noqa: E402

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


@pytest.fixture
def lookups(monkeypatch):
    """The lookups that are made, instead of found."""
    made, plain = [], reuse.reused

    def counted(texture, si, inputs, look_up):
        return plain(texture, si, inputs, lambda: made.append(1) or look_up())

    monkeypatch.setattr(gaussian_texture, "reused", counted)
    return made


def material(prefilter=0.0):
    number = texture_of(gaussians("data", channels=1), prefilter=prefilter)
    colour = texture_of(gaussians(), prefilter=prefilter)
    return {"type": "principled", "base_color": colour, "roughness": number}


@pytest.mark.parametrize("prefilter", [0.0, 0.05])
def test_renderings_are_those_without_reuse(monkeypatch, lookups, prefilter):
    scene = small_scene(material(prefilter))
    found, few = np.array(mi.render(scene, spp=8)), len(lookups)
    monkeypatch.setattr(reuse, "_is_traced", lambda: False)
    expected = np.array(mi.render(scene, spp=8))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert few < len(lookups) - few


def test_a_branch_that_ended_lends_nothing():
    """A lookup in a branch, and the same one after it, are two."""
    tex = texture(gaussians())
    si = at(mi.Float([0.2, 0.5, 0.7]), mi.Float([0.3, 0.6, 0.9]))

    def seen():
        return mi.Color3f(tex.eval(si))

    def body(i, total):
        inner = dr.if_stmt(
            (), si.uv.x > 0.4, lambda: seen(), lambda: mi.Color3f(0), mode="symbolic"
        )
        return i + 1, total + inner + seen()

    start = (mi.UInt32(0), mi.Color3f(0) + dr.zeros(mi.Float, 3))
    total = dr.while_loop(start, lambda i, total: i < 2, body, mode="symbolic")[1]
    once = np.array(tex.eval(si))
    expected = 2 * once + 2 * once * (np.array(si.uv.x) > 0.4)
    np.testing.assert_allclose(np.array(total), expected, atol=1e-6)


def test_other_points_and_textures_are_other_lookups(lookups):
    one, two = texture(gaussians()), texture(gaussians(seed=1))
    si, other = (at(mi.Float([u, 0.5]), mi.Float([0.3, 0.6])) for u in (0.2, 0.7))

    def body(i, total):
        parts = [t.eval(s) for t in (one, two) for s in (si, other) for _ in range(3)]
        return i + 1, total + sum(parts)

    start = (mi.UInt32(0), mi.Color3f(0) + dr.zeros(mi.Float, 2))
    total = dr.while_loop(start, lambda i, total: i < 1, body, mode="symbolic")[1]
    assert len(lookups) % 4 == 0 and len(lookups) <= 8
    expected = 3 * sum(np.array(t.eval(s)) for t in (one, two) for s in (si, other))
    np.testing.assert_allclose(np.array(total), expected, atol=1e-5)
