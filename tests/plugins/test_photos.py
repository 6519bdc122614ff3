"""Photos as a loss: a wall under a sky of light, seen by three cameras."""

import math

import numpy as np
import pytest

import eigengs_dr as eg

mi = pytest.importorskip("mitsuba")
pytestmark = pytest.mark.mitsuba

SIDE = 24


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def wall(texture, light=1.0, normals=None, sky=None):
    """A diffuse wall under the same light from all sides: it looks like its texture."""
    at, cameras = mi.ScalarTransform4f(), {}
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "pixel_format": "rgb"}
    film["rfilter"] = {"type": "box"}
    for number, x in enumerate((-1, 0, 1)):
        view = at.look_at([x, 0, 2.6], [0, 0, 0], [0, 1, 0])
        cameras[f"camera{number}"] = {"type": "perspective", "film": film, "to_world": view}
    paint = texture
    if not isinstance(texture, dict):
        data = mi.TensorXf(np.ascontiguousarray(texture, np.float32))
        paint = {"type": "bitmap", "data": data, "raw": True}
    coat = {"type": "diffuse", "reflectance": paint}
    if normals is not None:
        relief = {"type": "bitmap", "data": mi.TensorXf(normals), "raw": True}
        coat = {"type": "normalmap", "normalmap": relief, "paint": coat}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2},
            "sky": sky or {"type": "constant", "radiance": light},
            "wall": {"type": "rectangle", "bsdf": coat},
            **cameras,
        }
    )


def true_texture():
    x, y = np.meshgrid(np.linspace(0, 1, 32), np.linspace(0, 1, 32))
    waves = 0.5 + 0.3 * np.sin(6 * x) * np.cos(5 * y)
    return np.stack([waves, 0.6 * waves, 0.8 - 0.5 * waves], axis=2).astype(np.float32)


def photos_of(scene, spp=64):
    return [mi.render(scene, sensor=k, spp=spp, seed=77).numpy() for k in range(3)]


GREY = np.full((32, 32, 3), 0.5, np.float32)
NAME = "wall.bsdf.reflectance"


def test_a_texture_is_recovered():
    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), photos_of(wall(true_texture()))
    loss = photo_loss(scene, NAME, photos)
    assert len(repr(loss)) < 300 and "\n" not in repr(loss)
    found = eg.fit(loss=loss, size=(32, 32), gaussians=60, iterations=60)
    inner = np.s_[4:-4, 4:-4]
    error = np.mean((found.image[inner] - eg.image.color.to_coded(true_texture())[inner]) ** 2)
    assert error < 1e-3
    assert found.gaussians.space == "linear" and found.iterations == 60


def test_a_map_of_normals_starts_flat():
    """Its name says what it is, as that of `eigengs-dr fit --map`."""
    from eigengs_dr.plugins import photo_loss

    scene = wall(GREY, normals=GREY)
    loss = photo_loss(scene, {"normal": "wall.bsdf.normalmap"}, photos_of(wall(GREY)))
    result = eg.fit(loss=loss, size=(32, 32), gaussians=20, iterations=4)
    assert result.gaussians.maps[0].space == "normal"
    np.testing.assert_allclose(result.image["normal"].mean((0, 1)), [0.5, 0.5, 1], atol=0.05)


def test_photos_of_few_pixels_get_few_gaussians():
    """One for 3 pixels that steps see, and one for 4 texels if these are fewer."""
    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), photos_of(wall(true_texture()))
    seen = sum(photo.shape[0] * photo.shape[1] for photo in photos)
    loss = photo_loss(scene, NAME, photos)
    side = math.ceil(2 * math.sqrt(seen))
    few, many = (eg.fit(loss=loss, size=(s, s), iterations=2).gaussians for s in (8, side))
    assert len(few) == 16 and len(many) == seen // 3 < side**2 // 4


def test_the_derivative_is_a_forward_difference():
    """Along a random direction, through a scene; the renderings have other random numbers."""
    import drjit as dr

    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), photos_of(wall(true_texture()))
    loss = photo_loss(scene, NAME, [mi.TensorXf(photo) for photo in photos], spp=256)
    random = np.random.default_rng(1)
    texture, along = random.uniform(0.3, 0.7, (2, 32, 32, 3)).astype(np.float32)
    picture = mi.TensorXf(texture)
    dr.enable_grad(picture)
    dr.backward(loss.function(picture, 1))
    slope = float(np.sum(dr.grad(picture).numpy() * along))
    ends = [loss.function(mi.TensorXf(texture + h * along), 1) for h in (0, 1e-2)]
    low, high = (float(np.ravel(end.numpy())[0]) for end in ends)
    assert slope == pytest.approx((high - low) / 1e-2, rel=0.1)


