"""Lookups that are made once though a material asks twice."""

import drjit as dr
import numpy as np
import pytest

from _helpers.materials import material
from _helpers.sets import SIZE

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
from _helpers.texture import at, backend, gaussians, small_scene, texture  # noqa: E402
from eigengs_dr.plugins import gaussian_texture, texture_of  # noqa: E402
from eigengs_dr.plugins import lookup as reuse  # noqa: E402
from eigengs_dr.plugins import parameters as files  # noqa: E402

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


@pytest.fixture
def lookups(monkeypatch):
    """The lookups that are made, instead of found."""
    made, plain = [], reuse.reused

    def counted(*inputs):
        *depends, look_up = inputs
        return plain(*depends, lambda: made.append(1) or look_up())

    monkeypatch.setattr(gaussian_texture, "reused", counted)
    return made


@pytest.fixture
def of_files(tmp_path):
    """The same material of the maps of one file, or of a file for each map."""
    whole = material(size=SIZE, backend=backend())
    whole.save(tmp_path / "m.npz")

    def make(shared, prefilter=0.0):
        def texture(name):
            file = {"filename": str(tmp_path / "m.npz"), "map": name}
            source = {"type": "gaussian_texture", **file} if shared else texture_of(whole[name])
            return {**source, "prefilter": prefilter}

        coat = {"type": "principled", "base_color": texture("albedo")}
        coat["roughness"] = texture("roughness")
        return {"type": "normalmap", "normalmap": texture("normal"), "bsdf": coat}

    return make


class TestMapsOfAFile:
    """Their lookups are one; pictures and derivatives are those of a file for each map."""

    @pytest.mark.parametrize("prefilter", [0.0, 0.05])
    def test_renderings(self, lookups, of_files, prefilter):
        """With half the lookups."""
        pictures, counts = [], [0]
        for shared in (True, False):
            scene = small_scene(of_files(shared, prefilter)["bsdf"])
            pictures.append(np.array(mi.render(scene, spp=8)))
            counts.append(len(lookups))
        one, each = np.diff(counts)
        assert 2 * one == each
        np.testing.assert_allclose(*pictures, atol=1e-6)

    @pytest.mark.parametrize("prefilter", [0.0, 0.05])
    def test_frozen_renderings(self, of_files, prefilter):
        frozen = dr.freeze(lambda scene, seed: mi.render(scene, spp=4, seed=seed))
        scenes = [small_scene(of_files(shared, prefilter)) for shared in (True, False)]
        parameters = [mi.traverse(scene) for scene in scenes]
        for step in range(4):
            for p in parameters[: step > 1 and 2]:  # in the file's values first, then in others
                key = next(k for k, _ in p if k.endswith("roughness.color"))
                p[key] = 1.1 * p[key]
                p.update()
            found = np.array(frozen(scenes[0], mi.UInt32(step)))
            expected = np.array(mi.render(scenes[1], spp=4, seed=step))
            np.testing.assert_allclose(found, expected, atol=1e-6)

    @pytest.mark.parametrize(
        ("mode", "prefilter"), [("forward", 0.0), ("backward", 0.0), ("backward", 0.05)]
    )
    def test_derivatives_of_one_map(self, of_files, mode, prefilter):
        """The map that has them has lookups of its own; the others still share theirs."""
        results = []
        for shared in (True, False):
            scene = small_scene(of_files(shared, prefilter), "prb")
            parameters, along = mi.traverse(scene), mi.Float(0)
            key = next(k for k, _ in parameters if k.endswith("base_color.color"))
            dr.enable_grad(along)
            parameters[key] = mi.TensorXf(parameters[key]) * (1 + along)
            parameters.update()
            image = mi.render(scene, parameters, spp=8)
            if mode == "forward":
                dr.forward(along)
                results.append(np.array(dr.grad(image)))
            else:
                dr.backward(dr.sum(dr.square(image), axis=None))
                results.append(np.array(dr.grad(along)))
        assert np.abs(results[0]).max() > 1e-3
        np.testing.assert_allclose(*results, rtol=1e-4, atol=1e-5)

    @pytest.mark.parametrize(
        ("module", "step"),
        [(reuse, "list_gaussians"), (reuse, "make_table"), (files, "SharedFile")],
    )
    def test_textures_that_are_made_at_once_share_all(self, monkeypatch, tmp_path, module, step):
        """A thread of Mitsuba that waits for Dr.Jit makes another texture meanwhile."""
        material(size=SIZE, backend=backend()).save(tmp_path / "m.npz")
        plain, inner = getattr(module, step), []

        def make():
            file = files.shared_file(str(tmp_path / "m.npz"), backend(), None)
            return file, reuse.table_of_file(file, 3.0, "repeat", True)

        def nested(*inputs):
            monkeypatch.undo()
            inner.extend(make())
            return plain(*inputs)

        monkeypatch.setattr(module, step, nested)
        for found in (make(), make()):
            assert all(a is b for a, b in zip(found, inner, strict=True))

    def test_other_mappings_are_other_lookups(self, lookups, of_files):
        coat = of_files(True)["bsdf"]
        coat["roughness"]["to_uv"] = mi.ScalarTransform4f().scale(2)
        coat["base_color"]["wrap_mode"] = "clamp"
        counts = []
        for bsdf in (of_files(True)["bsdf"], coat):
            mi.render(small_scene(bsdf), spp=1)
            counts.append(len(lookups))
        assert counts[1] == 3 * counts[0]


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
