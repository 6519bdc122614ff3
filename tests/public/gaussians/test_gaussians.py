"""Sets of splats: arrays in and out, selection and parts, sizes, bounds, several as one."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from _helpers.footprints import matrices
from _helpers.sets import COUNT, NAMES, SIZE, arrays_of, check_equal, few, random_scene
from eigengs_dr.backend.selection import select
from eigengs_dr.gaussian.file import CUTOFF, SetData
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION, Gaussians, concatenate
from eigengs_dr.gaussian.region import crop
from eigengs_dr.many.draw import draw
from eigengs_dr.raster.render import render


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7])
def test_arrays_come_back(backend, channels):
    scene = random_scene(channels=channels)
    gaussians = Gaussians.from_arrays(**arrays_of(scene), size=SIZE, space="data", backend=backend)
    check_equal(gaussians, arrays_of(scene))
    assert len(gaussians) == COUNT
    assert gaussians.channels == channels
    assert type(gaussians.mean) is select(backend).Array2f
    assert {v.dtype for v in gaussians.to_arrays().values()} == {np.dtype("f4")}


def test_what_is_left_out_of_from_arrays(backend):
    gaussians = Gaussians.from_arrays(
        [[4, 5]], [[1, 0, 1]], [[1, 2, 3]], size=(np.int64(8), np.int32(9)), backend=backend
    )
    assert gaussians.space == "ycbcr"
    assert not gaussians.to_arrays()["background"].any()
    assert (type(gaussians.width), gaussians.width, gaussians.height) == (int, 8, 9)


@pytest.mark.parametrize("count", [1, COUNT])
def test_from_arrays_copies(backend, count):
    """What the caller does to the arrays afterwards does not matter, however busy the device is."""
    expected = arrays_of(random_scene(count=count))
    arrays = {k: v.astype(np.float32) for k, v in expected.items()}
    Float = select(backend).Float
    busy = Float(0)
    for k in range(4):
        busy = busy + dr.sum(dr.sin(dr.arange(Float, 1 << 23) + k))
        dr.eval(busy)
    gaussians = Gaussians.from_arrays(**arrays, size=SIZE, space="data", backend=backend)
    for array in arrays.values():
        array[:] = 7
    check_equal(gaussians, expected)


def test_arrays_of_values_that_all_splats_share(backend):
    scene = random_scene()
    gaussians = replace(scene.on(backend), factor=select(backend).Array3f(0.5, 0.25, 0.75))
    factor = np.tile([0.5, 0.25, 0.75], (COUNT, 1))
    check_equal(gaussians, {**arrays_of(scene), "factor": factor})
    check_equal(gaussians[3:7], arrays_of(scene._replace(factor=factor).permuted(slice(3, 7))))


BAD = [
    ("mean", np.zeros((0, 2)), r"mean has shape \(0, 2\)"),
    ("factor", np.ones((COUNT - 1, 3)), "factor has shape"),
    ("color", np.ones(COUNT), "color has shape"),
    ("background", np.ones(2), "background has shape"),
    ("mean", np.full((COUNT, 2), np.nan), "mean holds values that are not finite"),
    ("factor", np.full((COUNT, 3), np.inf), "factor holds values that are not finite"),
    ("color", np.full((COUNT, 3), -np.inf), "color holds values that are not finite"),
    ("background", np.full(3, np.nan), "background holds values that are not finite"),
    ("factor", np.zeros((COUNT, 3)), "a or c <= 0"),
    ("factor", np.tile([1, 0, -1], (COUNT, 1)), "a or c <= 0"),
    ("factor", np.full((COUNT, 3), 1e-60), "a or c <= 0"),  # 0 in float32
    ("size", (5, 1 << 17), "size is"),
    ("space", "hsv", "space is 'hsv'"),
    ("space", "a\nb", "space is"),
    ("color", 5.0, "color has shape"),
    ("color", np.ones((COUNT, 0)), "color"),
    ("size", (8.0, 9), "whole pixels"),
]


@pytest.mark.parametrize(("name", "value", "message"), BAD)
def test_arrays_that_make_no_set(name, value, message):
    good = {**arrays_of(random_scene()), "size": SIZE, "space": "data"}
    if name == "color":
        good.pop("background")
    with pytest.raises(ValueError, match=message) as error:
        Gaussians.from_arrays(**{**good, name: value})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("space", "channels"), [("ycbcr", 1), ("ycbcr", 4), ("rgb", 2), ("linear", 5)]
)
def test_channels_that_a_space_has_not(space, channels):
    with pytest.raises(ValueError, match=f"space '{space}' has"):
        Gaussians.from_arrays(**arrays_of(random_scene(channels=channels)), size=SIZE, space=space)


# --- Selection --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "index",
    [
        slice(None),
        slice(3, 9),
        slice(None, None, -2),
        slice(-4, None),
        5,
        -1,
        [7, 0, 0, -2],
        np.array([3, 1], np.int16),
        np.arange(COUNT) % 3 == 0,
        np.ones(COUNT, bool),
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


@pytest.mark.parametrize(
    ("index", "error"),
    [
        (i, IndexError)
        for i in (COUNT, -COUNT - 1, [0, COUNT], np.ones(COUNT - 1, bool), 0.5, [[0], [1]])
    ]
    + [(i, ValueError) for i in (np.array([], int), slice(5, 5), np.zeros(COUNT, bool))],
    ids=str,
)
def test_selection_of_what_is_not_there_and_of_nothing(backend, index, error):
    with pytest.raises(error, match="empty" if error is ValueError else None):
        random_scene().on(backend)[index]


# --- Size -------------------------------------------------------------------------------------


def test_scaled(backend):
    scene = random_scene()
    larger = scene.on(backend).scaled(44, 51)
    assert (larger.width, larger.height) == (44, 51)
    found = larger.to_arrays()
    np.testing.assert_allclose(found["mean"], scene.mean * [2, 3], rtol=1e-6)
    np.testing.assert_allclose(found["factor"], scene.factor / [2, 3, 3], rtol=1e-6)
    np.testing.assert_array_equal(found["color"], np.float32(scene.color))


@pytest.mark.parametrize("size", [(0, 1), (1, 0), (-1, -1)])
def test_scaled_to_nothing(backend, size):
    with pytest.raises(ValueError, match="at least 1 pixel"):
        random_scene().on(backend).scaled(*size)


def test_sets_are_trees_of_arrays(backend):
    """Dr.Jit's own functions reach all parameters."""
    gaussians = random_scene().on(backend)
    dr.enable_grad(gaussians)
    assert all(dr.grad_enabled(getattr(gaussians, name)) for name in NAMES)
    dr.backward(dr.sum(dr.square(gaussians.color)) + dr.sum(gaussians.mean))
    gradient = dr.grad(gaussians)
    assert isinstance(gradient, Gaussians)
    assert repr(gradient) == f"Gaussians({len(gaussians)}, derivatives)"
    np.testing.assert_allclose(gradient.color, 2 * gaussians.to_arrays()["color"].T, rtol=1e-6)
    assert not dr.grad_enabled(dr.detach(gaussians).mean)


