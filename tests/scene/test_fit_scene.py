"""No more Gaussians than cameras resolve: the target, the search, and what a renderer then sees."""

import signal
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, laplace, zoom
from scipy.sparse import csr_array

import eigengs_dr as eg
from _helpers.poster import NAME, albedo, bitmap, blocks, board, camera, photo, scene_of
from _helpers.sets import few
from eigengs_dr.fitting.loop import descend, last
from eigengs_dr.fitting.state import begin
from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.image.space import DATA
from eigengs_dr.plugins import texture_of
from eigengs_dr.scene import fit_scene as scenefit
from eigengs_dr.scene.target import _blur_by, back_project, error_weights, extrapolate
from eigengs_dr.scene.visibility import Visibility

pytestmark = pytest.mark.mitsuba

BOUND, STEPS = 33.0, 30


class TestTarget:
    def test_squared_errors_count_by_the_pixels(self):
        times, side = np.array([1, 4]), 40
        counts = np.repeat(times, side // 2)[None].repeat(side, axis=0)
        texel = np.repeat(np.arange(side * side), counts.ravel())
        shares = np.ones(len(texel), np.float32)
        rows = csr_array((shares, (np.arange(len(texel)), texel)), (len(texel), side * side))
        footprint = np.full((side, side), 0.4, np.float32)
        footprint[30:] = np.inf
        grey = np.full((side, side, 3), 0.5, np.float32)
        weight = error_weights(Visibility(footprint, [rows]), grey, DATA)
        assert (weight[30:] == 0).all() and weight.shape == grey.shape
        np.testing.assert_allclose(weight[10, 35] / weight[10, 5], 4, rtol=1e-3)

    @few
    @given(st.integers(0, 100), st.floats(0, 0.9))
    def test_what_is_not_seen_is_filled_from_what_is(self, seed, hidden):
        generator = np.random.default_rng(seed)
        values = generator.uniform(0.2, 0.8, (20, 13, 3)).astype(np.float32)
        seen = generator.uniform(size=(20, 13)) >= hidden
        seen[3, 4] = True
        found = extrapolate(np.where(seen[..., None], values, np.float32(1e6)), seen)
        np.testing.assert_array_equal(found[seen], values[seen])
        low, high = values[seen].min(axis=0), values[seen].max(axis=0)
        assert (found >= low - 1e-3).all() and (found <= high + 1e-3).all()

    def test_filling_is_smooth(self):
        values = photo(64)
        seen = np.zeros((64, 64), bool)
        seen[:, :20] = True
        bend = np.abs(laplace(extrapolate(values, seen).mean(axis=2)))
        assert bend[:, 24:].max() < 0.05 < np.abs(laplace(values.mean(axis=2)))[:, 24:].max()

    def test_an_uneven_blur_is_each_in_its_place(self):
        image, deviation = photo(64), np.full((64, 64), np.inf)
        deviation[:, :20], deviation[:, 20:40] = 1.0, 5.0
        found = _blur_by(deviation)(image)
        for columns, sigma in ((slice(0, 20), 1.0), (slice(40, 48), 5.0)):
            part = slice(16, 48), columns  # borders are continued more coarsely
            expected = gaussian_filter(image, (sigma, sigma, 0), mode="nearest")
            np.testing.assert_allclose(found[part], expected[part], atol=0.01)
        for other in (deviation, np.full((9, 6), 5.0), np.ones((1, 1))):
            flat = np.ones((*other.shape, 1), np.float32)
            np.testing.assert_allclose(_blur_by(other)(flat), 1, atol=1e-5)

    def test_cameras_take_it_for_the_image(self):
        image = photo()
        rows = blocks(48, 6)
        found = Visibility(np.full((48, 48), 2.4, np.float32), [rows])
        *_, target = back_project(image, found, 1.0)
        blurred = gaussian_filter(image, (2.4, 2.4, 0), mode="nearest")

        def missed(t):
            return np.sqrt(np.mean((rows @ (t - image).reshape(-1, 3)) ** 2))

        def bend(t):
            return np.sqrt(np.mean(laplace(t.mean(axis=2)) ** 2))

        assert missed(target) < 0.2 * missed(blurred)
        assert bend(target) < 0.2 * bend(image)
        assert target.min() >= 0 and target.max() <= 1


def seen_by_a_renderer(found, place, image, target=(0, 0, 0)):
    """PSNR of the albedo, as Mitsuba renders it, of the set against the image."""
    textures = texture_of(found.gaussians, wrap_mode="clamp"), bitmap(to_linear(image))
    a, b = (albedo(scene_of(camera(place, target=target), texture=t)) for t in textures)
    return eg.psnr(to_coded(a.clip(0, 1)), to_coded(b.clip(0, 1)))


def fitted(*cameras, image=None, space="linear", **others):
    """A fit of the poster for a scene with these cameras."""
    image = photo() if image is None else image
    settings = {"target_psnr": BOUND, "space": space, "iterations": STEPS}
    return eg.fit_for_scene(scene_of(*cameras, **others), NAME, image, **settings)


@cache
def seen_from(distance):
    """A fit of the poster for one camera in front of it."""
    return fitted(camera([0, 0, distance]))


class TestFit:
    def test_few_gaussians_for_a_large_smooth_target(self):
        large = gaussian_filter(np.kron(photo(), np.ones((4, 4, 1)))[:189, :187], (8, 8, 0))
        target, seen = large.astype(np.float32), np.ones(large.shape[:2], bool)
        objective = scenefit._objective(target, np.ones_like(target), seen, 40, DATA)
        assert objective.grid.width * objective.grid.height < seen.size / 3
        start = eg.DEFAULT.place_and_solve(objective, 40)
        found = last(descend(objective, eg.DEFAULT, begin(start), STEPS), start).scaled(187, 189)
        assert eg.psnr(eg.render(found).numpy(), target) > 31.5

    @pytest.mark.parametrize("distance", [1.0, 2.7])
    def test_a_renderer_sees_what_was_asked_for(self, distance):
        # The poster fills the picture, or nearly: what is around it is the same for both.
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
        counts = [len(seen_from(distance).gaussians) for distance in (2.7, 7.0, 20.0)]
        assert counts[0] > 2 * counts[1] > 4 * counts[2]

    def test_texels_beyond_what_cameras_resolve_change_nothing(self):
        more = np.kron(photo(), np.ones((4, 4, 1), np.float32))
        cameras = [camera([0, 0, distance]) for distance in np.linspace(6, 7.5, 4)]
        few, many = ([fitted(c, image=x) for c in cameras] for x in (photo(), more))
        assert {(found.gaussians.width, found.gaussians.height) for found in many} == {(192, 192)}
        # With few Gaussians a fit is a matter of rounding, so of several the mean counts.
        first, other = ([found.tried[0] for found in fits] for fits in (few, many))
        assert [count for count, _ in first] == [count for count, _ in other]
        assert np.mean(other, axis=0)[1] == pytest.approx(np.mean(first, axis=0)[1], abs=0.1)
        # The searches part then: with a Gaussian more or less, a fit differs by half a decibel.
        counts = [sum(len(found.gaussians) for found in fits) for fits in (few, many)]
        assert counts[1] == pytest.approx(counts[0], rel=0.15)

    def test_none_is_spent_on_what_is_hidden(self):
        whole = seen_from(5.0)
        half = fitted(camera([0, 0, 5.0]), board=board(0.0, 1.5))
        assert len(half.gaussians) < 0.75 * len(whole.gaussians)
        assert half.gaussians.to_arrays()["mean"][:, 0].max() < 30
        assert half.visibility.seen.shape == (48, 48)

    def test_only_what_is_seen_is_enlarged(self, monkeypatch):
        """A camera so close to a corner that a pixel is less than two texels."""
        enlarged = []

        def counted(values, factors, **settings):
            enlarged.append(values.shape[:2])
            return zoom(values, factors, **settings)

        monkeypatch.setattr(scenefit, "zoom", counted)
        close = camera([0.7, 0.6, 0.4], target=[0.7, 0.6, 0])
        found = fitted(close)
        [(height, width)] = enlarged
        rows, columns = np.nonzero(found.visibility.seen)
        assert height <= np.ptp(rows) + 3 < 24 and width <= np.ptp(columns) + 3 < 24
        assert min(found.psnr) >= BOUND
        assert seen_by_a_renderer(found, [0.7, 0.6, 0.4], photo(), [0.7, 0.6, 0]) > BOUND - 1

    def test_every_camera_is_content(self):
        found = fitted(camera([0, 0, 5.0]), camera([3, 0, 4.0]))
        assert len(found.psnr) == 2 and min(found.psnr) >= BOUND
        counts = [count for count, reached in found.tried if reached >= BOUND]
        assert min(counts) == len(found.gaussians)

    def test_data_of_one_channel(self):
        data = photo()[..., :1]
        found = fitted(camera([0, 0, 5.0]), image=data, space="data")
        assert found.gaussians.space == "data" and found.gaussians.channels == 1
        rows = found.visibility.pixel_to_texel[0]
        shown = (rows @ p.reshape(-1, 1) for p in (eg.render(found.gaussians).numpy(), data))
        assert eg.psnr(*(s[:, None] for s in shown), space="data") > BOUND - 0.5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"space": "ycbcr"}, "space 'ycbcr'.*linear"),
        ({"space": "data", "encoding": "light"}, "encoding 'light'"),
        ({"target_psnr": 80.0}, "target_psnr is 80"),
        ({"target_psnr": float("nan")}, "target_psnr is nan"),
        ({"iterations": -1}, "iterations"),
        ({"max_gaussians": 0}, "max_gaussians"),
        ({"max_gaussians": 2, "iterations": 0}, "2 Gaussians reach"),
        ({"texture": "poster"}, f"not in the scene.*{NAME}"),
        ({"image": np.zeros((4, 4, 2), np.float32)}, "shape"),
        ({"image": photo() - 0.5, "space": "data"}, r"image: data from -0\.\d+ to .*from 0 to 1"),
    ],
)
def test_mistakes_cost_a_line(arguments, words):
    arguments = {"texture": NAME, "image": photo(), **arguments}
    with pytest.raises(ValueError, match=words) as error:
        eg.fit_for_scene(scene_of(camera([0, 0, 5.0])), **arguments)
    assert "\n" not in str(error.value)


