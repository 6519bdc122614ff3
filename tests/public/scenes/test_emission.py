"""Emission of the texture: its mean, its maximum, what is sampled, and how it lights."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.chi_square import assert_density
from _helpers.light import LUMINANCE, to_linear
from _helpers.sets import SIZE
from _helpers.texture import at, backend, gaussians, mi, small_scene, texel_centres, texture
from _helpers.variants import BOTH_RGB_AND_SLOW_SPECTRAL, in_variants, on_both
from eigengs_dr.plugins import texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


def lamps(deviation, count=40, side=256, space="linear"):
    """Small round lights on black, some across the border, and their mean in closed form."""
    rng = np.random.default_rng(0)
    mean = rng.uniform(8, side - 8, (count, 2)).astype(np.float32)
    factor = np.tile(np.float32([1 / deviation, 0, 1 / deviation]), (count, 1))
    color = np.repeat(rng.uniform(0.5, 0.9, (count, 1)), 3, axis=1).astype(np.float32)
    options = {"size": (side, side), "space": space, "backend": backend()}
    g = eg.Gaussians.from_arrays(mean, factor, color, **options)
    mass = 2 * np.pi * deviation**2 * -np.expm1(-0.5 * g.cutoff**2)
    return g, color[:, 0].sum(dtype=np.float64) * mass / side**2


class TestMean:
    @pytest.mark.parametrize("deviation", [0.03, 2.0])
    def test_is_the_integral_however_small_the_gaussians_are(self, deviation):
        g, expected = lamps(deviation)
        assert np.array(texture(g).mean()).item() == pytest.approx(expected, rel=2e-3)

    @pytest.mark.parametrize("scale", [0.37, 3.0])
    def test_over_what_to_uv_shows(self, scale):
        """Repeats count as often as they show; a part of the texture has its own mean."""
        tex = texture(gaussians("linear"), to_uv=mi.ScalarTransform4f().scale(scale))
        line = np.float32((np.arange(300) + 0.5) / 300)
        u, v = np.meshgrid(line, line)
        seen = tex.eval_1(at(mi.Float(u.ravel()), mi.Float(v.ravel())))
        assert np.array(tex.mean()).item() == pytest.approx(np.array(seen).mean(), rel=3e-3)

    def test_of_clamped_and_decoded_values(self):
        g = gaussians("ycbcr", quiet=False)
        dense = np.clip(eg.render(g, SIZE[0] * 10).numpy(), 0, 1)
        light = to_linear(dense) @ LUMINANCE
        tex = texture(g)
        assert np.array(tex.mean()).item() == pytest.approx(light.mean(), rel=0.01)
        assert tex.max() == pytest.approx(light.max(), abs=0.02)

    @in_variants(on_both("spectral"))
    def test_of_spectra_is_over_wavelengths(self, variant):
        tex = texture(gaussians("rgb"))
        si = texel_centres()
        total = 0
        lengths = np.linspace(mi.MI_CIE_MIN, mi.MI_CIE_MAX, 95)
        for first in range(0, 92, 4):
            si.wavelengths = type(si.wavelengths)(*lengths[first : first + 4].tolist())
            dr.make_opaque(si.wavelengths)
            total += np.array(tex.eval(si), np.float64).mean() / 23
        assert np.array(tex.mean()).item() == pytest.approx(total, rel=0.01)


class TestSampling:
    @pytest.mark.parametrize("deviation", [0.3, 3.0])
    def test_small_lamps_are_found(self, deviation):
        """One sample estimates their light to 40 %; evenly spread samples to 1,000 % or more."""
        g, expected = lamps(deviation)
        tex = texture(g)
        rng = np.random.default_rng(1)
        sample = mi.Point2f(*(mi.Float(rng.random(50_000, np.float32)) for _ in "uv"))
        position, density = tex.sample_position(sample)
        found = np.array(tex.eval_1(at(position.x, position.y)) / density)
        assert found.mean() == pytest.approx(expected, rel=0.02)
        assert found.std() < 0.4 * expected
        assert np.array(tex.pdf_position(mi.Point2f(1.5, 0.5))) == 0
        np.testing.assert_allclose(
            np.array(tex.pdf_position(position)), np.array(density), rtol=1e-4
        )

    def test_chi_square(self):
        from mitsuba.chi2 import PlanarDomain

        turn = mi.ScalarTransform4f().rotate([0, 0, 1], 20) @ mi.ScalarTransform4f().scale(1.3)
        tex = texture(gaussians("linear", quiet=False), wrap_mode="mirror", to_uv=turn)
        square = PlanarDomain(mi.ScalarBoundingBox2f([0, 0], [1, 1]))
        assert_density(
            lambda sample: tex.sample_position(sample)[0], tex.pdf_position, square, 200_000, 16
        )

    def test_what_is_below_zero_is_not_sampled(self):
        """Of a raw texture, whose values are not clamped."""
        g = gaussians("linear", quiet=False)
        g.background *= 0
        g.color *= 5
        tex = texture(g, raw=True)
        dark = np.array(tex.eval_1(texel_centres())) < -1
        density = np.array(tex.pdf_position(texel_centres().uv))
        assert dark.any()
        assert density[dark].max() < 0.1 * density.max()

    def test_a_black_picture_is_sampled_evenly(self):
        g = gaussians("linear")
        g.color *= 0
        g.background *= 0
        density = np.array(texture(g, raw=True).pdf_position(mi.Point2f(0.3, 0.7)))
        assert density == pytest.approx(1)


@pytest.mark.parametrize("space", ["linear", "log"])
def test_a_lamp_lights_as_a_bitmap_of_the_same_picture_does(space):
    """Also above 1."""
    g = gaussians(space, quiet=False)
    data = np.clip(eg.render(g, SIZE[0] * 8).numpy(), 0, 1 if space == "linear" else None)
    bitmap = {"type": "bitmap", "data": mi.TensorXf(data), "raw": True, "wrap_mode": "clamp"}
    means = []
    for radiance in (texture_of(g), bitmap):
        scene = small_scene(None, emitter={"type": "area", "radiance": radiance})
        means.append(np.array(mi.render(scene, spp=256, seed=1)).mean(axis=(0, 1)))
    np.testing.assert_allclose(means[0], means[1], rtol=0.02)


@in_variants(BOTH_RGB_AND_SLOW_SPECTRAL)
def test_particles_leave_it_as_paths_find_it(variant):
    """Light traced from the emitter, which samples positions and wavelengths of the texture."""
    emitter = {"type": "area", "radiance": texture_of(gaussians("linear", quiet=False))}
    scene = small_scene(None, emitter=emitter)
    means = [
        np.array(mi.render(scene, integrator=mi.load_dict({"type": t, "max_depth": 3}), spp=64))
        for t in ("path", "ptracer")
    ]
    np.testing.assert_allclose(*(m.mean(axis=(0, 1)) for m in means), rtol=0.05)


def test_a_lamp_renders_inside_of_the_lock():
    """The survey is made in another thread, for which the thread that holds the lock waits."""
    scene = small_scene(None, emitter={"type": "area", "radiance": texture(gaussians("linear"))})
    with eg.exclusive():
        image = mi.render(scene, spp=1)
        dr.eval(image)
    assert np.isfinite(np.array(image)).all()
