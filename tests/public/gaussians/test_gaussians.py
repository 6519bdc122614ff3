"""Sets of Gaussians: arrays in and out, selection, sizes, bounds, maps, several as one."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import eigengs_dr as eg
from _helpers.errors import complaint
from _helpers.materials import MAPS, material
from _helpers.reference import render_exact
from _helpers.sets import COUNT, NAMES, SIZE, arrays_of, check_equal, few, random_scene


def from_arrays(backend=None, **changed):
    options = {**arrays_of(random_scene()), "size": SIZE, "space": "data", "backend": backend}
    return eg.Gaussians.from_arrays(**{**options, **changed})


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_arrays_come_back(backend, channels):
    scene = random_scene(channels=channels)
    gaussians = from_arrays(backend, **arrays_of(scene))
    check_equal(gaussians, arrays_of(scene))
    assert (len(gaussians), gaussians.channels) == (COUNT, channels)
    assert type(gaussians.mean) is getattr(dr, backend).ad.Array2f
    assert {v.dtype for v in gaussians.to_arrays().values()} == {np.dtype("f4")}


def test_what_is_left_out_of_from_arrays():
    size = np.int64(8), np.int32(9)
    gaussians = eg.Gaussians.from_arrays([[4, 5]], [[1, 0, 1]], [[1, 2, 3]], size=size)
    assert gaussians.space == "ycbcr"
    assert not gaussians.to_arrays()["background"].any()
    assert (type(gaussians.width), gaussians.width, gaussians.height) == (int, 8, 9)


def test_from_arrays_copies(backend):
    """What the caller does to the arrays afterwards does not matter, however busy the device is."""
    arrays = {k: v.astype(np.float32) for k, v in arrays_of(random_scene()).items()}
    busy = getattr(dr, backend).ad.Float(0)
    for k in range(4):
        busy = busy + dr.sum(dr.sin(dr.arange(type(busy), 1 << 23) + k))
        dr.eval(busy)
    gaussians = from_arrays(backend, **arrays)
    for array in arrays.values():
        array[:] = 7
    check_equal(gaussians, arrays_of(random_scene()))


def test_values_that_all_gaussians_share(backend, tmp_path):
    scene, factor = random_scene(), np.tile([0.5, 0.25, 0.75], (COUNT, 1))
    gaussians = replace(scene.on(backend), factor=getattr(dr, backend).ad.Array3f(0.5, 0.25, 0.75))
    check_equal(gaussians, {**arrays_of(scene), "factor": factor})
    check_equal(gaussians[3:7], arrays_of(scene._replace(factor=factor).permuted(slice(3, 7))))
    gaussians.save(tmp_path / "x.npz")
    check_equal(eg.Gaussians.load(tmp_path / "x.npz"), gaussians.to_arrays())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"mean": np.zeros((0, 2))}, r"mean has shape \(0, 2\)"),
        ({"factor": np.ones((COUNT - 1, 3))}, "factor has shape"),
        ({"color": np.ones(COUNT)}, "color has shape"),
        ({"background": np.ones(2)}, "background has shape"),
        ({"mean": np.full((COUNT, 2), np.nan)}, "mean holds values that are not finite"),
        ({"factor": np.full((COUNT, 3), np.inf)}, "factor holds values that are not finite"),
        ({"color": np.full((COUNT, 3), 1j)}, "Gaussians: color is complex; pass real numbers"),
        ({"factor": np.zeros((COUNT, 3))}, "a or c <= 0"),
        ({"factor": np.full((COUNT, 3), 1e-60)}, "a or c <= 0"),  # 0 in float32
        ({"size": (5, 1 << 17)}, "size is"),
        ({"size": (8.0, 9)}, "whole pixels"),
        ({"space": "hsv"}, "space is 'hsv'"),
        ({"dtype": np.float16}, r"give numpy\.float32 or numpy\.float64"),
        ({"space": "rgb", "color": np.ones((COUNT, 2)), "background": None}, "space 'rgb' has"),
        ({"maps": [("a", "data", 1)] * 3}, "give each name once"),
        ({"maps": [("a", "hsv", 3)]}, "space 'hsv' is not in"),
        ({"maps": [("a", "normal", 1), ("b", "data", 2)]}, "has 1 channels; space 'normal' has 3"),
        ({"maps": [("a", "data", 3, np.nan)]}, "weight is nan"),
        ({"maps": [("a", "data", 1)]}, "but the Gaussians have 3"),
    ],
)
def test_arrays_that_make_no_set(changed, message):
    if np.ndim(changed.get("color")) == 1:
        changed = changed | {"background": None}
    with pytest.raises(ValueError, match=message) as error:
        from_arrays(**changed)
    assert "\n" not in str(error.value)


# --- Selection ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "index",
    [
        slice(3, 9),
        slice(None, None, -2),
        -1,
        [7, 0, 0, -2],
        np.array([3, 1], np.int16),
        np.arange(COUNT) % 3 == 0,
    ],
    ids=str,
)
def test_selection(backend, index):
    """As NumPy selects; the background stays."""
    scene = random_scene()
    kept = np.atleast_1d(np.arange(COUNT)[index])
    chosen = scene.on(backend)[index]
    assert len(chosen) == len(kept)
    check_equal(chosen, arrays_of(scene.permuted(kept)))
    assert (chosen.width, chosen.height, chosen.space) == (*SIZE, "data")


def test_selection_of_what_is_not_there_or_of_nothing():
    gaussians = random_scene().on("llvm")
    for index in (COUNT, -COUNT - 1, [0, COUNT], np.ones(COUNT - 1, bool), 0.5, [[0], [1]]):
        with pytest.raises(IndexError):
            gaussians[index]
    for index in (np.array([], int), slice(5, 5), np.zeros(COUNT, bool)):
        with pytest.raises(ValueError, match="empty"):
            gaussians[index]


# --- Sizes, trees, precision --------------------------------------------------------------------


def test_scaled(backend):
    scene = random_scene()
    larger = scene.on(backend).scaled(44, 51)
    assert (larger.width, larger.height) == (44, 51)
    found = larger.to_arrays()
    np.testing.assert_allclose(found["mean"], scene.mean * [2, 3], rtol=1e-6)
    np.testing.assert_allclose(found["factor"], scene.factor / [2, 3, 3], rtol=1e-6)
    np.testing.assert_array_equal(found["color"], np.float32(scene.color))
    with pytest.raises(ValueError, match="at least 1 pixel"):
        larger.scaled(0, 1)


def test_sets_are_trees_of_arrays(backend):
    """Dr.Jit's own functions reach all parameters."""
    gaussians = random_scene().on(backend)
    dr.enable_grad(gaussians)
    assert all(dr.grad_enabled(getattr(gaussians, name)) for name in NAMES)
    dr.backward(dr.sum(dr.square(gaussians.color)) + dr.sum(gaussians.mean))
    gradient = dr.grad(gaussians)
    assert repr(gradient) == f"Gaussians({len(gaussians)}, derivatives)"
    np.testing.assert_allclose(gradient.color, 2 * gaussians.to_arrays()["color"].T, rtol=1e-6)
    assert not dr.grad_enabled(dr.detach(gaussians).mean)


