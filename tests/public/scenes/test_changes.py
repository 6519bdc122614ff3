"""After a change, lookups are those of a texture that is made so, in frozen programs too."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.frozen import check_frozen
from _helpers.kernels import launches
from _helpers.sets import SIZE
from _helpers.skies import lit, sky
from _helpers.texture import backend, gaussians, in_front, mi, small_scene, texel_centres, texture
from eigengs_dr.plugins import environment_of, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

COLORS, SHAPES = ("color", "background"), ("mean", "factor")
ALL = (*SHAPES, *COLORS)
WALKS = {
    "colours": [("color",), ("background",), ("mean",), ("factor",), COLORS, ALL, ALL],
    "shapes": [("mean",), ("color",)],
    "all": [ALL, ("factor",), ALL, ("background",)],
}
"""Colours, shapes, or both: each of them first, and each of them after each of them."""


def views():
    """Points that are seen from near, and from so far that their footprints are wide."""
    return [in_front(texel_centres(), distance) for distance in (0.5, 20.0)]


def seen(tex):
    return np.concatenate([np.array(tex.eval_3(si)) for si in views()])


def moved(parameters, names, seed):
    """Change parameters by a few percent; return the set that has them."""
    random = np.random.default_rng(seed)
    for name in names:
        value = np.array(parameters[name])
        factor = 1 + 0.1 * random.uniform(-1, 1, value.shape)
        parameters[name] = mi.TensorXf(np.float32(value * factor))
    parameters.update()
    arrays = [np.array(parameters[name]) for name in (*SHAPES, "color")]
    last = np.array(parameters["background"]).ravel()
    return eg.Gaussians.from_arrays(*arrays, last, size=SIZE, space="linear", backend=backend())


@pytest.mark.parametrize("walk", WALKS)
def test_lookups_are_those_of_a_new_texture(walk):
    tex = texture(gaussians("linear"), prefilter=0.02)
    parameters, before = mi.traverse(tex), seen(tex)
    for seed, names in enumerate(WALKS[walk]):
        fresh = texture(moved(parameters, names, seed), prefilter=0.02)
        found = seen(tex)
        np.testing.assert_array_equal(found, seen(fresh))
        assert np.abs(found - before).max() > 1e-4


@pytest.mark.parametrize("of_file", [False, True])
def test_colours_alone_keep_the_lists(of_file, tmp_path):
    """They launch far fewer programs than means."""
    gaussians("linear").save(tmp_path / "x.npz")
    file = {"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")}
    tex = mi.load_dict(
        {**(file if of_file else texture_of(gaussians("linear"))), "prefilter": 0.02}
    )
    parameters, counts = mi.traverse(tex), {}
    for names in (COLORS, COLORS, ("mean",)):  # a file makes its parameters in the first one
        with launches() as launched:
            moved(parameters, names, 0)
            seen(tex)
        counts[names] = len(launched)
    assert counts[COLORS] < 0.5 * counts["mean",]


MANY, WIDE = 70_000, (512, 256)


@pytest.mark.slow
def test_a_file_of_more_gaussians_than_16_bits_number(tmp_path):
    """A change of colours finds their rows in each band, and so does what is read from rows."""
    random = np.random.default_rng(0)
    arrays = random.uniform(0, 1, (MANY, 2)) * WIDE, np.tile([0.8, 0.1, 0.9], (MANY, 1))
    color = random.uniform(-0.02, 0.02, (MANY, 3))
    options = {"size": WIDE, "space": "linear", "backend": backend()}
    sets = [eg.Gaussians.from_arrays(*arrays, k * color, [0.5] * 3, **options) for k in (1, 0.5)]
    expected = [seen(texture(g)) for g in sets]
    sets[0].save(tmp_path / "x.npz")
    file = {"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")}
    tex, other = mi.load_dict(file), mi.load_dict({**file, "cutoff": 2.9})
    np.testing.assert_allclose(seen(tex), expected[0], atol=1e-3)  # of words of 16 bits
    parameters = mi.traverse(tex)
    parameters["color"] = 0.5 * parameters["color"]
    parameters.update()
    np.testing.assert_allclose(seen(tex), expected[1], atol=2e-5)
    (tmp_path / "x.npz").unlink()
    held = mi.traverse(other)
    np.testing.assert_allclose(np.array(held["mean"]), arrays[0], atol=0.01)
    np.testing.assert_allclose(np.array(held["color"]), color, rtol=2e-3, atol=1e-5)


def derivatives(tex):
    """The gradient of squared lookups by the colours."""
    parameters = mi.traverse(tex)
    dr.enable_grad(parameters["color"])
    parameters.update()
    dr.backward(sum(dr.sum(dr.squared_norm(tex.eval_3(si))) for si in views()))
    return np.array(dr.grad(parameters["color"]))


def test_derivatives_of_colours_are_those_of_a_new_texture():
    """Also where nothing had derivatives when lists were made."""
    tex = texture(gaussians("linear"), prefilter=0.02)
    fresh = texture(moved(mi.traverse(tex), ("color",), 0), prefilter=0.02)
    found, expected = (derivatives(t) for t in (tex, fresh))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert np.abs(found).max() > 1e-4


class TestFrozen:
    """As with a bitmap, the parameters change between the calls, not inside them."""

    def test_a_rendering_follows_the_parameters(self):
        """One by one, several at once, and colours alone after shapes, which keep the lists."""
        bsdf = {"type": "diffuse", "reflectance": texture_of(gaussians(), prefilter=0.02)}
        every = ["color", "background", "mean", "factor"]
        several = [["color", "background"], every, ["color"], ["color"], ["to_uv"], ["to_uv"]]
        check_frozen(small_scene(bsdf), [[], *([name] for name in every), *several])

    def test_a_light_that_was_sampled_before(self):
        emitter = {"type": "area", "radiance": texture_of(gaussians("linear"))}
        scene = small_scene(None, emitter=emitter)
        mi.render(scene, spp=1)
        check_frozen(scene, [[], *[["color"]] * 4])

    def test_a_sky_that_turns(self):
        scene = lit(environment_of(sky()), "direct", 12)
        check_frozen(scene, [[], *[["sky.color", "sky.to_world"]] * 3], most=4)

    def test_a_sky_whose_colours_change_is_sampled_anew(self):
        light = mi.load_dict(environment_of(sky()))
        scene = lit(light, "direct", 12)
        check_frozen(scene, [[], *[["sky.color"]] * 4], most=4, plugins=[light])
