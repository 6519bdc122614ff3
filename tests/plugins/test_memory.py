"""What a texture holds, which it says, and what it loses where it holds less."""

import gc
import re

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.lit_spheres import directions, photos
from _helpers.materials import material
from _helpers.sets import SIZE
from _helpers.skies import sky, uniform
from _helpers.texture import (
    at,
    backend,
    gaussians,
    in_front,
    mi,
    picture,
    small_scene,
    texel_centres,
    texture,
)
from eigengs_dr.plugins import environment_of, follow, gaussians_of, resident_bytes, texture_of
from eigengs_dr.plugins.follow import plugins_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

ROW = re.compile(
    r"^ *(\d+) +(LLVM|CUDA) +([a-z]+)(\d+)? .*? +(\d+) +[\d.]+ [KMGi]*B ", re.MULTILINE
)
"""A variable of `drjit.whos` that is in memory: number, backend, type, bits, and size."""


def stored(capfd):
    """Return the bytes of each variable that Dr.Jit holds in memory, by its number."""
    gc.collect()
    capfd.readouterr()
    dr.whos()
    rows = ROW.findall(capfd.readouterr().out)
    return {
        number: int(size) * (1 if kind == "bool" else int(bits) // 8)
        for number, _, kind, bits, size in rows
    }


def look_up(tex):
    dr.eval(tex.eval_3(in_front(at([0.2, 0.6], [0.3, 0.7]))))


def in_a_file(folder, g=None, **properties):
    """The dictionary of a texture of a file."""
    path = folder / "set.npz"
    (gaussians() if g is None else g).save(path)
    return {"type": "gaussian_texture", "filename": str(path), **properties}


@pytest.mark.parametrize("prefilter", [0.0, 0.01])
@pytest.mark.parametrize("filed", [False, True])
def test_resident_bytes_are_those_that_dr_jit_holds(filed, prefilter, capfd, tmp_path):
    scene, g = in_a_file(tmp_path, prefilter=prefilter), gaussians()
    look_up(mi.load_dict(scene))  # what the package keeps for every texture
    before = stored(capfd)
    tex = mi.load_dict(scene) if filed else texture(g, prefilter=prefilter)
    look_up(tex)
    found = sum(size for number, size in stored(capfd).items() if number not in before)
    # The transform of uv is a matrix of literals that were made opaque: a few numbers of 4 bytes.
    assert found - 200 <= resident_bytes(tex) <= found + 200


def test_sampled_light_counts(capfd):
    tex = texture(gaussians())
    tex.eval_1_grad(at(0.2, 0.3))
    before, held = stored(capfd), resident_bytes(tex)
    dr.eval(tex.sample_position(mi.Point2f(0.3, 0.4)))
    found = sum(size for number, size in stored(capfd).items() if number not in before)
    assert abs(resident_bytes(tex) - held - found) <= 300


def test_derivatives_count():
    tex = texture(gaussians())
    parameters = mi.traverse(tex)
    held, number = resident_bytes(tex), len(np.ravel(parameters["color"]))
    dr.enable_grad(parameters["color"])
    parameters.update()
    dr.backward(dr.sum(tex.eval_1(at(0.3, 0.6))))
    dr.eval(dr.grad(parameters["color"]))
    assert resident_bytes(tex) >= held + 4 * number


@pytest.mark.texture_units
@pytest.mark.parametrize(("channels", "padded"), [(1, 1), (3, 4)])
def test_of_a_bitmap_they_are_those_of_its_texels(channels, padded, capfd):
    """As Dr.Jit stores them from the first rendering on."""
    scene = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((64, 32, channels), np.uint8))}
    bitmap = mi.load_dict(scene | {"raw": True})
    dr.eval(bitmap.eval_1(at(0.2, 0.3)) if channels == 1 else bitmap.eval_3(at(0.2, 0.3)))
    assert resident_bytes(bitmap) == 64 * 32 * padded
    assert 64 * 32 * padded in stored(capfd).values()


def test_the_string_shows_them():
    tex = texture(gaussians())
    assert f"resident_bytes = {resident_bytes(tex)}," in str(tex)


# --- 16 bytes for a Gaussian ---

PREFILTERS = [0.0, 0.05]

LOSS = 2e-3
"""What colours lose at most: 20 Gaussians overlap, with colours of 0.04 and errors of their weights
of some 2^-10 each; decoding to light and a prefilter add little."""


