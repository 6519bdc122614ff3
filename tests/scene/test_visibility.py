"""What cameras resolve of a texture: against closed forms, and against renderings of its albedo."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from _helpers.poster import (
    NAME,
    SIDE,
    TEXELS,
    albedo,
    bitmap,
    board,
    camera,
    mi,
    picture,
    pixel_at,
    scene_of,
)
from _helpers.sets import random_scene
from eigengs_dr.plugins import texture_of
from eigengs_dr.plugins.cone import PIXEL
from eigengs_dr.scene.visibility import Box, visibility

pytestmark = pytest.mark.mitsuba


def seen_by(*cameras, **others):
    """What cameras resolve of the poster."""
    return visibility(scene_of(*cameras, **others), NAME, TEXELS, TEXELS)


class TestFootprint:
    @pytest.mark.parametrize("distance", [0.5, 2.0, 8.0, 60.0])
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
        found = visibility(scene_of(camera(eye)), NAME, 33, 33)
        # At the middle of the picture a pixel is as wide as at this distance from the front.
        assert found.footprint[16, 16] == pytest.approx(PIXEL * pixel_at(distance, 33), rel=0.02)

    def test_far_away_hits_leave_no_holes(self):
        found = visibility(scene_of(camera([0, 0, 200.0], 64)), NAME, 2048, 2048)
        row, column = np.nonzero(found.seen)
        inside = found.seen[row.min() : row.max() + 1, column.min() : column.max() + 1]
        assert inside.all()
        assert inside.size > 0.9 * found.seen.size


class TestSeen:
    def test_what_stands_in_front_hides(self):
        found = seen_by(camera([0, 0, 4.0]), board=board(0.0, 1.5))
        assert found.seen[:, :15].all()
        assert not found.seen[:, 18:].any()

    def test_of_a_part_it_is_that_of_the_whole_there(self):
        scene = scene_of(camera([0.6, 0.5, 0.8], target=[0.6, 0.5, 0]))
        whole = visibility(scene, NAME, TEXELS, TEXELS)
        row, column = np.nonzero(whole.seen)
        box = Box(column.min(), row.min(), np.ptp(column) + 1, np.ptp(row) + 1)
        assert box.width < TEXELS and box.height < TEXELS
        part = visibility(scene, NAME, TEXELS, TEXELS, part=box)
        np.testing.assert_array_equal(part.footprint, box.of(whole.footprint))
        texels = box.of(np.arange(TEXELS**2).reshape(TEXELS, TEXELS)).ravel()
        both = (part.pixel_to_texel[0], whole.pixel_to_texel[0][:, texels])
        assert abs(both[0] - both[1]).max() < 1e-5

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
    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    def test_are_what_a_renderer_sees(self, wrap):
        turned = mi.ScalarTransform4f().translate([0.3, -0.2, 0]).rotate([0, 0, 1], 20).scale(2)
        texture = bitmap(to_uv=turned, wrap_mode=wrap)
        scene = scene_of(camera([0.3, 0.2, 1.3]), texture=texture)
        found = visibility(scene, NAME, TEXELS, TEXELS, wrap)
        expected = albedo(scene).reshape(-1, 3)
        assert found.pixel_to_texel[0].shape == (SIDE * SIDE, TEXELS * TEXELS)
        difference = found.pixel_to_texel[0] @ picture().reshape(-1, 3) - expected
        # Borders of the image are met by bilinear lookups of the bitmap on either side.
        assert np.sqrt(np.mean(difference**2)) < (0.01 if wrap == "clamp" else 0.02)

    def test_of_gaussians_take_their_own_mapping(self):
        properties = {"to_uv": mi.ScalarTransform4f().scale([3, 2, 1]), "wrap_mode": "mirror"}
        cameras = camera([0, 0, 4.0])
        texture = texture_of(random_scene().on("llvm", space="linear"), **properties)
        found = seen_by(cameras, texture=texture)
        scene = scene_of(cameras, texture=bitmap(**properties))
        same = visibility(scene, NAME, TEXELS, TEXELS, "mirror")
        np.testing.assert_array_equal(found.footprint, same.footprint)
        assert abs(found.pixel_to_texel[0] - same.pixel_to_texel[0]).max() < 1e-6

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


@pytest.mark.parametrize(
    ("arguments", "others", "words"),
    [
        ((NAME + "x", 8, 8), {}, f"is not in the scene.*{NAME}"),
        ((NAME, 8, 8, "border"), {}, "wrap_mode 'border'.*repeat"),
        ((NAME, 8, 8), {"board": (-2.0, 2.0)}, r"^no pixel of the scene's 1 cameras sees"),
    ],
)
def test_mistakes_cost_a_line(arguments, others, words):
    others = {name: board(*sides) for name, sides in others.items()}
    with pytest.raises(ValueError, match=words) as error:
        visibility(scene_of(camera([0, 0, 4.0]), **others), *arguments)
    assert "\n" not in str(error.value)
