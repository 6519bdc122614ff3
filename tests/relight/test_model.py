"""A model of photos under known lights: quality on new lights, derivatives, files, refusals."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.lit_spheres import directions, photos
from _helpers.packed import few_groups
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.storage import npz

LIGHTS = directions(30)


@pytest.fixture(scope="module")
def model():
    options = {"gaussians": 80, "iterations": 60, "encoding": "srgb", "progress": False}
    return eg.Relightable.fit(photos(LIGHTS), LIGHTS, **options)


def picture(model, light):
    return eg.picture_of(model.relight(light))


def test_new_lights_look_like_their_photos(model):
    new = directions(11, 0.45) @ np.diag([-1, 1, 1])
    psnrs = [eg.psnr(p, picture(model, d)) for p, d in zip(photos(new), new, strict=True)]
    assert np.mean(psnrs) > 35
    assert 25 < model.psnr_held_out < np.mean(psnrs) + 1  # some left-out lights are the outermost


def test_a_model_is_small_and_says_what_it_is(model):
    assert 2 <= model.planes.channels <= 20
    assert "80 Gaussians, 24x24 pixels" in repr(model) and "30 lights" in repr(model)


def test_numbers_of_planes_and_gaussians_can_be_given():
    model = eg.Relightable.fit(
        photos(LIGHTS), LIGHTS, gaussians=40, planes=5, iterations=0, progress=False
    )
    assert (len(model.planes), model.planes.channels) == (40, 5)
    assert model.table.values.shape == (30, 3, 6)


def test_the_length_of_a_direction_does_not_matter(model):
    assert np.allclose(picture(model, [0.3, 0.2, 0.9]), picture(model, [3, 2, 9]), atol=1e-5)


def test_derivative_by_the_direction_is_that_of_finite_differences(model):
    from dataclasses import replace

    data = model.planes.data()
    exact = replace(model, planes=eg.Gaussians.from_data(data, dtype=np.float64))
    Float3 = types_of(exact.planes.mean).Float3
    light, step = np.array([0.3, -0.2, 0.7]), 1e-5

    def brightness(vector):
        return dr.sum(dr.square(eg.render(exact.relight(vector)).array))

    vector = Float3(*light.tolist())
    dr.enable_grad(vector)
    dr.backward(brightness(vector))
    for axis in range(3):
        shifts = [light + sign * step * np.eye(3)[axis] for sign in (1, -1)]
        high, low = (brightness(Float3(*shift.tolist())).numpy()[0] for shift in shifts)
        assert vector.grad[axis].numpy()[0] == pytest.approx((high - low) / (2 * step), rel=1e-4)


def test_a_file_gives_the_same_pictures(model, tmp_path):
    path = tmp_path / "model.npz"
    model.save(path)
    loaded = eg.Relightable.load(path)
    assert np.allclose(picture(loaded, [0.1, 0.3, 0.9]), picture(model, [0.1, 0.3, 0.9]), atol=1e-4)
    assert loaded.psnr_held_out == model.psnr_held_out and loaded.table.kind == model.table.kind


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("kind", np.array("spline"), "kind is 'spline'"),
        ("values", np.zeros((3, 3, 3), np.float32), "values have shape"),
        ("smoothing", np.array(-1.0), "smoothing is -1"),
        ("lights", np.zeros((30, 3), np.float32), "no direction"),
        ("color", np.zeros((80, 2), np.float32), "background has shape"),
        ("format", np.array("eigengs_dr.model"), "format is"),
    ],
)
def test_a_damaged_file_is_refused(model, tmp_path, key, value, message):
    path = tmp_path / "model.npz"
    model.save(path)
    with np.load(path) as file:
        members = dict(file) | {key: value}
    np.savez(path, **members)
    with pytest.raises(ValueError, match=message) as caught:
        eg.Relightable.load(path)
    assert str(path) in str(caught.value)


def test_a_set_is_not_read_as_a_model(model, tmp_path):
    model.planes.save(tmp_path / "set.npz")
    with pytest.raises(ValueError, match=r"format is 'eigengs_dr\.gaussians'"):
        eg.Relightable.load(tmp_path / "set.npz")
    model.save(tmp_path / "model.npz")
    assert npz.format_of(tmp_path / "model.npz") == "eigengs_dr.relightable"


def test_a_folder_with_a_list_is_read_in_its_order(model, tmp_path):
    images, lines = photos(LIGHTS[:8]), ["8"]
    for k, light in reversed(list(enumerate(LIGHTS[:8]))):
        eg.save_image(tmp_path / f"{k}.png", images[k])
        lines.append(f"{k}.png " + " ".join(map(str, light)))
    (tmp_path / "dirs.lp").write_text("\n".join(lines))
    found = eg.Relightable.fit(tmp_path, gaussians=40, iterations=0, progress=False)
    assert np.allclose(found.lights, LIGHTS[7::-1])
    assert eg.psnr(images[3], picture(found, LIGHTS[3])) > 25


def test_what_cannot_be_a_model_is_refused(tmp_path):
    images = photos(LIGHTS)
    refused = [
        ((images,), "photos need lights"),
        ((images, LIGHTS[:-1]), "30 photos, but 29 lights"),
        ((images[:3], LIGHTS[:3]), "at least 4"),
        ((tmp_path,), "holds 0 files of lights"),
        ((tmp_path, LIGHTS), "a folder needs an .lp file"),
        (([*images[:5], images[5, :20]], LIGHTS[:6]), "photo 6: is 24x20"),
    ]
    for arguments, message in refused:
        with pytest.raises(ValueError, match=message):
            eg.Relightable.fit(*arguments, progress=False)
    with pytest.raises(ValueError, match="gaussians is 0"):
        eg.Relightable.fit(images, LIGHTS, gaussians=0, progress=False)
    with pytest.raises(ValueError, match="every photo is of one colour"):
        eg.Relightable.fit(np.full((8, 16, 16, 3), 0.5), LIGHTS[:8], progress=False)
    for number, planes, most in ((30, 65, 64), (8, 22, 21)):
        with pytest.raises(ValueError, match=f"planes is {planes}; {number} photos .* to {most}"):
            eg.Relightable.fit(images[:number], LIGHTS[:number], planes=planes, progress=False)


def test_photos_that_do_not_depend_on_the_light():
    same = np.repeat(photos(LIGHTS)[:1], 8, axis=0)
    options = {"gaussians": 80, "iterations": 20, "encoding": "srgb", "progress": False}
    model = eg.Relightable.fit(same, LIGHTS[:8], **options)
    shown = eg.psnr(same[0], picture(model, LIGHTS[20]))
    assert model.planes.channels <= 3 and 50 < model.psnr_held_out == pytest.approx(shown, abs=1)


def test_as_many_planes_as_the_rest_of_the_photos_has_rows():
    model = eg.Relightable.fit(
        photos(LIGHTS)[:8], LIGHTS[:8], planes=21, gaussians=40, iterations=0, progress=False
    )
    assert 1 <= model.planes.channels <= 21 and np.isfinite(model.psnr_held_out)


@pytest.mark.parametrize("light", [(0, 0, 0), (0.5, 0, -0.5), (np.nan, 0, 1), (1, 0)])
def test_a_light_that_is_no_direction_is_refused(model, light):
    with pytest.raises(ValueError, match="light"):
        model.relight(light)


def test_a_white_environment_is_the_integral_over_the_hemisphere(model):
    """The sum over directions of photos in linear light, by the definition; and scales with it."""
    from eigengs_dr.image.color import to_linear

    lit = model.relight(np.full((8, 16, 3), 0.5, np.float32))
    assert lit.space == "linear"
    z = np.linspace(0.005, 0.995, 60)
    turn = np.arange(60) * 2.399963
    ring = np.sqrt(1 - z**2)
    spread = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)  # equal solid angles
    images = [np.clip(picture(model, light), 0, 1).astype(np.float64) for light in spread]
    expected = np.mean([to_linear(image) for image in images], axis=0)  # 2 pi / pi * 0.5
    assert np.abs(eg.render(lit).numpy() - expected).mean() < 0.02


def test_an_environment_with_one_bright_side_lights_from_there(model):
    """The first row of an environment is up, and columns left of the middle are at x > 0."""
    sky = np.zeros((16, 32, 3), np.float32)
    sky[8, 11:13] = 20
    x = np.sin(2 * np.pi * 12 / 32)
    rendered = type(eg.render(model.planes))(sky)  # a tensor, as of Mitsuba
    lit = eg.picture_of(model.relight(rendered)).mean(axis=2)
    side = picture(model, [x, -0.1, 0.75]).mean(axis=2)
    other = picture(model, [-x, -0.1, 0.75]).mean(axis=2)
    alike = [np.corrcoef(lit.ravel(), image.ravel())[0, 1] for image in (side, other)]
    assert alike[0] > 0.9 > alike[1]


@pytest.fixture(scope="module")
def packed(model, tmp_path_factory):
    """A packed model, and the receipt of it."""
    path = tmp_path_factory.mktemp("packed") / "model.egs"
    with few_groups():
        return path, eg.pack(model, path, max_psnr_drop=0.3)


def test_a_packed_model_is_smaller_and_shows_nearly_the_same(model, packed, tmp_path):
    model.save(tmp_path / "model.npz")
    path, result = packed
    assert result.bytes < 0.4 * (tmp_path / "model.npz").stat().st_size
    assert 0 < result.psnr_drop <= 0.3
    loaded = eg.Relightable.load(path)
    assert loaded.psnr_held_out == pytest.approx(model.psnr_held_out - result.psnr_drop)
    light = [0.2, 0.3, 0.9]
    allowed = model.psnr_held_out - 10 * np.log10(10**0.03 - 1)  # the error that 0.3 dB adds
    assert eg.psnr(picture(loaded, light), picture(model, light)) > allowed - 4
    planes = eg.Gaussians.load(path)
    assert planes.channels == model.planes.channels


@few_groups()
def test_packed_files_that_are_no_models_are_refused(model, packed, tmp_path):
    path = tmp_path / "set.egs"
    eg.pack(model.relight([0, 0, 1]), path, max_psnr_drop=60)
    with pytest.raises(ValueError, match="without a table of lights"):
        eg.Relightable.load(path)
    content = packed[0].read_bytes()
    path.write_bytes(content[:200] + bytes([content[200] ^ 1]) + content[201:])
    with pytest.raises(ValueError, match="damaged"):
        eg.Relightable.load(path)
    with pytest.raises(ValueError, match="takes no image"):
        eg.pack(model, path, np.zeros((24, 24, 3)))


def test_an_interrupted_fit_gives_the_model_so_far():
    lights = directions(12)

    def stop(done, total, row):
        if done >= 10:
            raise KeyboardInterrupt

    with pytest.raises(eg.Interrupted) as error:
        eg.Relightable.fit(photos(lights), lights, iterations=500, progress=stop)
    model = error.value.result
    assert isinstance(model, eg.Relightable) and len(model.lights) == 12
    assert eg.picture_of(model.relight((0, 0, 1))).shape == (24, 24, 3)