def test_ctrl_c_keeps_the_best_set():
    calls = []

    def stop(done, total, row):
        calls.append(row["stage"])
        if row["stage"] == "search" and done >= 20:
            assert row["gaussians"] > 0 and row["psnr"] == min(row["psnr_of_cameras"])
            raise KeyboardInterrupt

    scene = scene_of(camera([0, 0, 5.0]))
    with pytest.raises(eg.Interrupted) as stopped:
        eg.fit_for_scene(scene, NAME, photo(), BOUND, iterations=STEPS, progress=stop)
    found = stopped.value.result
    assert list(dict.fromkeys(calls)) == ["rays", "target", "search"]
    assert min(found.psnr) in [psnr for _, psnr in found.tried]
    text = f"SceneFit({len(found.gaussians)} Gaussians, 48x48 pixels, psnr=({found.psnr[0]:.2f}))"
    assert repr(found) == text


@pytest.mark.parametrize("stage", ["rays", "target", "search"])
def test_a_signal_in_any_stage(stage):
    """It ends the call where progress is told next; before the search there is no set."""
    calls = []

    def stop(done, total, row):
        calls.append(row["stage"])
        if row["stage"] == stage and calls.count(stage) == 1:
            signal.raise_signal(signal.SIGINT)

    scene = scene_of(camera([0, 0, 5.0]))
    with pytest.raises(eg.Interrupted, match="interrupted") as stopped:
        eg.fit_for_scene(scene, NAME, photo(), BOUND, iterations=STEPS, progress=stop)
    assert calls[-1] == stage and calls.count(stage) == 1
    assert (stopped.value.result is not None) == (stage == "search")
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