@pytest.mark.parametrize("integrator", ["prb", "path", "direct_projective"])
def test_frozen_steps_have_the_derivatives_of_plain_ones(integrator):
    """Though other programs run between them, and the memory of the recording is gone."""
    import drjit as dr

    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), photos_of(wall(true_texture()), spp=4)
    tool = mi.load_dict({"type": integrator})
    loss = photo_loss(scene, NAME, photos, integrator=tool, spp=16)
    values = mi.traverse(scene)
    for step in range(9):
        texels = np.random.default_rng(step).random((32, 32, 3), np.float32)
        picture, plain = mi.TensorXf(texels), mi.TensorXf(texels)
        dr.enable_grad(picture, plain)
        number = loss.function(picture, step)
        dr.backward(number)
        values.update({f"{NAME}.data": plain})
        shown = mi.render(scene, values, step % 3, tool, step, spp=16)
        expected = dr.mean(dr.square(shown - mi.TensorXf(photos[step % 3])), axis=None)
        dr.backward(expected)
        np.testing.assert_allclose(number.numpy(), expected.numpy(), rtol=1e-5)
        np.testing.assert_allclose(
            dr.grad(picture).numpy(), dr.grad(plain).numpy(), rtol=1e-3, atol=1e-8
        )
        if step == 5:  # all recordings are made
            eg.fit(true_texture(), 20, 10, space="linear")
            dr.sync_thread()
            dr.flush_malloc_cache()


def test_other_derivatives_stay_as_they_are():
    """Parameters of the scene that the user differentiates get nothing from a fit."""
    import drjit as dr

    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), photos_of(wall(true_texture()), spp=4)
    values = mi.traverse(scene)
    values["sky.radiance.value"] = mi.Float(1)
    dr.enable_grad(values["sky.radiance.value"])
    values.update()
    light = values["sky.radiance.value"]
    eg.fit(loss=photo_loss(scene, NAME, photos), size=(32, 32), gaussians=10, iterations=20)
    assert dr.grad_enabled(light) and dr.grad(light)[0] == 0


def test_a_light_is_found_along():
    """Of which the photos say nothing but the product with the texture; where that is known."""
    from eigengs_dr.plugins import photo_loss

    photos = photos_of(wall(true_texture(), light=1.5))
    key = "sky.radiance.value"
    light = mi.ad.Adam(lr=0.03, params={key: mi.Float(1.0)})
    scene = wall(GREY)
    loss = photo_loss(scene, NAME, photos, parameters=light)
    start = eg.fit(eg.image.color.to_coded(true_texture()), 200, 100, space="linear").gaussians
    method = eg.COARSE_TO_FINE.at_rates(0.01)
    eg.fit(loss=loss, size=(32, 32), start=start, iterations=60, method=method)
    assert light[key][0] == pytest.approx(1.5, abs=0.05)


def test_bounds_are_those_of_textures_or_none():
    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), photos_of(wall(GREY))
    assert photo_loss(scene, NAME, photos).bounds == (0, 1)
    scene = wall(GREY, sky={"type": "envmap", "bitmap": mi.Bitmap(GREY)})
    assert photo_loss(scene, "sky", photos).bounds is None
    both = {"color": NAME, "light": "sky"}
    with pytest.raises(ValueError, match="an envmap has none; give bounds=None"):
        photo_loss(scene, both, photos)
    assert photo_loss(scene, both, photos, bounds=None).bounds is None


