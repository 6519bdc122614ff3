"""The property and parameter ``to_uv``."""

import drjit as dr
import numpy as np
import pytest

from _helpers.texture import at, gaussians, in_front, mi, texture

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

KINDS = ("ScalarTransform3f", "ScalarTransform4f", "Transform3f", "Transform4f")


@pytest.mark.parametrize("name", KINDS)
def test_comes_first(name):
    kind, flat = getattr(mi, name), name.endswith("3f")
    shift = [0.1, 0.2] if flat else [0.1, 0.2, 0]
    scale = [0.5, 0.25] if flat else [0.5, 0.25, 1]
    tex = texture(gaussians(), to_uv=kind().translate(shift) @ kind().scale(scale))
    found = np.array(tex.eval(at(0.4, 0.8)))
    expected = np.array(texture(gaussians()).eval(at(0.3, 0.4)))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_small_transform_is_not_flat():
    tiny = mi.ScalarTransform4f().scale([1e-7, 1e-7, 1])
    found = texture(gaussians(), to_uv=tiny).eval(at(0.5, 0.5))
    np.testing.assert_allclose(found, texture(gaussians()).eval(at(5e-8, 5e-8)), atol=1e-5)


@pytest.mark.parametrize("before", [{}, {"to_uv": "scaled"}])
@pytest.mark.parametrize("prefilter", [0.0, 0.01])
def test_is_a_parameter(before, prefilter):
    """After an update lookups, slopes and sampling are those of a texture made so."""
    if before:
        before = {"to_uv": mi.ScalarTransform4f().scale([2, 3, 1])}
    changed, turned = (
        texture(gaussians(), prefilter=prefilter, **properties)
        for properties in (before, {"to_uv": mi.ScalarTransform4f().rotate([0, 0, 1], 30)})
    )
    parameters = mi.traverse(changed)
    assert type(parameters["to_uv"]) is mi.ScalarTransform3f
    changed.sample_position(mi.Point2f(0.2, 0.7))
    parameters["to_uv"] = mi.ScalarTransform3f().rotate(30)
    parameters.update()
    uv = np.random.default_rng(0).uniform(-1, 2, (2, 100)).astype(np.float32)
    si = in_front(at(*(mi.Float(k) for k in uv)), 5.0)
    for found, expected in (
        (changed.eval(si), turned.eval(si)),
        (changed.eval_1_grad(si), turned.eval_1_grad(si)),
        (changed.pdf_position(si.uv), turned.pdf_position(si.uv)),
    ):
        np.testing.assert_allclose(np.array(found), np.array(expected), atol=2e-5)


class TestMistakes:
    @pytest.mark.parametrize(
        ("value", "message"),
        [
            (2.0, "to_uv is 2.0; it must be a transform"),
            ("flat", "to_uv maps the plane to a line"),
            ("many", "to_uv holds 3 transforms; it must hold one"),
        ],
    )
    def test_at_the_start(self, value, message):
        if value == "flat":
            value = mi.ScalarTransform4f(np.diag([1.0, 0, 1, 1]))
        if value == "many":
            value = mi.Transform4f().scale(mi.Vector3f(mi.Float([1, 2, 3]), 1, 1))
        with pytest.raises(RuntimeError, match=message):
            texture(gaussians(), to_uv=value)

    def test_of_an_update(self):
        tex = texture(gaussians())
        parameters = mi.traverse(tex)
        parameters["to_uv"] = mi.ScalarTransform3f(np.diag([1.0, 0, 1]))
        with pytest.raises(Exception, match="to_uv maps the plane to a line"):
            parameters.update()
        dr.eval(tex.eval(at(0.5, 0.5)))
