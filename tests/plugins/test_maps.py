"""Textures of the maps of a file: values, names, what they share, and lookups made once."""

import gc
import os
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.materials import MAPS, material
from _helpers.sets import SIZE
from _helpers.texture import (
    at,
    backend,
    gaussians,
    mi,
    picture,
    small_scene,
    texel_centres,
    texture,
)
from eigengs_dr.backend.recording import collector_off
from eigengs_dr.image.color import to_linear
from eigengs_dr.plugins import gaussian_texture, texture_of
from eigengs_dr.plugins import lookup as reuse
from eigengs_dr.plugins import parameters as files

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


@pytest.fixture
def file(tmp_path):
    """A file of a material."""
    material(size=SIZE, backend=backend()).save(tmp_path / "m.npz")
    return tmp_path / "m.npz"


def map_texture(path, name=None, **properties):
    """A texture of a file."""
    chosen = {} if name is None else {"map": name}
    return mi.load_dict(
        {"type": "gaussian_texture", "filename": str(path), **chosen, **properties}, optimize=False
    )


@pytest.mark.parametrize("prefilter", [0.0, 0.01])
def test_values_are_those_of_the_map_alone(file, prefilter):
    m = eg.Gaussians.load(file, backend())
    for name in [part.name for part in m.maps]:
        found = map_texture(file, name, prefilter=prefilter, memory="exact")
        alone = mi.load_dict(texture_of(m[name], prefilter=prefilter))
        si = texel_centres()
        if m[name].channels == 1:
            np.testing.assert_array_equal(found.eval_1(si).numpy(), alone.eval_1(si).numpy())
        else:
            np.testing.assert_array_equal(picture(found.eval_3(si)), picture(alone.eval_3(si)))
    normals = picture(map_texture(file, "normal").eval_3(texel_centres()))
    np.testing.assert_allclose(np.linalg.norm(2 * normals - 1, axis=2), 1, atol=1e-5)


def test_opacity_is_a_map_of_a_material(tmp_path):
    """A leaf with a soft edge: one file gives its colour and its mask, and both have gradients."""
    y, x = np.mgrid[:32, :32] / 32
    albedo = np.float32(np.stack([0.3 + 0.2 * np.sin(9 * x), 0.4 + 0.3 * y, 0.2 + 0 * x], axis=2))
    opacity = np.float32(np.clip(4 - 10 * np.hypot(x - 0.5, y - 0.5), 0, 1))
    settings = {"gaussians": 200, "iterations": 60, "progress": False}
    leaf = eg.fit({"albedo": albedo, "opacity": opacity}, **settings).gaussians
    assert {m.name: m.space for m in leaf.maps} == {"albedo": "linear", "opacity": "data"}
    leaf.save(tmp_path / "leaf.npz")
    file = {"type": "gaussian_texture", "filename": str(tmp_path / "leaf.npz")}

    def masked(albedo, opacity):
        sided = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": albedo}}
        return small_scene({"type": "mask", "opacity": opacity, "inner": sided}, "direct", side=24)

    def bitmap(pixels):
        data = mi.TensorXf(pixels.reshape(32, 32, -1))
        return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}

    scene = masked({**file, "map": "albedo"}, {**file, "map": "opacity"})
    seen = np.array(mi.render(scene, spp=64, seed=1))
    shown = masked(bitmap(to_linear(albedo)), bitmap(opacity))
    assert eg.psnr(seen.clip(0, 1), np.array(mi.render(shown, spp=64, seed=1)).clip(0, 1)) > 35
    parameters = mi.traverse(scene)
    keys = [key for key, _ in parameters if key.endswith(".color")]
    assert len(keys) == 2
    for key in keys:
        dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.mean(dr.square(mi.render(scene, parameters, spp=4))))
    assert all(np.abs(np.array(dr.grad(parameters[key]))).max() > 0 for key in keys)


def test_textures_of_a_file_share_memory_until_one_changes(file):
    parts = [map_texture(file, m[0], prefilter=0.01) for m in MAPS]
    rows = [mi.traverse(part)["mean"].array.index for part in parts]
    assert len(set(rows)) == 1
    [held] = files._files.values()
    assert len(held.tables) == 1
    before = picture(parts[2].eval_3(texel_centres()))
    parameters = mi.traverse(parts[0])
    parameters["mean"] = parameters["mean"] + 3
    parameters.update()
    np.testing.assert_array_equal(picture(parts[2].eval_3(texel_centres())), before)
    m = eg.Gaussians.load(file, backend())
    moved = replace(m["albedo"], mean=m["albedo"].mean + 3)
    alone = mi.load_dict(texture_of(moved, prefilter=0.01))
    found = picture(parts[0].eval_3(texel_centres()))
    np.testing.assert_allclose(found, picture(alone.eval_3(texel_centres())), atol=1e-5)
    assert mi.traverse(parts[1])["mean"].array.index == rows[1]


def test_a_file_that_has_changed_is_read_again_and_none_is_kept(file):
    first = map_texture(file, "albedo")
    os.utime(file, ns=(1, 1))
    second = map_texture(file, "albedo")
    assert len(files._files) == 2
    del first, second
    gc.collect()
    assert not files._files


def test_mistakes(file, tmp_path):
    with pytest.raises(RuntimeError, match="holds maps; say which by map = one of albedo, rough"):
        map_texture(file)
    with pytest.raises(RuntimeError, match="has no map 'rough'; map = one of albedo, roughness"):
        map_texture(file, "rough")
    with pytest.raises(RuntimeError, match="map is 3; it must be the name of a map"):
        map_texture(file, 3)
    eg.Gaussians.load(file, backend())["albedo"].save(tmp_path / "g.npz")
    with pytest.raises(RuntimeError, match="holds one image and no map 'albedo'; leave map out"):
        map_texture(tmp_path / "g.npz", "albedo")
    packed = tmp_path / "m.egs"
    eg.pack(eg.Gaussians.load(file, backend())[:2], packed)
    assert map_texture(packed, "roughness", first=1).resolution().x == SIZE[0]


# --- Lookups that are made once though a material asks twice ---


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
def of_files(file):
    """The same material of the maps of one file, or of a file for each map."""
    whole = eg.Gaussians.load(file, backend())

    def make(shared, prefilter=0.0):
        def texture(name):
            source = {"type": "gaussian_texture", "filename": str(file), "map": name}
            source["memory"] = "exact"  # pictures are compared to rounding
            return {**(source if shared else texture_of(whole[name])), "prefilter": prefilter}

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
        frozen = dr.freeze(collector_off()(lambda scene, seed: mi.render(scene, spp=4, seed=seed)))
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
    def test_textures_that_are_made_at_once_share_all(self, monkeypatch, file, module, step):
        """A thread of Mitsuba that waits for Dr.Jit makes another texture meanwhile."""
        plain, inner = getattr(module, step), []

        def make():
            held = files.shared_file(str(file), backend(), None, coded=True)
            return held, reuse.table_of_file(held, 3.0, "repeat", True, reuse.MEMORIES["normal"])

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