def test_photos_that_do_not_fit_are_refused():
    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), [GREY[:SIDE, :SIDE]] * 3
    for name, given, message in (
        (
            "wall.bsdf.reflektance",
            photos,
            "no bitmap 'wall.bsdf.reflektance'; it has wall.bsdf.ref",
        ),
        (NAME, photos + photos, "6 photos, but the scene has 3 sensors; give sensors="),
        (NAME, photos[:2], "2 photos, but the scene has 3 sensors; give sensors="),
        (NAME, [], "there are no photos"),
        (NAME, [*photos[:2], GREY], r"photo 2 has shape \(32, 32, 3\), but its film has 24x24"),
        (NAME, [*photos[:2], np.full_like(photos[0], np.nan)], "photo_loss: photo 2: .*finite"),
        (NAME, [photos[0], [[0.5], [0.5, 1]], photos[0]], "photo_loss: photo 1: "),
        (NAME, [photos[0], object(), photos[0]], "photo_loss: photo 1: "),
        (NAME, ["no.png", *photos[1:]], r"photo_loss: photo 0 \(no.png\): "),
    ):
        with pytest.raises(ValueError, match=message):
            photo_loss(scene, name, given)
    light = mi.ad.Adam(lr=0.1, params={"sky.radiance": mi.Float(1)})
    for options, message in (
        ({"sensors": [0, 1]}, "3 photos, but 2 sensors"),
        ({"sensors": [0, 1, 3]}, "there is no sensor 3; the scene has 3"),
        ({"spp": 0}, "spp is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"bounds": (0, np.inf)}, "bounds are"),
        ({"encoding": "sRGB"}, "encoding 'sRGB' is unknown"),
        ({"parameters": light}, "no parameter 'sky.radiance'; did you mean 'sky.radiance.value'"),
    ):
        with pytest.raises(ValueError, match=message):
            photo_loss(scene, NAME, photos, **options)
    for options, message in (
        ({"integrator": "path"}, "integrator is 'path'; give a loaded one"),
        ({"sensors": 5}, "sensors is 5; give a list"),
        ({"spp": 2.0}, "spp is 2.0; it must be a whole number"),
        ({"sensors": [0, 1, 2.0]}, "2.0 is no sensor"),
        ({"parameters": {}.items()}, "give an optimiser"),
    ):
        with pytest.raises(TypeError, match=message):
            photo_loss(scene, NAME, photos, **options)
    with pytest.raises(TypeError, match="pictures name 5"):
        photo_loss(scene, 5, photos)
    loss = photo_loss(scene, NAME, photos)
    for space, message in (("data", "channels 3, .* fit 1"), ({"a": "linear"}, "fit a 3")):
        with pytest.raises(ValueError, match=message):
            eg.fit(loss=loss, size=(8, 8), gaussians=5, iterations=4, space=space)


def test_bitmaps_of_bytes_are_refused(tmp_path):
    """Mitsuba keeps a file of 8 bits as bytes, which have no derivative."""
    from eigengs_dr.plugins import photo_loss

    eg.save_image(tmp_path / "grey.png", GREY)
    paint = {"type": "bitmap", "filename": str(tmp_path / "grey.png"), "raw": True}
    photos = photos_of(wall(GREY), spp=1)
    with pytest.raises(ValueError, match=f"{NAME}' holds bytes.*variant"):
        photo_loss(wall(paint), NAME, photos)
    loss = photo_loss(wall(paint | {"format": "variant"}), NAME, photos)
    eg.fit(loss=loss, size=(8, 8), gaussians=5, iterations=4)


def test_seeds_of_any_size_differ():
    """Also those that fill the 32 bits of a renderer's seed, and numbers of NumPy."""
    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), [GREY[:SIDE, :SIDE]] * 3

    def value(seed, step=0):
        numbers = {"seed": seed, "spp": np.int64(1), "sensors": np.arange(3)}
        return float(photo_loss(scene, NAME, photos, **numbers).function(picture, step).array[0])

    picture = mi.TensorXf(true_texture())
    seeds = (0, 1, 65_535, 65_536, 70_000, 2**31, 2**32 - 1)
    assert len({value(seed) for seed in seeds}) == len(seeds)
    assert value(np.int64(70_000)) == value(70_000) == value(70_000 + 2**32)
    value(2**32 - 1, step=3 * 2**16)  # beyond the largest seed of a rendering


def test_a_size_below_two_texels_leaves_the_scene_as_it_is():
    """Mitsuba takes a bitmap of one row once, and then no other one."""
    import drjit as dr

    from eigengs_dr.plugins import photo_loss

    scene, photos = wall(GREY), [GREY[:SIDE, :SIDE]] * 3
    values = mi.traverse(scene)
    dr.enable_grad(values["sky.radiance.value"])
    values.update()
    loss = photo_loss(scene, NAME, photos)
    for size in ((9, 1), (1, 9)):
        with pytest.raises(ValueError, match=f"size of the fit is {size[0]}x{size[1]}; .* 2x2"):
            eg.fit(loss=loss, size=size, gaussians=1, iterations=4)
    assert mi.traverse(scene)[f"{NAME}.data"].shape == GREY.shape
    loss.function(mi.TensorXf(GREY[:2, :2]), 0)
    eg.fit(loss=loss, size=(8, 8), gaussians=1, iterations=2)
    assert np.isfinite(mi.render(scene, spp=1).numpy()).all()
    assert dr.grad_enabled(mi.traverse(scene)["sky.radiance.value"])
    with pytest.raises(ValueError, match="has 32x1 texels"):
        photo_loss(wall(GREY[:1]), NAME, photos)


