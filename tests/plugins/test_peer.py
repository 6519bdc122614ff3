"""What a bitmap does too: every method, loading in threads, frozen renderings, names."""

import copy
import pickle

import drjit as dr
import numpy as np
import pytest

from _helpers.kernels import launches
from _helpers.sets import COUNT, SIZE
from _helpers.texture import at, gaussians, mi, small_scene, texture
from _helpers.variants import in_all, in_variants, on_both
from eigengs_dr.backend.recording import collector_off
from eigengs_dr.plugins import texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


@in_all
def test_no_method_is_missing(variant):
    """All of `mitsuba.Texture` but what Python inherits from `mitsuba.Object`."""
    tex = texture(gaussians("linear"), id="bark")
    si = at(mi.Float([0.2, 0.7]), mi.Float([0.4, 0.1]))
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(400.0, 500.0, 600.0, 700.0)
    sample = si.wavelengths * 0 + 0.5 if mi.is_spectral else mi.Color0f()
    for value in (
        tex.eval(si),
        tex.eval_1(si),
        tex.eval_3(si),
        tex.eval_1_grad(si),
        tex.mean(),
        tex.max(),
        tex.sample_position(mi.Point2f(0.3, 0.6)),
        tex.pdf_position(mi.Point2f(0.3, 0.6)),
        tex.sample_spectrum(si, sample),
        tex.pdf_spectrum(si),
        tex.spectral_resolution(),
    ):
        for part in value if isinstance(value, tuple) else (value,):
            assert np.isfinite(np.array(part)).all()
    assert tuple(tex.resolution()) == SIZE
    assert tuple(tex.wavelength_range()) == (mi.MI_CIE_MIN, mi.MI_CIE_MAX)
    assert tex.is_spatially_varying() and tex.id() == "bark" and tex.variant_name() == variant


@in_variants(on_both("spectral"))
def test_sampled_wavelengths_have_their_density(variant):
    tex = texture(gaussians("rgb"))
    si = at(0.3, 0.6)
    wavelengths, weight = tex.sample_spectrum(si, type(si.wavelengths)(0.1, 0.4, 0.6, 0.9))
    si.wavelengths = wavelengths
    expected = np.array(tex.eval(si)) / np.array(tex.pdf_spectrum(si))
    np.testing.assert_allclose(np.array(weight), expected, rtol=1e-5)
    si.wavelengths = type(si.wavelengths)(359.0, 831.0, 360.5, 829.0)
    np.testing.assert_allclose(np.ravel(tex.pdf_spectrum(si)), [0, 0, 1 / 470, 1 / 470], rtol=1e-6)


def test_what_it_says_of_itself(tmp_path):
    gaussians("rgb").save(tmp_path / "bark.npz")
    bark = {"type": "gaussian_texture", "filename": str(tmp_path / "bark.npz"), "raw": True}
    turned = {"wrap_mode": "mirror", "to_uv": mi.ScalarTransform4f().scale([2, 3, 1])}
    tex = mi.load_dict(bark | turned)
    with launches() as launched:
        shown = str(tex)
    assert not launched  # to print a scene computes nothing
    for part in (
        'name = "bark.npz"',
        f"gaussians = {COUNT}",
        f"resolution = [{SIZE[0]}, {SIZE[1]}]",
        "raw = 1",
        "wrap_mode = mirror",
        "matrix=[[2, 0, 0],",
        "[0, 3, 0],",
    ):
        assert part in shown
    assert 'name = ""' in str(texture(gaussians()))


@pytest.mark.parametrize("parallel", [True, False])
def test_many_load_at_once(tmp_path, parallel):
    """Mitsuba makes the plugins of a scene in threads."""
    sets = [gaussians(seed=seed) for seed in range(8)]
    scene = {"type": "scene"}
    for i, g in enumerate(sets):
        g.save(tmp_path / f"{i}.npz")
        file = {"type": "gaussian_texture", "filename": str(tmp_path / f"{i}.npz")}
        tex = file if i % 2 else texture_of(g, prefilter=0.01)
        scene[f"b{i}"] = {"type": "roughplastic", "diffuse_reflectance": tex}
    shapes = {f"s{i}": {"type": "sphere", "bsdf": {"type": "ref", "id": f"b{i}"}} for i in range(8)}
    parameters = mi.traverse(mi.load_dict({**scene, **shapes}, parallel=parallel, optimize=False))
    for i, g in enumerate(sets):
        found = np.array(parameters[f"b{i}.diffuse_reflectance.color"])
        np.testing.assert_allclose(found, g.to_arrays()["color"], atol=1e-6)


class TestFrozen:
    """As with a bitmap, the parameters change between the calls, not inside them."""

    @pytest.mark.parametrize("prefilter", [0.0, 0.02])
    def test_a_rendering_follows_the_parameters(self, prefilter):
        """One by one, several at once, and colours alone after shapes, which keep the lists."""
        bsdf = {"type": "diffuse", "reflectance": texture_of(gaussians(), prefilter=prefilter)}
        every = ["color", "background", "mean", "factor"]
        several = [["color", "background"], every, ["color"], ["color"], ["to_uv"], ["to_uv"]]
        self.check(small_scene(bsdf), [[], *([name] for name in every), *several])

    def test_a_light_that_was_sampled_before(self):
        emitter = {"type": "area", "radiance": texture_of(gaussians("linear"))}
        scene = small_scene(None, emitter=emitter)
        mi.render(scene, spp=1)
        self.check(scene, [[], *[["color"]] * 4])

    @staticmethod
    def check(scene, changes):
        parameters, frozen = mi.traverse(scene), dr.freeze(collector_off()(mi.render))
        for step, names in enumerate(changes):
            for name in names:
                key = next(k for k in parameters.keys() if k.endswith(f".{name}"))  # noqa: SIM118
                shrunk = mi.ScalarTransform3f().scale(1 - 0.05 * step)
                parameters[key] = shrunk if name == "to_uv" else parameters[key] * 0.9
            parameters.update()
            seed = mi.UInt32(step)
            found, expected = (draw(scene, spp=4, seed=seed) for draw in (frozen, mi.render))
            np.testing.assert_allclose(np.array(found), np.array(expected), atol=1e-6)
        assert frozen.n_recordings <= 3  # the first calls record, all others replay


@pytest.mark.parametrize("space", ["ycbcr", "log"])
def test_copies_of_a_set_are_its_own(space):
    g = gaussians(space)
    twins = copy.deepcopy(g), pickle.loads(pickle.dumps(g))
    expected = np.array(texture(g).eval(at(0.3, 0.4)))
    g.color *= 2
    for twin in twins:
        assert g == g and twin != g
        assert (twin.width, twin.height, twin.space, twin.cutoff) == (*SIZE, space, g.cutoff)
        np.testing.assert_array_equal(np.array(texture(twin).eval(at(0.3, 0.4))), expected)