def test_sets_in_double_precision(backend, tmp_path):
    """Values keep 64 bits, renderings have them, and files hold 32."""
    arrays = arrays_of(random_scene())
    arrays = {name: np.asarray(array, np.float64) + 1e-9 for name, array in arrays.items()}
    g = Gaussians.from_arrays(**arrays, size=SIZE, space="data", backend=backend, dtype=np.float64)
    check_equal(g, arrays)
    single = Gaussians.from_arrays(**arrays, size=SIZE, space="data", backend=backend)
    picture = render(g)
    assert picture.numpy().dtype == np.float64
    np.testing.assert_allclose(picture.numpy(), render(single).numpy(), atol=1e-4)
    g.save(tmp_path / "g.npz")
    again = Gaussians.load(tmp_path / "g.npz", backend, dtype="float64")
    assert type(again.mean) is type(g.mean)
    np.testing.assert_array_equal(again.mean.numpy(), single.mean.numpy())


@pytest.mark.parametrize("dtype", [np.float16, np.int32, complex])
def test_other_precisions_are_refused(dtype):
    with pytest.raises(ValueError, match=r"give numpy\.float32 or numpy\.float64"):
        Gaussians.from_arrays([[4, 5]], [[1, 0, 1]], [[1]], size=(8, 8), dtype=dtype)


def test_complex_numbers_are_refused():
    with pytest.raises(ValueError, match="Gaussians: color is complex; pass real numbers"):
        Gaussians.from_arrays([[4, 5]], [[1, 0, 1]], [[1j]], size=(8, 8), space="data")


# --- Several sets as one --------------------------------------------------------------------------


def test_concatenation(backend):
    """Splats one after the other, backgrounds added."""
    parts = [random_scene(seed, count) for seed, count in ((0, COUNT), (1, 3), (2, 1))]
    sets = [p.on(backend) for p in parts]
    shared = [0.5, 0.25, 0.75]  # by all splats of a set
    sets[1].factor = select(backend).Array3f(shared)
    parts[1].factor[:] = shared
    joined = concatenate(sets)
    expected = {name: np.concatenate([getattr(p, name) for p in parts]) for name in NAMES[:3]}
    background = 3 * parts[0].background.astype(np.float32)
    assert len(joined) == COUNT + 4
    found = joined.to_arrays()
    np.testing.assert_allclose(found.pop("background"), background, rtol=1e-6)
    for name, value in found.items():
        np.testing.assert_array_equal(value, np.float32(expected[name]))
    assert concatenate(sets[:1]) is sets[0]