def seen(tex):
    return picture(tex.eval_3(in_front(texel_centres())))


def is_coded(tex):
    return tex.table.packed.coding is not None


def test_bytes_for_a_gaussian(tmp_path):
    """Of a photo of 32 pixels for each, as it is placed."""
    image = eg.sample("coffee")[100:260, 200:360]
    g = eg.fit(image, 800, 0, backend=backend(), progress=False).gaussians
    file = in_a_file(tmp_path, g)
    held = {
        name: resident_bytes(mi.load_dict({**file, "memory": name})) / 800
        for name in ("exact", "normal", "small")
    }
    assert held["normal"] <= 66 and held["small"] <= 38
    # The rows are half as long, and there are no parameters.
    assert held["exact"] - held["normal"] == pytest.approx(48, abs=1)
    assert resident_bytes(mi.load_dict(file)) == pytest.approx(800 * held["normal"], abs=100)


@pytest.mark.parametrize("prefilter", PREFILTERS)
@pytest.mark.parametrize("memory", ["normal", "small"])
def test_pictures_lose_little(tmp_path, prefilter, memory):
    file = in_a_file(tmp_path, prefilter=prefilter)
    exact = mi.load_dict({**file, "memory": "exact"})
    np.testing.assert_array_equal(seen(exact), seen(texture(gaussians(), prefilter=prefilter)))
    tex = mi.load_dict({**file, "memory": memory})
    assert is_coded(tex) and not is_coded(exact)
    np.testing.assert_allclose(seen(tex), seen(exact), atol=LOSS)
    slopes = [np.array(t.eval_1_grad(in_front(texel_centres()))) for t in (tex, exact)]
    np.testing.assert_allclose(*slopes, atol=0.02 * np.abs(slopes[1]).max())


def test_cells_of_another_size_change_no_sum(tmp_path):
    file = in_a_file(tmp_path)
    pictures = [seen(mi.load_dict({**file, "memory": name})) for name in ("normal", "small")]
    np.testing.assert_allclose(*pictures, atol=1e-6)


@pytest.mark.parametrize("prefilter", PREFILTERS)
def test_maps_of_a_file_lose_little(tmp_path, prefilter):
    material(size=SIZE, backend=backend()).save(tmp_path / "m.npz")
    file = {"type": "gaussian_texture", "filename": str(tmp_path / "m.npz"), "prefilter": prefilter}
    for name in ("albedo", "roughness", "normal"):
        tex, exact = (
            mi.load_dict({**file, "map": name, "memory": memory}) for memory in ("normal", "exact")
        )
        values = [np.array(t.eval(in_front(texel_centres()))) for t in (tex, exact)]
        np.testing.assert_allclose(*values, atol=5 * LOSS)
        assert is_coded(tex)


def test_parameters_are_made_when_they_are_asked_for(tmp_path):
    tex = mi.load_dict(in_a_file(tmp_path))
    before, held = seen(tex), resident_bytes(tex)
    parameters = mi.traverse(tex)
    assert resident_bytes(tex) == held + 4 * 8 * len(gaussians()) + 4 * 3
    np.testing.assert_array_equal(seen(tex), before)
    for name, tensor in eg.to_tensors(gaussians()).items():
        np.testing.assert_array_equal(np.array(parameters[name]), np.array(tensor))


def test_nothing_but_traverse_asks_for_parameters(tmp_path):
    """Neither a mean, nor a lamp, nor a camera that is followed, nor Mitsuba itself."""
    file = in_a_file(tmp_path)
    scene = small_scene({"type": "plastic", "diffuse_reflectance": file})
    follow(scene)
    [tex] = plugins_of(scene)
    exact = texture(gaussians(), prefilter=0.05)
    exact.follow(scene.sensors()[0])
    np.testing.assert_allclose(seen(tex), seen(exact), atol=2 * LOSS)  # of words again made words
    mi.render(scene, spp=1)
    tex.mean(), tex.max(), str(tex)
    tex.traverse(mi.TraversalCallback())  # as C++ of Mitsuba 3.10 looks for textures to filter
    dr.eval(tex.sample_position(mi.Point2f(0.3, 0.4)))
    assert "tensors" not in vars(tex.source) and is_coded(tex)