def test_sets_in_double_precision(backend, tmp_path):
    """Values keep 64 bits, renderings have them, and files hold 32."""
    arrays = {name: array + 1e-9 for name, array in arrays_of(random_scene()).items()}
    single, double = (from_arrays(backend, **arrays, dtype=t) for t in (np.float32, np.float64))
    check_equal(double, arrays)
    picture = eg.render(double).numpy()
    assert picture.dtype == np.float64
    np.testing.assert_allclose(picture, eg.render(single).numpy(), atol=1e-4)
    double.save(tmp_path / "g.npz")
    again = eg.Gaussians.load(tmp_path / "g.npz", backend, dtype="float64")
    assert type(again.mean) is type(double.mean)
    np.testing.assert_array_equal(again.mean.numpy(), single.mean.numpy())


# --- Several sets as one ------------------------------------------------------------------------


def test_concatenation(backend):
    """Gaussians one after the other, backgrounds added."""
    parts = [random_scene(seed, count) for seed, count in ((0, COUNT), (1, 3), (2, 1))]
    joined = eg.concatenate([part.on(backend) for part in parts])
    expected = {name: np.concatenate([getattr(p, name) for p in parts]) for name in NAMES[:3]}
    found = joined.to_arrays()
    np.testing.assert_allclose(found.pop("background"), 3 * parts[0].background, rtol=1e-6)
    for name, value in found.items():
        np.testing.assert_array_equal(value, np.float32(expected[name]))
    assert eg.concatenate([joined]) is joined
    with pytest.raises(ValueError, match="no sets"):
        eg.concatenate([])