def test_a_step_that_fails_keeps_the_derivatives_of_the_user(monkeypatch):
    import drjit as dr

    import eigengs_dr.plugins.photos as module

    def fail(*arguments):
        raise RuntimeError("no rendering")

    monkeypatch.setattr(module, "_add_slopes", fail)
    scene = wall(GREY)
    values = mi.traverse(scene)
    dr.enable_grad(values["sky.radiance.value"])
    values.update()
    loss = module.photo_loss(scene, NAME, [GREY[:SIDE, :SIDE]] * 3)
    picture = mi.TensorXf(GREY)
    dr.enable_grad(picture)
    with pytest.raises(RuntimeError):
        loss.function(picture, 0)
    assert dr.grad_enabled(mi.traverse(scene)["sky.radiance.value"])


class Foreign:
    """A tensor of another library, as NumPy sees one of PyTorch."""

    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.array, dtype)


def test_photos_are_light_or_codes(tmp_path):
    """Of floats, of 8 bits, or of a file, of any library: the first value is the same."""
    from PIL import Image

    from eigengs_dr.plugins import photo_loss

    scene, picture = wall(GREY), mi.TensorXf(GREY)
    codes = np.full((SIDE, SIDE, 3), 128, np.uint8)
    coded = codes.astype(np.float32) / 255
    light = eg.image.color.to_linear(coded)
    Image.fromarray(codes).save(tmp_path / "photo.png")

    def value(photo, encoding=None):
        loss = photo_loss(scene, NAME, [photo], sensors=[0], encoding=encoding)
        return float(loss.function(picture, 0).array[0])

    expected = value(light)
    for photo in (
        codes,
        tmp_path / "photo.png",
        Image.fromarray(codes),
        mi.Bitmap(light),
        mi.TensorXf(light),
        light.tolist(),
        light.astype(np.float64),
        Foreign(light),
        Foreign(codes),
    ):
        assert value(photo) == pytest.approx(expected, rel=1e-4)
    for photo in (coded, coded.tolist(), codes, mi.TensorXf(coded), Foreign(coded)):
        assert value(photo, "srgb") == pytest.approx(expected, rel=1e-4)
    assert value(codes, "linear") == pytest.approx(value(coded), rel=1e-4) != expected


def test_colours_of_a_spectral_variant_are_refused():
    """Where texels are coefficients, on which a descent gains nothing."""
    from eigengs_dr.plugins import photo_loss

    mi.set_variant("llvm_ad_spectral")
    paint = {"type": "bitmap", "data": mi.TensorXf(GREY)}
    with pytest.raises(ValueError, match="spectra in llvm_ad_spectral; load the scene in"):
        photo_loss(wall(paint), NAME, [GREY[:SIDE, :SIDE]] * 3)


def test_an_environment_map_is_recovered():
    """The light of a matt ball: the mean over half of the directions is all that it shows."""
    from _helpers.poster import camera
    from eigengs_dr.plugins import photo_loss

    y, x = np.mgrid[:16, :32]
    up = np.clip(np.cos(np.pi * y / 15), 0, 1)[..., None]
    light = 0.2 + up * [0.5, 0.8, 1.5] + 3.0 * ((abs(x - 9) < 3) & (abs(y - 5) < 2))[..., None]

    def lit(pixels):
        cameras = {
            f"camera{k}": camera([4 * np.sin(k), 1, 4 * np.cos(k)], SIDE, fov=35, spp=16)
            for k in (0, 2, 4)
        }
        sky = {"type": "envmap", "bitmap": mi.Bitmap(np.float32(pixels))}
        path = {"type": "prb", "max_depth": 2}
        return mi.load_dict(
            {"type": "scene", "integrator": path, "ball": {"type": "sphere"}, "sky": sky, **cameras}
        )

    def views(scene):
        return [mi.render(scene, sensor=k, spp=256, seed=7).numpy() for k in range(3)]

    photos, scene = views(lit(light)), lit(np.full((16, 32, 3), 0.5))
    before = np.mean([(a - b) ** 2 for a, b in zip(views(scene), photos, strict=True)])
    loss = photo_loss(scene, "sky", photos, spp=16)
    found = eg.fit(loss=loss, size=(32, 16), gaussians=40, iterations=60, space="log")
    after = np.mean([(a - b) ** 2 for a, b in zip(views(scene), photos, strict=True)])
    assert after < 0.05 * before
    seen = eg.render(found.gaussians).numpy()
    area = np.sin(np.pi * y / 15)[..., None]
    assert (seen * area).sum() == pytest.approx((light * area).sum(), rel=0.1)
    data = mi.traverse(scene)["sky.data"]
    # The columns of the envmap beyond the seam are those of the other side.
    np.testing.assert_allclose(np.array(data)[:, 0], np.array(data)[:, -2], rtol=1e-4)
