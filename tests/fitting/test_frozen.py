"""Losses that Dr.Jit records: equal bits, and errors for what a replay would not notice."""

import functools
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import numpy as np
import pytest
from drjit.opt import Adam

import eigengs_dr as eg
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select

SIDE = 64
TYPES = types_in(select())
IMAGE = eg.sample("coffee")[100 : 100 + SIDE, 200 : 200 + SIDE]
WANTED = TYPES.Tensor(IMAGE)
HALF = np.float32(0.5)
FEW = {"gaussians": 100, "iterations": 30, "space": "rgb"}


def absolute(picture, wanted=WANTED):
    return dr.mean(dr.abs(picture - wanted), axis=None)


def l1_ssim(picture, step):
    return absolute(picture) + 0.2 * (1 - eg.ssim(picture, WANTED))


def squares(picture, step=0):
    return dr.mean(dr.square(picture - WANTED), axis=None)


def fit(function, frozen=True, **options):
    return eg.fit(loss=eg.Loss(function, frozen=frozen), **{"image": IMAGE, **FEW, **options})


def assert_equal(one, other):
    for name, rows in one.gaussians.to_arrays().items():
        np.testing.assert_array_equal(rows, other.gaussians.to_arrays()[name], err_msg=name)


@pytest.mark.parametrize(
    "given", [{}, {"image": None, "size": (SIDE, SIDE)}], ids=["image", "free"]
)
def test_a_frozen_loss_gives_equal_bits(given):
    """Through all controls, with few calls of the function."""
    calls = []

    def counted(picture, step):
        calls.append(step)
        return l1_ssim(picture, step)

    plain = fit(counted, frozen=False, iterations=150, **given)
    many, calls[:] = len(calls), []
    for function in (l1_ssim, counted):
        assert_equal(fit(function, iterations=150, **given), plain)
    assert many > 150 and len(calls) < many - 100


def test_maps_may_be_frozen():
    rough = TYPES.Tensor(IMAGE[..., :1])

    def loss(pictures, step):
        color, data = pictures["color"], pictures["rough"]
        return squares(color) + dr.mean(dr.abs(data - rough), axis=None)

    spaces = {"color": "rgb", "rough": "data"}
    options = {**FEW, "size": (SIDE, SIDE), "space": spaces}
    one, other = (
        eg.fit(loss=eg.Loss(loss, bounds=(0, 1), frozen=frozen), **options)
        for frozen in (True, False)
    )
    assert_equal(one, other)


def test_another_size_and_each_number_of_a_search_are_recorded():
    def flat(picture, step):
        return dr.mean(dr.square(picture - 0.3), axis=None)

    loss = eg.Loss(flat, frozen=True)
    for size in ((32, 32), (40, 24), (32, 32)):
        one, other = (eg.fit(loss=f, size=size, **FEW) for f in (loss, flat))
        assert_equal(one, other)
    options = {"image": IMAGE, "iterations": 60, "space": "rgb"}
    one, other = (
        eg.fit(loss=eg.Loss(squares, target=1e-3, frozen=frozen), **options)
        for frozen in (True, False)
    )
    assert one.stopped == "met"
    assert_equal(one, other)


def test_a_replay_sees_the_step():
    def later(picture, step):
        noise = dr.rng(seed=step).random(type(picture), (SIDE, SIDE, 3))
        return dr.mean(dr.abs(picture - WANTED + 0.1 * noise) * (1 + 0.1 * step), axis=None)

    one, other = (fit(later, frozen=frozen).image for frozen in (True, False))
    np.testing.assert_allclose(one, other, atol=0.01)


@pytest.mark.parametrize("kind", ["number", "array", "counter"])
def test_what_changes_is_noticed(kind):
    """A number or an array that another function changes after some steps; the function itself."""
    held = {"number": 1.0, "array": WANTED, "calls": 0}

    def loss(picture, step):
        if kind == "counter":
            held["calls"] += 1
        return held["number"] * absolute(picture, held["array"]) * (1 + held["calls"])

    def change(step, steps, row):
        if step == 10 and kind != "counter":
            held[kind] = 0.5 * held[kind]

    with pytest.raises(
        ValueError, match="changed after it was recorded; drop frozen=True"
    ) as error:
        fit(loss, progress=change)
    assert "\n" not in str(error.value)
    held.update(number=1.0, array=WANTED)
    fit(loss, frozen=False, progress=change)


