"""What a texture holds, which it says, and what it loses where it holds less."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.derivatives import SIDE, check_gradients
from _helpers.frozen import check_frozen
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
from eigengs_dr.plugins import (
    bake_environment,
    environment_of,
    follow,
    gaussians_of,
    resident_bytes,
)

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

LOSS = 2e-3
"""What colours lose at most: 20 Gaussians overlap, with colours of 0.04 and errors of their weights
of some 2^-10 each; decoding to light and a prefilter add little."""


def in_a_file(folder, g=None, **properties):
    """The dictionary of a texture of a file."""
    path = folder / "set.npz"
    (gaussians() if g is None else g).save(path)
    return {"type": "gaussian_texture", "filename": str(path), **properties}


def seen(tex):
    return picture(tex.eval_3(in_front(texel_centres())))


class TestBytes:
    @pytest.mark.slow
    def test_of_a_gaussian(self, tmp_path):
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

    def test_of_derivatives_and_of_sampled_light(self):
        tex = texture(gaussians())
        assert f"resident_bytes = {resident_bytes(tex)}," in str(tex)
        parameters = mi.traverse(tex)
        held, number = resident_bytes(tex), len(np.ravel(parameters["color"]))
        dr.eval(tex.sample_position(mi.Point2f(0.3, 0.4)))
        with_light = resident_bytes(tex)
        assert with_light >= held + 2 * 4 * SIZE[0] * SIZE[1]
        dr.enable_grad(parameters["color"])
        parameters.update()
        dr.backward(dr.sum(tex.eval_1(at(0.3, 0.6))))
        dr.eval(dr.grad(parameters["color"]))
        assert resident_bytes(tex) >= held + 4 * number

    @pytest.mark.texture_units
    @pytest.mark.parametrize(("channels", "padded"), [(1, 1), (3, 4)])
    def test_of_a_bitmap_are_those_of_its_texels(self, channels, padded):
        """As Dr.Jit stores them from the first rendering on."""
        scene = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((64, 32, channels), np.uint8))}
        assert resident_bytes(mi.load_dict(scene | {"raw": True})) == 64 * 32 * padded

    @pytest.mark.texture_units
    def test_of_an_environment_are_fewer_than_those_of_an_envmap(self):
        """Which has 16 bytes of a texel, and 4 x 7/3 of the sampling table."""
        g = sky(count=500, size=(512, 256), deviation=(3.0, 20.0))
        sums, texels = (
            resident_bytes(mi.load_dict(make(g))) for make in (environment_of, bake_environment)
        )
        assert sums < 0.2 * texels
        assert texels == pytest.approx(512 * 256 * (16 + 28 / 3), rel=0.02)


class TestLoss:
    @pytest.mark.parametrize(("memory", "prefilter"), [("small", 0.0), ("normal", 0.05)])
    def test_pictures_lose_little(self, tmp_path, memory, prefilter):
        file = in_a_file(tmp_path, prefilter=prefilter)
        exact = mi.load_dict({**file, "memory": "exact"})
        np.testing.assert_array_equal(seen(exact), seen(texture(gaussians(), prefilter=prefilter)))
        tex = mi.load_dict({**file, "memory": memory})
        assert resident_bytes(tex) < resident_bytes(exact)
        np.testing.assert_allclose(seen(tex), seen(exact), atol=LOSS)
        slopes = [np.array(t.eval_1_grad(in_front(texel_centres()))) for t in (tex, exact)]
        np.testing.assert_allclose(*slopes, atol=0.02 * np.abs(slopes[1]).max())

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("factor", (1e-12, 0, 1)),  # an endless one
            ("factor", (1e6, 0, 1)),  # a narrow one, for which a step of a mean is far
            ("mean", (1e6, 3)),
            ("color", (1e7, 0, 0)),  # beside its light the others would lose their bits
        ],
    )
    def test_what_words_do_not_hold_stays_floats(self, tmp_path, name, value):
        arrays = gaussians().to_arrays()
        arrays[name][0] = value
        g = eg.Gaussians.from_arrays(**arrays, size=SIZE, space="linear", backend=backend())
        np.testing.assert_array_equal(seen(mi.load_dict(in_a_file(tmp_path, g))), seen(texture(g)))

    @pytest.mark.slow
    def test_an_environment_loses_little(self, tmp_path):
        sky().save(tmp_path / "sky.npz")
        file = {"type": "gaussian_environment", "filename": str(tmp_path / "sky.npz")}
        lights = [  # at the usual cutoff, Gaussians have edges of 1 %
            mi.load_dict({**file, "prefilter": 0.05, "cutoff": 8.0, "memory": name})
            for name in ("small", "exact")
        ]
        si = dr.zeros(mi.SurfaceInteraction3f, 500)
        si.wi = mi.warp.square_to_uniform_sphere(uniform(500))
        small, exact = (np.array(light.eval(si)) for light in lights)
        np.testing.assert_allclose(small, exact, rtol=0.01, atol=1e-3 * exact.max())
        assert resident_bytes(lights[0]) < resident_bytes(lights[1])


class TestParameters:
    def test_are_made_when_they_are_asked_for(self, tmp_path):
        tex = mi.load_dict(in_a_file(tmp_path))
        before, held = seen(tex), resident_bytes(tex)
        parameters = mi.traverse(tex)
        assert resident_bytes(tex) == held + 4 * 8 * len(gaussians()) + 4 * 3
        np.testing.assert_array_equal(seen(tex), before)
        for name, tensor in eg.to_tensors(gaussians()).items():
            np.testing.assert_array_equal(np.array(parameters[name]), np.array(tensor))

    def test_nothing_but_traverse_asks_for_them(self, tmp_path):
        """Neither a mean, nor a lamp, nor a camera that is followed, nor Mitsuba itself."""
        tex = mi.load_dict(in_a_file(tmp_path, prefilter=True))
        scene = small_scene({"type": "diffuse", "reflectance": tex}, "direct")
        follow(scene)
        mi.render(scene, spp=1)
        tex.mean(), tex.max(), str(tex)
        tex.traverse(mi.TraversalCallback())  # as C++ of Mitsuba 3.10 looks for textures to filter
        dr.eval(tex.sample_position(mi.Point2f(0.3, 0.4)))
        held = resident_bytes(tex)
        mi.traverse(tex)
        assert resident_bytes(tex) >= held + 4 * 8 * len(gaussians())

    def test_without_their_file_textures_show_what_their_rows_hold(self, tmp_path):
        """Also those of maps."""
        whole = material(size=SIZE, backend=backend())
        whole.save(tmp_path / "m.npz")
        maps = {"type": "gaussian_texture", "filename": str(tmp_path / "m.npz"), "prefilter": 0.05}
        given = {m.name: (mi.load_dict({**maps, "map": m.name}), whole[m.name]) for m in whole.maps}
        g = gaussians("linear")
        given["set"] = mi.load_dict(in_a_file(tmp_path, g, prefilter=0.05)), g
        (tmp_path / "m.npz").unlink()
        (tmp_path / "set.npz").unlink()
        for tex, expected in given.values():
            found = gaussians_of(mi.traverse(tex), "", like=expected).to_arrays()
            for name, values in expected.to_arrays().items():
                np.testing.assert_allclose(found[name], values, rtol=4e-3, atol=2e-3, err_msg=name)

    def test_derivatives_are_finite_differences(self, tmp_path):
        """As those of a texture of floats, which it becomes."""
        file = in_a_file(tmp_path, cutoff=6.0, prefilter=0.05)
        scene = small_scene({"type": "diffuse", "reflectance": file}, "prb", SIDE)
        check_gradients(scene, "wall.bsdf.reflectance", ["mean", "factor", "color", "background"])

    def test_frozen_renderings_follow_a_texture_that_becomes_one_of_floats(self, tmp_path):
        """Also where the frozen function is the first to ask."""
        scene = small_scene({"type": "diffuse", "reflectance": in_a_file(tmp_path)}, "direct")

        def draw(scene, seed):
            return mi.render(scene, mi.traverse(scene), spp=4, seed=seed)

        check_frozen(scene, [[], [], ["color"], ["color"]], draw=draw)
