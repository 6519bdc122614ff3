"""Footprints that rays carry, as Mitsuba 3.10 has them, by a stand-in for its interactions."""

from types import SimpleNamespace

import numpy as np
import pytest

from _helpers.texture import at, gaussians, in_front, mi, texture

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

ANGLE, DISTANCE, STRETCH = 0.02, 4.0, (2.0, 0.5)  # and lengths of dp_du and dp_dv


def interaction(u=0.4, v=0.6):
    """A point that the camera sees at a right angle."""
    si = in_front(at(mi.Float(u), mi.Float(v)), DISTANCE)
    si.dp_du, si.dp_dv = mi.Vector3f(STRETCH[0], 0, 0), mi.Vector3f(0, STRETCH[1], 0)
    return si


def with_footprint(si, footprint):
    """The same point in a renderer that knows the footprint; tests call methods from Python."""
    names = ("uv", "t", "wi", "dp_du", "dp_dv", "wavelengths", "to_world")
    values = {name: getattr(si, name) for name in names}
    return SimpleNamespace(footprint=mi.Matrix2f(footprint), **values)


def pixel():
    """The footprint of the cone at that point: the width of a pixel along u and v."""
    return np.diag(ANGLE * DISTANCE / np.array(STRETCH))


def seen(tex, si):
    return np.array(tex.eval(si)).ravel()


@pytest.mark.parametrize("angle", [0.0, 30.0])
def test_it_sees_what_the_cone_sees(angle):
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], angle) @ mi.ScalarTransform4f().scale(0.7)
    si = interaction()
    own = texture(gaussians("linear"), prefilter=True, to_uv=turn)
    other = texture(gaussians("linear"), prefilter=ANGLE, to_uv=turn)
    found = seen(own, with_footprint(si, pixel()))
    np.testing.assert_allclose(found, seen(other, si), rtol=1e-4)
    assert np.abs(found - seen(texture(gaussians("linear"), to_uv=turn), si)).max() > 1e-3


def test_the_footprint_goes_before_the_angle():
    tex, si = texture(gaussians("linear"), prefilter=ANGLE), interaction()
    wide, narrow = seen(tex, with_footprint(si, 3 * pixel())), seen(tex, si)
    assert np.abs(wide - narrow).max() > 1e-3
    wider = texture(gaussians("linear"), prefilter=3 * ANGLE)
    np.testing.assert_allclose(wide, seen(wider, si), rtol=1e-4)


def test_any_two_conjugate_diameters_say_the_same():
    """The ellipse decides, and not the pair of diameters that span it."""
    tex, si, turn = texture(gaussians("linear"), prefilter=True), interaction(), np.radians(35)
    turned = pixel() @ [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    found = seen(tex, with_footprint(si, turned))
    np.testing.assert_allclose(found, seen(tex, with_footprint(si, pixel())), rtol=1e-4)


@pytest.mark.parametrize(("prefilter", "instead"), [(ANGLE, ANGLE), (True, 0.0)])
def test_without_a_cone_the_angle_decides(prefilter, instead):
    """And without an angle, lookups at points."""
    own, other = (texture(gaussians("linear"), prefilter=p) for p in (prefilter, instead))
    found = seen(own, with_footprint(interaction(), np.zeros((2, 2))))
    np.testing.assert_allclose(found, seen(other, interaction()), atol=1e-4)


def test_it_tells_the_scene():
    g = gaussians()
    assert texture(g, prefilter=True).filtered() and texture(g, prefilter=0.1).filtered()
    assert not texture(g).filtered()
    assert "prefilter = true" in str(texture(g, prefilter=True))
