"""Textures of the maps of a file: values, names, what they share, and lookups made once."""

import os
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.frozen import check_frozen
from _helpers.kernels import jit, launches
from _helpers.materials import MAPS, material
from _helpers.sets import SIZE
from _helpers.texture import backend, mi, picture, small_scene, texel_centres
from eigengs_dr.plugins import texture_of

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


def test_values_are_those_of_the_map_alone(file):
    m = eg.Gaussians.load(file, backend())
    for name in [part.name for part in m.maps]:
        found = map_texture(file, name, memory="exact")
        alone = mi.load_dict(texture_of(m[name]))
        si = texel_centres()
        if m[name].channels == 1:
            np.testing.assert_array_equal(found.eval_1(si).numpy(), alone.eval_1(si).numpy())
        else:
            np.testing.assert_array_equal(picture(found.eval_3(si)), picture(alone.eval_3(si)))
    normals = picture(map_texture(file, "normal").eval_3(texel_centres()))
    np.testing.assert_allclose(np.linalg.norm(2 * normals - 1, axis=2), 1, atol=1e-5)


def rows_of(texture):
    """What tells where the means of a texture are held."""
    return mi.traverse(texture)["mean"].array.index


def test_textures_of_a_file_share_memory_until_one_changes(file):
    """Also where Mitsuba makes them in threads."""
    names = [name for name, *_ in MAPS]
    walls = {
        name: {"type": "rectangle", "emitter": {"type": "area", "radiance": source}}
        for name in names
        for source in [{"type": "gaussian_texture", "filename": str(file), "map": name}]
    }
    parameters = mi.traverse(mi.load_dict({"type": "scene", **walls}, optimize=False))
    assert len({parameters[f"{name}.emitter.radiance.mean"].array.index for name in names}) == 1
    parts = [map_texture(file, name, prefilter=0.01) for name in names]
    rows = [rows_of(part) for part in parts]
    assert len(set(rows)) == 1
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
    assert rows_of(parts[1]) == rows[1]


def test_a_file_that_has_changed_is_read_again(file):
    first = map_texture(file, "albedo")
    os.utime(file, ns=(1, 1))
    assert rows_of(map_texture(file, "albedo")) != rows_of(first)


def test_mistakes(file, tmp_path):
    for name, message in (
        (None, "holds maps; say which by map = one of albedo, rough"),
        ("rough", "has no map 'rough'; map = one of albedo, roughness"),
        (3, "map is 3; it must be the name of a map"),
    ):
        with pytest.raises(RuntimeError, match=message):
            map_texture(file, name)
    eg.Gaussians.load(file, backend())["albedo"].save(tmp_path / "g.npz")
    with pytest.raises(RuntimeError, match="holds one image and no map 'albedo'; leave map out"):
        map_texture(tmp_path / "g.npz", "albedo")


class TestMapsOfAFile:
    """Their lookups are one; pictures and derivatives are those of a file for each map."""

    @pytest.fixture
    def of_files(self, file):
        """The same material of the maps of one file, or of a file for each map."""
        whole = eg.Gaussians.load(file, backend())

        def make(shared):
            def texture(name):
                source = {"type": "gaussian_texture", "filename": str(file), "map": name}
                source["memory"] = "exact"  # pictures are compared to rounding
                return source if shared else texture_of(whole[name])

            inner = {"type": "diffuse", "reflectance": texture("albedo")}
            return {"type": "mask", "opacity": texture("roughness"), "inner": inner}

        return make

    @pytest.mark.parametrize("mapped", [False, True])
    def test_renderings(self, of_files, mapped):
        """With fewer instructions, unless the maps lie in other places."""
        pictures, sizes = [], []
        for shared in (True, False):
            coat = of_files(shared)
            if mapped:
                coat["opacity"]["to_uv"] = mi.ScalarTransform4f().scale(2)
                coat["inner"]["reflectance"]["wrap_mode"] = "clamp"
            with launches() as launched:
                pictures.append(np.array(mi.render(small_scene(coat, "direct"), spp=8)))
            sizes.append(max(len(kernel.ir.getvalue()) for kernel in jit(launched)))
        np.testing.assert_allclose(*pictures, atol=1e-6)
        assert mapped or sizes[0] < 0.95 * sizes[1]

    @pytest.mark.slow
    def test_frozen_renderings(self, of_files):
        """In the file's values first, then in others."""
        check_frozen(small_scene(of_files(True), "direct"), [[], [], *[["opacity.color"]] * 3], 4)

    def test_derivatives_of_one_map(self, of_files):
        """The map that has them has lookups of its own; the others still share theirs."""
        results = []
        for shared in (True, False):
            scene = small_scene(of_files(shared), "direct")
            parameters, along = mi.traverse(scene), mi.Float(0)
            key = next(k for k, _ in parameters if k.endswith("reflectance.color"))
            dr.enable_grad(along)
            parameters[key] = mi.TensorXf(parameters[key]) * (1 + along)
            parameters.update()
            image = mi.render(scene, parameters, spp=8)
            dr.backward(dr.sum(dr.square(image), axis=None))
            results.append(np.array(dr.grad(along)))
        assert np.abs(results[0]).max() > 1e-3
        np.testing.assert_allclose(*results, rtol=1e-4, atol=1e-5)
