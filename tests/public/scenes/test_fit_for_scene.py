"""No more Gaussians than cameras resolve: what they see, the search, what a renderer then sees."""

import signal
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

import eigengs_dr as eg
from _helpers.light import to_coded, to_linear
from _helpers.poster import (
    NAME,
    SIDE,
    TEXELS,
    albedo,
    bitmap,
    board,
    camera,
    mi,
    photo,
    picture,
    pixel_at,
    scene_of,
)
from _helpers.sets import random_scene
from _helpers.variants import in_variants
from eigengs_dr.plugins import texture_of

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.usefixtures("variant"),
    in_variants(["llvm_ad_rgb"]),
]

PIXEL = 0.4
"""Standard deviation of the footprint of a pixel, in pixels."""

BOUND, STEPS = 33.0, 30


def seen_by(*cameras, side=TEXELS, wrap="repeat", **others):
    """What cameras resolve of the poster."""
    even = np.full((side, side, 3), 0.5, np.float32)
    options = {"target_psnr": 5.0, "iterations": 0, "wrap_mode": wrap, "progress": False}
    return eg.fit_for_scene(scene_of(*cameras, **others), NAME, even, **options).visibility


class TestFootprint:
    @pytest.mark.parametrize("distance", [0.5, 60.0])
    def test_from_the_front_is_a_part_of_a_pixel(self, distance):
        found = seen_by(camera([0, 0, distance]))
        np.testing.assert_allclose(
            found.footprint[found.seen], PIXEL * pixel_at(distance), rtol=3e-3
        )

    def test_the_sharpest_camera_decides(self):
        near, far = camera([0, 0, 1.0]), camera([0, 0, 8.0])
        both, one = seen_by(far, near), seen_by(near)
        assert not one.seen.all() and both.seen.all()
        np.testing.assert_array_equal(both.footprint[one.seen], one.footprint[one.seen])
        expected = PIXEL * pixel_at(8.0)
        np.testing.assert_allclose(both.footprint[~one.seen], expected, rtol=3e-3)
        assert len(both.pixel_to_texel) == 2

    def test_a_grazing_look_counts_by_its_narrow_axis(self):
        tilt, distance = np.radians(70), 3.0
        eye = [distance * np.sin(tilt), 0, distance * np.cos(tilt)]
        found = seen_by(camera(eye)).footprint[15:17, 15:17].mean()
        # At the middle of the picture a pixel is as wide as at this distance from the front.
        assert found == pytest.approx(PIXEL * pixel_at(distance), rel=0.02)

    def test_far_away_hits_leave_no_holes(self):
        found = seen_by(camera([0, 0, 200.0], 64), side=1024)
        row, column = np.nonzero(found.seen)
        inside = found.seen[row.min() : row.max() + 1, column.min() : column.max() + 1]
        assert inside.all()
        assert inside.size > 0.9 * found.seen.size