@pytest.mark.parametrize("prefilter", PREFILTERS)
@pytest.mark.parametrize("space", ["rgb", "ycbcr", "linear"])
def test_without_its_file_a_texture_shows_what_its_rows_hold(tmp_path, space, prefilter):
    g = gaussians(space)
    tex = mi.load_dict(in_a_file(tmp_path, g, prefilter=prefilter))
    (tmp_path / "set.npz").unlink()
    found = gaussians_of(mi.traverse(tex), "", like=g).to_arrays()
    for name, values in g.to_arrays().items():
        np.testing.assert_allclose(found[name], values, rtol=4e-3, atol=2e-3, err_msg=name)


def test_maps_without_their_file_show_what_rows_hold(tmp_path):
    whole = material(size=SIZE, backend=backend())
    whole.save(tmp_path / "m.npz")
    file = {"type": "gaussian_texture", "filename": str(tmp_path / "m.npz")}
    textures = {m.name: mi.load_dict({**file, "map": m.name}) for m in whole.maps}
    (tmp_path / "m.npz").write_bytes(b"another one")
    for name, tex in textures.items():
        found = gaussians_of(mi.traverse(tex), "", like=whole[name]).to_arrays()
        for key, values in whole[name].to_arrays().items():
            np.testing.assert_allclose(found[key], values, rtol=4e-3, atol=2e-3, err_msg=key)


