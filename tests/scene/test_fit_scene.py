"""No more Gaussians than cameras resolve: the target, the search, and what a renderer then sees."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_array

pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

import eigengs_dr as eg
from _helpers.poster import NAME, albedo, bitmap, board, camera, photo, scene_of
from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.plugins import texture_of
from eigengs_dr.scene import fit_scene as scenefit
from eigengs_dr.scene.target import error_weights
from eigengs_dr.scene.visibility import Visibility

pytestmark = pytest.mark.mitsuba

BOUND, STEPS = 33.0, 30


class TestTarget:
    def test_errors_count_by_the_root_of_the_pixels(self):
        times, side = np.array([1, 4]), 40
        counts = np.repeat(times, side // 2)[None].repeat(side, axis=0)
        texel = np.repeat(np.arange(side * side), counts.ravel())
        shares = np.ones(len(texel), np.float32)
        rows = csr_array((shares, (np.arange(len(texel)), texel)), (len(texel), side * side))
        footprint = np.full((side, side), 0.4, np.float32)
        footprint[30:] = np.inf
        grey = np.full((side, side, 3), 0.5, np.float32)
        weight = error_weights(Visibility(footprint, [rows]), grey, "data")
        assert (weight[30:] == 0).all() and weight.shape == grey.shape
        np.testing.assert_allclose(weight[10, 35] / weight[10, 5], 2, rtol=1e-3)


class TestSearch:
    @given(st.integers(1, 5000), st.integers(1, 5000))
    def test_finds_what_is_enough(self, threshold, start):
        def attempt(count):
            return range(count), (50.0, 30.0 + (count >= threshold))

        best, reached, tried = scenefit._search_count(attempt, 31.0, start, 8000)
        assert reached == (50.0, 31.0)
        assert threshold <= len(best) <= max(threshold * scenefit.CLOSE, threshold)
        counts = [count for count, _ in tried]
        assert len(set(counts)) == len(counts) < 30


def seen_by_a_renderer(found, scene, place, image):
    """PSNR of the albedo, as Mitsuba renders it, of the set against the image."""
    gaussians = texture_of(found.gaussians, wrap_mode="clamp")
    full = bitmap(to_linear(image))
    a, b = (albedo(scene(camera(place), texture=t)) for t in (gaussians, full))
    return eg.psnr(to_coded(a.clip(0, 1)), to_coded(b.clip(0, 1)))


class TestFit:
    @pytest.mark.parametrize("distance", [1.0, 2.7])
    def test_a_renderer_sees_what_was_asked_for(self, distance):
        # The poster fills the picture, or nearly: what is around it is the same for both.
        image = photo()
        found = eg.fit_for_scene(
            scene_of(camera([0, 0, distance])), NAME, image, target_psnr=BOUND, iterations=STEPS
        )
        assert min(found.psnr) >= BOUND
        rendered = seen_by_a_renderer(found, scene_of, [0, 0, distance], image)
        assert rendered > BOUND - 1
        assert (found.gaussians.width, found.gaussians.height) == (48, 48)
        assert found.gaussians.space == "linear"

    def test_far_away_fewer_are_enough(self):
        counts = [
            len(
                eg.fit_for_scene(
                    scene_of(camera([0, 0, distance])),
                    NAME,
                    photo(),
                    target_psnr=BOUND,
                    iterations=STEPS,
                ).gaussians
            )
            for distance in (2.7, 7.0, 20.0)
        ]
        assert counts[0] > 2 * counts[1] > 4 * counts[2]

    def test_texels_beyond_what_cameras_resolve_change_nothing(self):
        scene, image = scene_of(camera([0, 0, 7.0])), photo()
        more = np.kron(image, np.ones((4, 4, 1), np.float32))
        few, many = (
            eg.fit_for_scene(scene, NAME, x, target_psnr=BOUND, iterations=STEPS).gaussians
            for x in (image, more)
        )
        assert (many.width, many.height) == (192, 192)
        np.testing.assert_allclose(many.mean.numpy(), 4 * few.mean.numpy(), atol=0.4)

    def test_none_is_spent_on_what_is_hidden(self):
        arguments = (NAME, photo(), BOUND)
        whole = eg.fit_for_scene(scene_of(camera([0, 0, 5.0])), *arguments, iterations=STEPS)
        half = eg.fit_for_scene(
            scene_of(camera([0, 0, 5.0]), board=board(0.0, 1.5)), *arguments, iterations=STEPS
        )
        assert len(half.gaussians) < 0.75 * len(whole.gaussians)
        assert half.gaussians.to_arrays()["mean"][:, 0].max() < 30
        assert half.visibility.seen.shape == (48, 48)

    def test_every_camera_is_content(self):
        scene = scene_of(camera([0, 0, 5.0]), camera([3, 0, 4.0]))
        found = eg.fit_for_scene(scene, NAME, photo(), target_psnr=BOUND, iterations=STEPS)
        assert len(found.psnr) == 2 and min(found.psnr) >= BOUND
        counts = [count for count, reached in found.tried if reached >= BOUND]
        assert min(counts) == len(found.gaussians)

    def test_data_of_one_channel(self):
        data = photo()[..., :1]
        found = eg.fit_for_scene(
            scene_of(camera([0, 0, 5.0])),
            NAME,
            data,
            target_psnr=BOUND,
            space="data",
            iterations=STEPS,
        )
        assert found.gaussians.space == "data" and found.gaussians.channels == 1
        rows = found.visibility.pixel_to_texel[0]
        shown = (rows @ p.reshape(-1, 1) for p in (eg.render(found.gaussians).numpy(), data))
        assert eg.psnr(*(s[:, None] for s in shown), space="data") > BOUND - 0.5


class TestMistakes:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            ({"space": "ycbcr"}, ["space 'ycbcr'", "linear"]),
            ({"target_psnr": 80.0}, ["target_psnr is 80"]),
            ({"target_psnr": float("nan")}, ["target_psnr is nan"]),
            ({"iterations": -1}, ["iterations"]),
            ({"max_gaussians": 0}, ["max_gaussians"]),
            ({"max_gaussians": 2, "iterations": 0}, ["2 Gaussians reach"]),
            ({"texture": "poster"}, ["not in the scene", NAME]),
            ({"image": np.zeros((4, 4, 2), np.float32)}, ["shape"]),
        ],
    )
    def test_cost_a_line(self, arguments, words):
        arguments = {"texture": NAME, "image": photo(), **arguments}
        with pytest.raises(ValueError) as error:
            eg.fit_for_scene(scene_of(camera([0, 0, 5.0])), **arguments)
        assert "\n" not in str(error.value)
        assert all(word in str(error.value) for word in words)
