"""Environment maps that become Gaussians, and those that stay."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.poster import camera, mi
from eigengs_dr.image.color import to_log
from eigengs_dr.scene.fit_environment import with_mean_of

pytestmark = pytest.mark.mitsuba

QUICK = {"iterations": 30, "spp": 64}


def horizon(width=128, height=64, sun=0.0):
    """A sky over a ground, with a soft sun; light shape (height, width, 3)."""
    y, x = np.mgrid[:height, :width]
    theta, phi = np.pi * y / (height - 1), 2 * np.pi * (x + 0.5) / width
    up = 1 / (1 + np.exp(8 * (theta - np.pi / 2)))
    light = up[..., None] * [0.3, 0.5, 0.9] + (1 - up)[..., None] * [0.25, 0.2, 0.15]
    away = np.square(theta - 0.9) + np.square((phi - 2) * np.sin(0.9))
    return (light + sun * np.exp(-away / (2 * 0.1**2))[..., None]).astype(np.float32)


def scene(**emitter):
    """A shiny ball under an environment map."""
    coat = {"type": "principled", "base_color": {"type": "rgb", "value": 0.6}, "roughness": 0.4}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": camera([0, 0, 4], fov=60, spp=64),
        "ball": {"type": "sphere", "bsdf": coat},
        "sky": {"type": "envmap", **emitter},
    }


@pytest.mark.parametrize("sun", [0.0, 200.0])
def test_a_smooth_sky_takes_less_memory(sun, tmp_path):
    size = (256, 128) if sun else (128, 64)  # a sun takes Gaussians
    mi.Bitmap(horizon(*size, sun)).write(str(tmp_path / "sky.pfm"))
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 50)
    given = {"filename": str(tmp_path / "sky.pfm"), "scale": 0.7, "to_world": turn}
    found = eg.convert_scene(scene(**given), tmp_path / "new", 40, iterations=100, spp=64)
    [environment] = found.textures
    assert environment.names == ("sky.pfm (sky)",)
    assert environment.file == "sky.npz"
    assert environment.psnr >= 40
    assert environment.gaussian_bytes < 0.5 * environment.bytes
    assert found.left == [] and found.better == []
    # The renderings differ by no more than their noise.
    assert found.missed(40) == []
    assert found.psnr[0] > found.noise[0] - 1
    saved = eg.Gaussians.load(tmp_path / "new" / "sky.npz")
    assert (saved.width, saved.height) == size
    assert saved.space == ("log" if sun else "linear")
    images = [
        np.array(mi.render(s, spp=256)).mean((0, 1))
        for s in (mi.load_dict(scene(**given)), mi.load_file(str(found.scene)))
    ]
    np.testing.assert_allclose(images[1], images[0], rtol=0.03)


def test_the_light_keeps_its_mean(tmp_path):
    """A fit of logarithms alone missed the blue of this light by -1.6 %."""
    light = horizon(sun=5.0)
    given, wanted = scene(bitmap=mi.Bitmap(light)), mean_on_sphere(light)
    eg.convert_scene(given, tmp_path / "new", 36, iterations=30, spp=0)
    found = eg.render(eg.Gaussians.load(tmp_path / "new" / "sky.npz"), 256, 128).numpy()
    np.testing.assert_allclose(mean_on_sphere(found), wanted, rtol=0.01)


def mean_on_sphere(light):
    """Mean of each channel; rows weigh the sine of their angle to the zenith."""
    sine = np.sin(np.pi * (np.arange(len(light)) + 0.5) / len(light))
    return np.average(light.mean(axis=1), axis=0, weights=sine)


@pytest.mark.parametrize("space", ["linear", "radiance", "log"])
@pytest.mark.parametrize("color", [0.0, 0.3])
def test_the_mean_of_one_set(space, color):
    """Also of an even light, and of a channel that is black."""
    light = np.float32([0.5, 0.3, 0]) + 0.4 * horizon(32, 16) * [color, color, 0]
    code = to_log if space == "log" else np.asarray
    g = eg.Gaussians.from_arrays(
        [[20, 4]], [[0.2, 0, 0.2]], [[color, color, 0]], code(np.float32([0.45, 0.32, 0])),
        size=(32, 16), space=space,
    )  # fmt: skip
    found = eg.render(with_mean_of(light, g), 64, 32).numpy()
    np.testing.assert_allclose(mean_on_sphere(found), mean_on_sphere(light), rtol=1e-3, atol=1e-6)


@pytest.mark.exr
def test_noise_stays(tmp_path):
    noise = np.random.default_rng(0).uniform(0, 1, (32, 64, 3)).astype(np.float32)
    found = eg.convert_scene(scene(bitmap=mi.Bitmap(noise)), tmp_path / "new", **QUICK)
    assert found.textures == []
    [(name, reason)] = found.left
    assert name == "a bitmap in memory (sky)"
    assert reason.startswith("an environment map: ")
    assert "for a goal of 40 dB" in reason
    assert found.noise == []
    assert 'type="envmap"' in found.scene.read_text()


@pytest.mark.exr
@pytest.mark.parametrize(
    ("pixels", "others", "words"),
    [
        (horizon(8, 4), {}, "8x4 texels is small"),
        (horizon() - 0.5, {}, "light below 0"),
        (horizon(), {"to_world": "scaled"}, "to_world scales or shears"),
    ],
)
def test_what_stays_and_why(pixels, others, words, tmp_path):
    if others:
        others = {"to_world": mi.ScalarTransform4f().scale(2)}
    given = scene(bitmap=mi.Bitmap(pixels), **others)
    found = eg.convert_scene(given, tmp_path / "new", iterations=10, spp=0)
    [(_, reason)] = found.left
    assert words in reason


@pytest.mark.exr
def test_a_low_goal_is_met(tmp_path):
    given = scene(bitmap=mi.Bitmap(horizon()))
    found = eg.convert_scene(given, tmp_path / "new", 5, iterations=10, spp=0, replace_all=True)
    assert found.left == [] and found.textures[0].psnr > 5


def test_gaussians_that_are_there_stay(tmp_path):
    """Also from memory: they become a file."""
    from eigengs_dr.plugins import environment_of

    sky = eg.Gaussians.from_arrays(
        [[32, 8]], [[0.1, 0, 0.1]], [[1, 1, 2]], [0.2, 0.2, 0.2], size=(64, 32), space="radiance"
    )
    given = {**scene(), "sky": environment_of(sky, scale=2.0)}
    found = eg.convert_scene(given, tmp_path / "new", spp=4)
    assert found.textures == [] and found.psnr[0] > 60
    assert mi.load_file(str(found.scene)).environment() is not None