class TestSeen:
    def test_what_stands_in_front_hides(self):
        found = seen_by(camera([0, 0, 4.0]), board=board(0.0, 1.5))
        assert found.seen[:, :15].all()
        assert not found.seen[:, 18:].any()

    def test_a_crop_is_all_of_a_film(self):
        crop = {"crop_width": SIDE // 2, "crop_height": SIDE, "crop_offset_y": 0}
        left, right = (
            seen_by(camera([0, 0, 4.0], crop_offset_x=x, **crop)) for x in (0, SIDE // 2)
        )
        assert (left.seen[:, :14] != right.seen[:, :14]).all()
        assert (left.seen[:, 18:] != right.seen[:, 18:]).all()
        seen = left.footprint[left.seen]
        np.testing.assert_allclose(seen, PIXEL * pixel_at(4.0), rtol=3e-3)

    def test_shares_of_pixels_add_up(self):
        found = seen_by(camera([0, 0, 4.0]), camera([0, 0, 1.0]))
        for rows in found.pixel_to_texel:
            np.testing.assert_allclose(np.asarray(rows.sum(axis=1)), 1, rtol=1e-5)
        assert found.pixels.sum() == pytest.approx(1, rel=1e-5)
        assert (found.pixels[~found.seen] == 0).all()


class TestLookups:
    @pytest.mark.parametrize("wrap", ["mirror", "clamp"])
    def test_are_what_a_renderer_sees(self, wrap):
        turned = mi.ScalarTransform4f().translate([0.3, -0.2, 0]).rotate([0, 0, 1], 20).scale(2)
        properties, view = {"to_uv": turned, "wrap_mode": wrap}, camera([0.3, 0.2, 1.3])
        found = seen_by(view, wrap=wrap, texture=bitmap(**properties))
        expected = albedo(scene_of(view, texture=bitmap(**properties))).reshape(-1, 3)
        assert found.pixel_to_texel[0].shape == (SIDE * SIDE, TEXELS * TEXELS)
        difference = found.pixel_to_texel[0] @ picture().reshape(-1, 3) - expected
        # Borders of the image are met by bilinear lookups of the bitmap on either side.
        assert np.sqrt(np.mean(difference**2)) < (0.01 if wrap == "clamp" else 0.02)

    def test_of_gaussians_take_their_own_mapping(self):
        properties = {"to_uv": mi.ScalarTransform4f().scale([3, 2, 1]), "wrap_mode": "mirror"}
        view = camera([0, 0, 4.0])
        texture = texture_of(random_scene().on("llvm", space="linear"), **properties)
        found = seen_by(view, texture=texture)
        same = seen_by(view, wrap="mirror", texture=bitmap(**properties))
        np.testing.assert_array_equal(found.footprint, same.footprint)
        assert abs(found.pixel_to_texel[0] - same.pixel_to_texel[0]).max() < 1e-6

    @pytest.mark.slow
    def test_of_a_batch_of_cameras_are_those_of_each(self):
        places = [0, 0, 4.0], [0, 0, 1.0]
        film = camera(places[0], 2 * SIDE)["film"] | {"height": SIDE}
        batch = {"type": "batch", "film": film}
        batch |= {f"camera{n}": camera(p) for n, p in enumerate(places)}
        found, single = seen_by(batch), seen_by(*map(camera, places))
        # Around what the near one hits, texels take after a hit of any camera that is nearer.
        near = seen_by(camera(places[1])).seen
        sure = ~near | binary_erosion(near, iterations=2)
        np.testing.assert_allclose(found.footprint[sure], single.footprint[sure], rtol=1e-4)
        assert len(found.pixel_to_texel[0].indptr) - 1 == sum(
            r.shape[0] for r in single.pixel_to_texel
        )


def seen_by_a_renderer(found, place, image):
    """PSNR of the albedo, as Mitsuba renders it, of the set against the image."""
    textures = texture_of(found.gaussians, wrap_mode="clamp"), bitmap(to_linear(image))
    a, b = (albedo(scene_of(camera(place), texture=t)) for t in textures)
    return eg.psnr(to_coded(a.clip(0, 1)), to_coded(b.clip(0, 1)))


def fitted(*cameras, image=None, space="linear", **others):
    """A fit of the poster for a scene with these cameras."""
    image = photo() if image is None else image
    settings = {"target_psnr": BOUND, "space": space, "iterations": STEPS, "progress": False}
    return eg.fit_for_scene(scene_of(*cameras, **others), NAME, image, **settings)


@cache
def seen_from(distance):
    """A fit of the poster for one camera in front of it."""
    return fitted(camera([0, 0, distance]))


class TestFit:
    @pytest.mark.parametrize("distance", [2.7, 7.0])
    def test_a_renderer_sees_what_was_asked_for(self, distance):
        # What is around the poster is the same for both; far away, texels are merged.
        found = seen_from(distance)
        assert min(found.psnr) >= BOUND
        assert seen_by_a_renderer(found, [0, 0, distance], photo()) > BOUND - 1
        assert (found.gaussians.width, found.gaussians.height) == (48, 48)
        assert found.gaussians.space == "linear"

    def test_the_fewest_that_are_enough_are_taken(self):
        found = seen_from(2.7)
        enough = [count for count, psnr in found.tried if psnr >= BOUND]
        assert len(found.gaussians) <= min(enough)  # without those that no camera sees
        assert any(psnr < BOUND for _, psnr in found.tried) and len(found.tried) < 30

    def test_far_away_fewer_are_enough(self):
        counts = [len(seen_from(distance).gaussians) for distance in (2.7, 7.0)]
        assert counts[0] > 2 * counts[1]

    def test_none_is_spent_on_what_is_hidden(self):
        whole = seen_from(7.0)
        half = fitted(camera([0, 0, 7.0]), board=board(0.0, 1.5))
        assert len(half.gaussians) < 0.75 * len(whole.gaussians)
        assert half.gaussians.to_arrays()["mean"][:, 0].max() < 30
        assert half.visibility.seen.shape == (48, 48)

    def test_every_camera_is_content(self):
        found = fitted(camera([0, 0, 7.0]), camera([4, 0, 5.5]))
        assert len(found.psnr) == 2 and min(found.psnr) >= BOUND
        counts = [count for count, reached in found.tried if reached >= BOUND]
        assert min(counts) == len(found.gaussians)

    @pytest.mark.slow
    def test_data_of_one_channel(self):
        data = photo()[..., :1]
        found = fitted(camera([0, 0, 5.0]), image=data, space="data")
        assert found.gaussians.space == "data" and found.gaussians.channels == 1
        rows = found.visibility.pixel_to_texel[0]
        shown = (rows @ p.reshape(-1, 1) for p in (eg.render(found.gaussians).numpy(), data))
        assert eg.psnr(*(s[:, None] for s in shown), space="data") > BOUND - 0.5


@pytest.mark.parametrize(
    ("arguments", "others", "words"),
    [
        ({"space": "ycbcr"}, {}, "space 'ycbcr'.*linear"),
        ({"space": "data", "encoding": "light"}, {}, "encoding 'light'"),
        ({"target_psnr": 80.0}, {}, "target_psnr is 80"),
        ({"target_psnr": float("nan")}, {}, "target_psnr is nan"),
        ({"iterations": -1}, {}, "iterations"),
        ({"max_gaussians": 0}, {}, "max_gaussians"),
        ({"max_gaussians": 2, "iterations": 0}, {}, "2 Gaussians reach"),
        ({"texture": "poster"}, {}, f"not in the scene.*{NAME}"),
        ({"wrap_mode": "border"}, {}, "wrap_mode 'border'.*repeat"),
        ({"image": np.zeros((4, 4, 2), np.float32)}, {}, "shape"),
        ({"image": photo() - 0.5, "space": "data"}, {}, r"data from -0\.\d+ to .*from 0 to 1"),
        ({}, {"board": (-2.0, 2.0)}, r"^no pixel of the scene's 1 cameras sees"),
    ],
)
def test_mistakes_cost_a_line(arguments, others, words):
    others = {name: board(*sides) for name, sides in others.items()}
    arguments = {"texture": NAME, "image": photo(), **arguments}
    with pytest.raises(ValueError, match=words) as error:
        eg.fit_for_scene(scene_of(camera([0, 0, 7.0]), **others), **arguments)
    assert "\n" not in str(error.value)


def press():
    raise KeyboardInterrupt


def signal_it():
    signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    ("stage", "first", "end"),
    [
        ("rays", 0, signal_it),
        ("target", 0, signal_it),
        ("search", 1, signal_it),
        ("search", 20, press),
    ],
)
def test_ctrl_c_in_any_stage_keeps_the_best_set(stage, first, end):
    """It ends the call where progress is told next; before the search there is no set."""
    calls, pressed = [], []

    def stop(done, total, row):
        calls.append(row["stage"])
        if row["stage"] == stage and done >= first:
            assert stage != "search" or row["psnr"] == min(row["psnr_of_cameras"])
            pressed.append(len(calls))
            end()

    scene = scene_of(camera([0, 0, 7.0]))
    with pytest.raises(eg.Interrupted, match="interrupted") as stopped:
        eg.fit_for_scene(scene, NAME, photo(), BOUND, iterations=STEPS, progress=stop)
    stages = ["rays", "target", "search"]
    assert pressed == [len(calls)]
    assert list(dict.fromkeys(calls)) == stages[: stages.index(stage) + 1]
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
    found = stopped.value.result
    assert (found is not None) == (stage == "search")
    if found:
        assert min(found.psnr) in [psnr for _, psnr in found.tried]
        text = f"{len(found.gaussians)} Gaussians, 48x48 pixels, psnr=({found.psnr[0]:.2f})"
        assert repr(found) == f"SceneFit({text})"
