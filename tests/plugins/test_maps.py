"""Textures of the maps of a material: values, names, and what textures of one file share."""

import gc
import os
from dataclasses import replace

import numpy as np
import pytest

from _helpers.materials import MAPS, material
from _helpers.sets import SIZE

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
import eigengs_dr as eg  # noqa: E402
from _helpers.texture import backend, picture, texel_centres  # noqa: E402
from _helpers.variants import on_both  # noqa: E402
from eigengs_dr.plugins import parameters as shared  # noqa: E402

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


@pytest.fixture
def file(tmp_path):
    """A file of a material."""
    material(size=SIZE, backend=backend()).save(tmp_path / "m.npz")
    return tmp_path / "m.npz"


def texture(path, name=None, **properties):
    """A texture of a file."""
    chosen = {} if name is None else {"map": name}
    return mi.load_dict(
        {"type": "gaussian_texture", "filename": str(path), **chosen, **properties}, optimize=False
    )


@pytest.mark.parametrize("prefilter", [0.0, 0.01])
def test_values_are_those_of_the_map_alone(file, prefilter):
    m = eg.Gaussians.load(file, backend())
    for name in [part.name for part in m.maps]:
        found = texture(file, name, prefilter=prefilter)
        alone = mi.load_dict(eg.plugins.texture_of(m[name], prefilter=prefilter))
        si = texel_centres()
        if m[name].channels == 1:
            np.testing.assert_array_equal(found.eval_1(si).numpy(), alone.eval_1(si).numpy())
        else:
            np.testing.assert_array_equal(picture(found.eval_3(si)), picture(alone.eval_3(si)))
    normals = picture(texture(file, "normal").eval_3(texel_centres()))
    np.testing.assert_allclose(np.linalg.norm(2 * normals - 1, axis=2), 1, atol=1e-5)


def test_textures_of_a_file_share_memory_until_one_changes(file):
    parts = [texture(file, m.name, prefilter=0.01) for m in MAPS]
    rows = [mi.traverse(part)["mean"].array.index for part in parts]
    assert len(set(rows)) == 1
    [held] = shared._files.values()
    assert len(held.tables) == 1
    before = picture(parts[2].eval_3(texel_centres()))
    parameters = mi.traverse(parts[0])
    parameters["mean"] = parameters["mean"] + 3
    parameters.update()
    np.testing.assert_array_equal(picture(parts[2].eval_3(texel_centres())), before)
    m = eg.Gaussians.load(file, backend())
    moved = replace(m["albedo"], mean=m["albedo"].mean + 3)
    alone = mi.load_dict(eg.plugins.texture_of(moved, prefilter=0.01))
    found = picture(parts[0].eval_3(texel_centres()))
    np.testing.assert_allclose(found, picture(alone.eval_3(texel_centres())), atol=1e-5)
    assert mi.traverse(parts[1])["mean"].array.index == rows[1]


def test_a_file_that_has_changed_is_read_again_and_none_is_kept(file):
    first = texture(file, "albedo")
    os.utime(file, ns=(1, 1))
    second = texture(file, "albedo")
    assert len(shared._files) == 2
    del first, second
    gc.collect()
    assert not shared._files


@pytest.mark.parametrize("variant", on_both("spectral"), indirect=True)
def test_a_spectral_variant_has_colours_and_data(variant, file):
    si = texel_centres()
    assert np.isfinite(texture(file, "roughness").eval_1(si).numpy()).all()
    assert np.isfinite(picture(texture(file, "normal").eval_3(si))).all()


def test_mistakes(file, tmp_path):
    with pytest.raises(RuntimeError, match="holds maps; say which by map = one of albedo, rough"):
        texture(file)
    with pytest.raises(RuntimeError, match="has no map 'rough'; map = one of albedo, roughness"):
        texture(file, "rough")
    with pytest.raises(RuntimeError, match="map is 3; it must be the name of a map"):
        texture(file, 3)
    eg.Gaussians.load(file, backend())["albedo"].save(tmp_path / "g.npz")
    with pytest.raises(RuntimeError, match="holds one image and no map 'albedo'; leave map out"):
        texture(tmp_path / "g.npz", "albedo")
    packed = tmp_path / "m.egs"
    eg.pack(eg.Gaussians.load(file, backend())[:2], packed)
    assert texture(packed, "roughness", first=1).resolution().x == SIZE[0]