def test_concatenation_of_nothing():
    with pytest.raises(ValueError, match="no sets"):
        concatenate([])


def test_concatenation_of_what_differs(backend):
    first = random_scene().on(backend)
    others = [
        random_scene(size=(9, 9)).on(backend),
        random_scene(channels=1).on(backend),
        replace(first, space="rgb"),
        random_scene().on(backend, 64),
    ]
    for other in others:
        with pytest.raises(ValueError, match="sets differ") as error:
            concatenate([first, other])
        assert "\n" not in str(error.value)


# --- Bounds ---------------------------------------------------------------------------------------


LOW, HIGH = 1 / (2 * max(SIZE)), 1 / MIN_DEVIATION
"""Bounds of the diagonal of a factor."""

any_floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


def unbounded(backend, values):
    """A set with any numbers: values has shape (COUNT, 8)."""
    scene = random_scene()._replace(mean=values[:, :2], factor=values[:, 2:5], color=values[:, 5:])
    return scene.on(backend)


def check_bounds(arrays):
    mean, factor = arrays["mean"], arrays["factor"].astype(np.float64)
    assert ((mean >= 0) & (mean <= SIZE)).all()
    a, b, c = factor.T
    for diagonal in (a, c):
        assert ((diagonal >= LOW * (1 - 1e-6)) & (diagonal <= HIGH)).all()
    assert (np.abs(b) <= HIGH).all()
    assert np.isfinite(arrays["color"]).all()
    inverse = np.array([[a * a, a * b], [a * b, b * b + c * c]]).transpose(2, 0, 1)
    assert (np.linalg.det(inverse) > 0).all()


@few
@given(values=hnp.arrays(np.float32, (COUNT, 8), elements=any_floats))
def test_bounds_hold_after_any_step(backend, values):
    bounded = unbounded(backend, values).bounded()
    check_bounds(bounded.to_arrays())
    check_equal(bounded.bounded(), bounded.to_arrays())


def test_bounds_leave_alone_what_is_inside(backend):
    scene = random_scene()
    scene = scene._replace(mean=np.clip(scene.mean, 0, SIZE))
    check_equal(scene.on(backend).bounded(), arrays_of(scene))


def test_what_replaces_numbers_that_are_not_finite(backend):
    """A mean by the middle, a factor by its bound, a colour by 0."""
    for value in (np.nan, np.inf, -np.inf):
        found = unbounded(backend, np.full((COUNT, 8), value)).bounded().to_arrays()
        np.testing.assert_array_equal(found["mean"][0], [SIZE[0] / 2, SIZE[1] / 2])
        np.testing.assert_array_equal(found["factor"][0], [HIGH, 0, HIGH])
        assert not found["color"].any()
    scene = random_scene(size=(1, 1))._replace(background=np.array([np.nan, 0, np.inf]))
    smallest = scene.on(backend).bounded().to_arrays()
    assert np.isfinite(smallest["background"]).all()
    assert ((smallest["mean"] >= 0) & (smallest["mean"] <= 1)).all()
    assert smallest["factor"][:, [0, 2]].min() >= 0.5


def random_set(count=200, size=(96, 64)):
    """Gaussians of many sizes and angles."""
    rng = np.random.default_rng(3)
    mean = rng.uniform(0, size, (count, 2))
    a, c = np.exp(rng.uniform(-2.5, 0.5, (2, count)))
    factor = np.stack([a, rng.normal(0, 0.3, count), c], axis=1)
    color = rng.normal(0, 0.3, (count, 3))
    arrays = {"mean": mean, "factor": factor, "color": color, "background": [0.4, 0.5, 0.5]}
    return SetData({k: np.asarray(v, np.float32) for k, v in arrays.items()}, size, "data")


def test_only_gaussians_that_touch_are_kept():
    data = random_set()
    part = crop(data, (40, 30), (8, 8))
    assert 0 < len(part.arrays["mean"]) < len(data.arrays["mean"])
    kept = np.isin(data.arrays["color"][:, 0], part.arrays["color"][:, 0])
    variances = np.diagonal(matrices(*data.arrays["factor"].T.astype(float)), axis1=1, axis2=2)
    away = np.abs(data.arrays["mean"] - (44, 34)) - CUTOFF * np.sqrt(variances)
    assert kept[(away <= 4).all(axis=1)].all()
    assert not kept[(away > 5.1).any(axis=1)].any()


def test_part_without_gaussians_is_background():
    data = random_set(1)
    data.arrays["mean"][:] = 2
    data.arrays["factor"][:] = [2, 0, 2]
    part = crop(data, (50, 30), (4, 3))
    assert len(part.arrays["mean"]) == 0
    found = draw(part, "llvm")
    np.testing.assert_array_equal(found, np.broadcast_to(np.float32([0.4, 0.5, 0.5]), (3, 4, 3)))