def test_the_rows_of_several_bands_are_in_the_order_of_the_set(tmp_path, monkeypatch):
    from eigengs_dr.raster.lookup import cells

    monkeypatch.setattr(cells, "MOST", 20)
    random = np.random.default_rng(0)
    arrays = random.uniform(0, 1, (60, 2)) * (64, 256), np.tile([0.4, 0.1, 0.5], (60, 1))
    color = random.uniform(-0.1, 0.1, (60, 3))
    options = {"size": (64, 256), "space": "linear", "backend": backend()}
    g = eg.Gaussians.from_arrays(*arrays, color, [0.5] * 3, **options)
    tex = mi.load_dict(in_a_file(tmp_path, g))
    assert dr.width(tex.table.lists.cells.first) > 1 and is_coded(tex)
    (tmp_path / "set.npz").unlink()
    found = gaussians_of(mi.traverse(tex), "", like=g).to_arrays()
    np.testing.assert_allclose(found["mean"], arrays[0], atol=1e-3)
    np.testing.assert_allclose(found["color"], color, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("integrator", ["direct", "prb"])
@pytest.mark.parametrize("prefilter", PREFILTERS)
def test_derivatives_are_those_of_a_texture_of_floats(tmp_path, integrator, prefilter):
    found = []
    for given in (in_a_file(tmp_path), texture_of(gaussians())):
        bsdf = {"type": "diffuse", "reflectance": {**given, "prefilter": prefilter}}
        scene = small_scene(bsdf, integrator)
        parameters = mi.traverse(scene)
        parameters.keep(r".*reflectance\.(mean|factor|color|background)")
        for key, value in parameters:
            dr.enable_grad(value)
            parameters[key] = value
        parameters.update()
        image = mi.render(scene, parameters, spp=4, seed=1)
        dr.backward(dr.sum(dr.square(image), axis=None))
        found.append([np.array(dr.grad(value)) for _, value in parameters])
    assert len(found[0]) == 4
    for ours, expected in zip(*found, strict=True):
        assert np.abs(expected).max() > 1e-3
        np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


def test_frozen_renderings_follow_a_texture_that_becomes_one_of_floats(tmp_path):
    scene = small_scene({"type": "diffuse", "reflectance": in_a_file(tmp_path)})
    frozen = dr.freeze(lambda scene, seed: mi.render(scene, spp=4, seed=seed))
    for step in range(4):
        if step > 1:
            parameters = mi.traverse(scene)
            key = next(key for key, _ in parameters if key.endswith("reflectance.color"))
            parameters[key] = 0.9 * parameters[key]
            parameters.update()
        shown = np.array(frozen(scene, mi.UInt32(step)))
        np.testing.assert_allclose(shown, np.array(mi.render(scene, spp=4, seed=step)), atol=1e-6)


def test_a_frozen_function_may_be_the_first_to_ask(tmp_path):
    scene = small_scene({"type": "diffuse", "reflectance": in_a_file(tmp_path)})

    def render(scene, seed):
        return mi.render(scene, mi.traverse(scene), spp=4, seed=seed)

    frozen = dr.freeze(render)
    shown = [np.array(frozen(scene, mi.UInt32(step))) for step in range(3)]
    for step, image in enumerate(shown):
        np.testing.assert_allclose(image, np.array(render(scene, step)), atol=1e-6)


def test_what_words_do_not_hold_stays_floats(tmp_path):
    arrays = gaussians().to_arrays()
    arrays["factor"][0] = 1e-12, 0, 1
    g = eg.Gaussians.from_arrays(**arrays, size=SIZE, space="rgb", backend=backend())
    tex = mi.load_dict(in_a_file(tmp_path, g))
    assert not is_coded(tex)
    np.testing.assert_array_equal(seen(tex), seen(texture(g)))


def test_light_above_65504(tmp_path):
    arrays = gaussians("radiance").to_arrays()
    arrays["color"] = np.abs(arrays["color"]) * (1e6 / np.abs(arrays["color"]).max())
    g = eg.Gaussians.from_arrays(**arrays, size=SIZE, space="radiance", backend=backend())
    whole = {"cutoff": 8.0}  # at the usual one, the sun has an edge of 1 %
    tex = mi.load_dict(in_a_file(tmp_path, g, **whole))
    assert is_coded(tex)
    exact = seen(texture(g, **whole))
    assert exact.max() > 1e5
    np.testing.assert_allclose(seen(tex), exact, rtol=0.02, atol=LOSS)


@pytest.mark.parametrize("prefilter", PREFILTERS)
def test_an_environment_loses_little(tmp_path, prefilter):
    sky().save(tmp_path / "sky.npz")
    file = {"type": "gaussian_environment", "filename": str(tmp_path / "sky.npz")}
    lights = [  # at the usual cutoff, Gaussians have edges of 1 %
        mi.load_dict({**file, "prefilter": prefilter, "cutoff": 8.0, "memory": name})
        for name in ("normal", "exact", "small")
    ]
    si = dr.zeros(mi.SurfaceInteraction3f, 500)
    si.wi = mi.warp.square_to_uniform_sphere(uniform(500))
    coded, exact, small = (np.array(light.eval(si)) for light in lights)
    assert is_coded(lights[0]) and not is_coded(mi.load_dict(environment_of(sky())))
    np.testing.assert_allclose(coded, exact, rtol=0.01, atol=1e-3 * exact.max())
    np.testing.assert_allclose(small, coded, rtol=1e-4, atol=1e-5 * exact.max())
    sizes = [resident_bytes(light) for light in lights]
    assert sizes[2] < sizes[0] < sizes[1]


def test_a_model_of_lights_loses_little(tmp_path):
    lights = directions(30)
    options = {"gaussians": 80, "planes": 4, "iterations": 5, "backend": backend()}
    eg.Relightable.fit(photos(lights), lights, **options, progress=False).save(tmp_path / "m.npz")
    file = {"type": "gaussian_texture", "model": str(tmp_path / "m.npz")}
    tex, exact = (mi.load_dict({**file, "memory": name}) for name in ("normal", "exact"))
    assert is_coded(tex) and not is_coded(exact)
    assert resident_bytes(exact) - resident_bytes(tex) == pytest.approx(16 * 80, abs=100)
    np.testing.assert_allclose(seen(tex), seen(exact), atol=5 * LOSS)
    for light in ([0.3, -0.4, 0.8], [0.0, 0.1, 1.0]):
        for one in (tex, exact):
            parameters = mi.traverse(one)
            parameters["light"] = mi.Vector3f(*light)
            parameters.update()
        np.testing.assert_array_equal(seen(tex), seen(exact))  # it has changed: floats
    file["type"] = "gaussian_relightable"
    tex, exact = (mi.load_dict({**file, "memory": name}).planes for name in ("normal", "exact"))
    assert is_coded(tex) and not is_coded(exact)
    # Rows of 8 words instead of 12 numbers, and no parameters: 9 numbers.
    assert resident_bytes(exact) - resident_bytes(tex) == pytest.approx(52 * 80, abs=100)
    si = in_front(texel_centres())
    values = [np.array(mi.Float(sum(one.values(si, mi.Bool(True))))) for one in (tex, exact)]
    np.testing.assert_allclose(*values, atol=5 * LOSS)


def test_a_memory_that_is_none():
    with pytest.raises(RuntimeError, match="memory is 'tiny'; it must be one of exact, normal, sm"):
        texture(gaussians(), memory="tiny")