def imports(picture, step):
    import cmath

    return cmath.pi * squares(picture)


class Losses:
    """A module, an object or a method do not say what they use."""

    def l1(self, picture, step):
        return absolute(picture)


LOSSES = Losses()


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda p, s: squares(p) * HALF, "uses HALF of numpy"),
        (lambda p, s: absolute(p, type(p)(IMAGE)), "uses IMAGE of numpy"),
        (lambda p, s: squares(p) * np.float32(0.5), "uses np.float32 of numpy"),
        (lambda p, s: squares(p) * np.random.default_rng(0).random(), "uses np.random of numpy"),
        (lambda p, s: sum(squares(q * HALF) for q in [p]), "uses HALF of numpy"),
        (lambda p, s, half=HALF: squares(p) * half, "uses a default of numpy"),
        (lambda p, s: absolute(p, type(p)(eg.sample("coffee")[:64, :64])), "uses eg.sample of eig"),
        (lambda p, s: squares(p) + float(p.numpy().mean()), "uses numpy, which"),
        (lambda p, s: squares(p) + dr.mean(dr.sort(p.array)), "uses sort, which"),
        (lambda p, s: LOSSES.l1(p, s), "uses LOSSES of"),
        (imports, "uses cmath, which"),
    ],
)
def test_what_may_end_the_process_is_refused(function, message):
    """In one line; most of it converts arrays of NumPy."""
    with pytest.raises(TypeError, match=f"frozen=True, but its function {message}") as error:
        fit(function)
    assert "\n" not in str(error.value)
    fit(function, frozen=False, iterations=2)


@pytest.mark.parametrize(
    "function",
    [
        lambda p, s: squares(p) * (2 if s > 1 else 1),
        lambda p, s: absolute(p, [WANTED, WANTED][s % 2]),
        lambda p, s: dr.mean(p * type(p)([0.2, 0.7, 0.1], (1, 1, 3)), axis=None),
        lambda p, s: squares(p) if dr.detach(p).array[0] > 2 else absolute(p),
    ],
)
def test_what_dr_jit_cannot_record_is_refused(function):
    with pytest.raises(ValueError, match="cannot record its function") as error:
        fit(function)
    assert "\n" not in str(error.value)
    fit(function, frozen=False, iterations=2)


def test_a_network_is_refused():
    torch = pytest.importorskip("torch")

    @dr.wrap(source="drjit", target="torch")
    def distance(picture):
        return torch.mean(torch.square(picture))

    with pytest.raises(TypeError, match=r"uses torch\.\w+ of "):
        fit(lambda picture, step: distance(picture))


def test_errors_of_the_function_pass():
    def interrupts(picture, step):
        raise KeyboardInterrupt

    def raises(picture, step):
        raise RuntimeError("mine")

    def ends(picture, step):
        raise StopIteration("mine")

    with pytest.raises(eg.Interrupted):
        fit(interrupts)
    for function, kind in ((raises, RuntimeError), (ends, StopIteration)):
        with pytest.raises(kind, match="mine"):
            fit(function)
    with pytest.raises(ValueError, match="array of shape"):
        fit(lambda picture, step: dr.square(picture))
    with pytest.raises(ValueError, match="does not depend on the picture"):
        fit(lambda picture, step: 1.0)


def test_what_is_not_recorded_is_refused_at_once():
    for function, options in (
        (squares, {"frozen": 1}),
        (LOSSES.l1, {"frozen": True}),
        (functools.partial(squares), {"frozen": True}),
        (squares, {"frozen": True, "parameters": Adam(lr=0.1, params={"gain": TYPES.Float(1)})}),
    ):
        with pytest.raises(TypeError, match="; give True or False"):
            eg.Loss(function, **options)


def test_threads_share_nothing():
    def of(weight):
        return lambda picture, step: weight * l1_ssim(picture, step)

    weights = (0.5, 1.0, 3.0, 7.0)
    expected = [fit(of(weight), frozen=False) for weight in weights]
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda weight: fit(of(weight)), weights))
    for one, other in zip(found, expected, strict=True):
        assert_equal(one, other)