def test_concatenation_of_what_differs():
    first = random_scene().on("llvm")
    for other in (
        random_scene(size=(9, 9)).on("llvm"),
        random_scene(channels=1).on("llvm"),
        replace(first, space="rgb"),
        random_scene().on("llvm", 64),
    ):
        assert "sets differ" in complaint(ValueError, eg.concatenate, [first, other])


# --- Bounds -------------------------------------------------------------------------------------

LOW, HIGH = 1 / (2 * max(SIZE)), 1 / 0.25
"""Bounds of the diagonal of a factor: twice the longer side, and a quarter of a pixel."""

any_floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


def unbounded(backend, values):
    """A set with any numbers: values has shape (COUNT, 8)."""
    scene = random_scene()._replace(mean=values[:, :2], factor=values[:, 2:5], color=values[:, 5:])
    return scene.on(backend)


@few
@given(values=hnp.arrays(np.float32, (COUNT, 8), elements=any_floats))
def test_bounds_hold_after_any_step(backend, values):
    bounded = unbounded(backend, values).bounded()
    arrays = bounded.to_arrays()
    assert ((arrays["mean"] >= 0) & (arrays["mean"] <= SIZE)).all()
    a, b, c = arrays["factor"].astype(np.float64).T
    for diagonal in (a, c):
        assert ((diagonal >= LOW * (1 - 1e-6)) & (diagonal <= HIGH)).all()
    assert (np.abs(b) <= HIGH).all()
    assert np.isfinite(arrays["color"]).all()
    check_equal(bounded.bounded(), arrays)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_what_replaces_numbers_that_are_not_finite(backend, value):
    """A mean by the middle, a factor by its bound, a colour by 0."""
    found = unbounded(backend, np.full((COUNT, 8), value)).bounded().to_arrays()
    np.testing.assert_array_equal(found["mean"][0], [SIZE[0] / 2, SIZE[1] / 2])
    np.testing.assert_array_equal(found["factor"][0], [HIGH, 0, HIGH])
    assert not found["color"].any()
    scene = random_scene(size=(1, 1))._replace(background=np.array([value, 0, 1]))
    smallest = scene.on(backend).bounded().to_arrays()
    assert np.isfinite(smallest["background"]).all()
    assert ((smallest["mean"] >= 0) & (smallest["mean"] <= 1)).all()
    assert smallest["factor"][:, [0, 2]].min() >= 0.5


# --- Maps ---------------------------------------------------------------------------------------


def test_the_set_of_a_map_renders_its_channels(backend):
    """The oracle renders each map alone, in double precision."""
    m = material(backend=backend)
    arrays, pictures, end = m.to_arrays(), eg.picture_of(m), 0
    for name, space, channels, _ in m.maps:
        view, part = m[name], slice(end, end + channels)
        end += channels
        assert (view.space, view.channels) == (space, channels)
        color, background = arrays["color"][:, part], arrays["background"][part]
        shape = arrays["mean"], arrays["factor"]
        exact = render_exact(*shape, color, background, *SIZE, m.cutoff)
        summed = eg.render(replace(view, space="data")).numpy()
        np.testing.assert_allclose(summed, exact, atol=2e-3)  # a Gaussian ends at its cutoff
        np.testing.assert_allclose(pictures[name], eg.picture_of(view), atol=2e-6)
        assert view.mean[0].index == m.mean[0].index  # one memory


def test_names_of_maps():
    m = material()
    assert repr(m) == "Gaussians(24, 22x17 pixels, maps albedo, roughness, normal, cutoff=3)"
    with pytest.raises(KeyError, match="no map is named 'height'; it has albedo, roughness, norm"):
        m["height"]
    assert (len(m[:7]), len(m[:7]["normal"]), m[:7].maps) == (7, 7, MAPS)
    with pytest.raises(KeyError, match="it has no maps"):
        m["normal"]["normal"]
