"""`fit`: one image to Gaussians, whatever the image and the options; how a fit ends."""

import gc
import signal
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_model
from _helpers.sets import check_equal
from _helpers.waves import METHODS, SIDE, SPLATS, check_sound, figures, methods, picture
from eigengs_dr.backend.interrupts import Interrupted
from eigengs_dr.fitting.fit import fit
from eigengs_dr.fitting.method import DEFAULT
from eigengs_dr.fitting.options import default_count
from eigengs_dr.fitting.place import Adaptive, Grid, Random, gaussians_at, grid_of
from eigengs_dr.image.io import sample, save_image
from eigengs_dr.image.metrics import psnr
from eigengs_dr.image.space import SPACES
from eigengs_dr.raster.render import render

places = pytest.mark.parametrize("place", [Adaptive(), Grid(), Random()], ids=repr)
"""The placements of the package."""


@places
def test_fit_improves_on_its_start(backend, place):
    result = fit(picture(), SPLATS, 60, method=replace(DEFAULT, place=place), backend=backend)
    check_sound(result, picture())
    assert figures(result)[-1] > figures(result)[0] + 1
    assert len(result.gaussians) == SPLATS
    assert result.image.shape == (SIDE, SIDE, 3)
    assert (result.gaussians.width, result.gaussians.height) == (SIDE, SIDE)


def test_trace(backend):
    result = fit(picture(), SPLATS, 30, backend=backend)
    assert [row["iteration"] for row in result.trace] == [0, 10, 20, 30]
    for row in result.trace:
        assert sorted(row) == ["gaussians", "iteration", "psnr_rgb", "psnr_ycbcr", "seconds"]
        assert all(type(row[k]) is float for k in ("seconds", "psnr_rgb", "psnr_ycbcr"))
    seconds = [row["seconds"] for row in result.trace]
    assert seconds == sorted(seconds)
    assert 0 < result.seconds_init <= seconds[0]
    assert seconds[-1] <= result.seconds
    best = max(result.trace, key=lambda row: row["psnr_ycbcr"])
    reached = psnr(picture(), result.image, space="rgb")
    assert best["psnr_rgb"] == pytest.approx(reached, abs=1e-3)


def test_a_fit_at_default_settings(backend):
    """Of a thousand steps: it ends above its start, and once more with the same bits."""
    image = sample("coffee")[10:58, 60:108]
    first, second = (fit(image, backend=backend) for _ in range(2))
    check_sound(first, image)
    assert (first.iterations, first.stopped) == (1000, "iterations")
    assert len(first.gaussians) == default_count(48 * 48)
    assert first.psnr_ycbcr > figures(first)[0] + 3
    assert figures(first) == figures(second)
    check_equal(second.gaussians, first.gaussians.to_arrays())


def test_zero_iterations_keep_the_solved_start(backend):
    result = fit(picture(), SPLATS, 0, backend=backend)
    check_sound(result, picture())
    assert len(result.trace) == 1
    assert (result.iterations, result.stopped) == (0, "iterations")
    assert figures(result)[0] > 20


def test_more_solve_steps_start_better(backend):
    starts = [
        figures(fit(picture(), SPLATS, 0, method=method, backend=backend))[0]
        for method in (replace(DEFAULT, solve_steps=steps) for steps in (0, 2, 20))
    ]
    assert starts == sorted(starts)
    assert starts[2] > starts[0] + 5


def small_start(method, backend):
    """A start for a method that needs one."""
    return small_model(backend) if method.needs_model else None


@methods
def test_one_seed_gives_one_result(backend, method):
    """Others give others, but for the method that draws nothing."""
    start = small_start(method, backend)
    if start is None:
        method = replace(method, place=Random() if method is DEFAULT else method.place)

    def run(iterations, seed):
        return fit(
            picture(),
            start=start,
            gaussians=SPLATS,
            iterations=iterations,
            method=method,
            seed=seed,
            backend=backend,
        )

    first, second = run(30, 5), run(30, 5)
    assert figures(first) == figures(second)
    check_equal(second.gaussians, first.gaussians.to_arrays())
    assert (figures(run(0, 6))[0] != figures(first)[0]) == (start is None)
    if method is METHODS["gaussianimage"]:
        assert not first.gaussians.to_arrays()["background"].any()


@pytest.mark.parametrize("options", [{"gaussians": 60}, {"target_psnr": 40}])
def test_seeds_drive_the_noise(backend, options):
    """One seed repeats bit for bit, and another gives another result."""
    image, found = sample("coffee")[100:132, 200:232], []
    for seed in (0, 0, 1):
        result = fit(image, iterations=150, seed=seed, backend=backend, **options)
        found.append((figures(result), result.gaussians.to_arrays()))
    (first, arrays), (again, same), (other, _) = found
    assert first == again
    for name, values in arrays.items():
        np.testing.assert_array_equal(same[name], values)
    assert first != other


@methods
@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_constant_images(backend, method, value):
    image = np.full((SIDE, SIDE, 3), value, np.float32)
    start = small_start(method, backend)
    result = fit(image, SPLATS, 60, method=method, start=start, backend=backend)
    check_sound(result, image)
    if method is DEFAULT:
        assert figures(result)[0] > 100


def test_black_is_exact(backend):
    result = fit(np.zeros((SIDE, SIDE, 3)), SPLATS, 1000, backend=backend)
    assert result.stopped == "exact"
    assert result.iterations < 1000


@pytest.mark.parametrize("shape", [(1, 1), (1, 37), (37, 1), (2, 3)])
@places
def test_narrow_images(backend, shape, place):
    image = np.random.default_rng(0).uniform(0, 1, (*shape, 3)).astype(np.float32)
    count = max(1, shape[0] * shape[1] // 2)
    result = fit(image, count, 12, method=replace(DEFAULT, place=place), backend=backend)
    check_sound(result, image)
    assert result.image.shape == image.shape


@pytest.mark.parametrize("count", [1, 2, SIDE * SIDE])
def test_fewest_and_most_splats(backend, count):
    result = fit(picture(), count, 12, backend=backend)
    check_sound(result, picture())
    assert len(result.gaussians) == count


def test_kinds_of_images(backend):
    """Grey of two and of three axes, bytes, double precision, lists: one picture, one result."""
    image = np.round(picture() * 255).astype(np.uint8)
    grey = image[..., :1]
    expected = figures(fit(np.repeat(grey, 3, axis=2), SPLATS, 10, backend=backend))
    for same in (grey, grey[..., 0], grey / 255, (grey / 255).astype(np.float32), grey.tolist()):
        same = np.asarray(same, np.uint8) if isinstance(same, list) else same
        found = figures(fit(same, SPLATS, 10, backend=backend))
        np.testing.assert_allclose(found, expected, atol=1e-3)


def test_two_channels_are_data(backend, tmp_path):
    """Such as x and y of normals."""
    image = picture()[..., :2]
    result = fit(image, SPLATS, 100, space="data", backend=backend)
    assert result.image.shape == image.shape and result.gaussians.channels == 2
    error = np.mean((result.image - image) ** 2)
    assert result.psnr_ycbcr == pytest.approx(-10 * np.log10(error), abs=0.01)
    result.save(tmp_path / "two.npz")
    again = eg.picture_of(eg.Gaussians.load(tmp_path / "two.npz", backend))
    np.testing.assert_allclose(again, result.image, atol=1e-5)
    assert eg.view(result, image)
    with pytest.raises(ValueError, match="fit two channels as space='data'"):
        fit(image, SPLATS, backend=backend)


@pytest.mark.parametrize("color", SPACES)
def test_the_image_is_left_alone(backend, color):
    """An image of float32 is not copied, so nothing may write to it: it can be read-only."""
    image = picture()
    image.setflags(write=False)
    found = fit(image, SPLATS, 3, space=color, backend=backend)
    np.testing.assert_array_equal(image, picture())
    expected = fit(picture().astype(np.float64), SPLATS, 3, space=color, backend=backend)
    np.testing.assert_array_equal(found.image, expected.image)


@methods
@pytest.mark.parametrize("factor", [10, 1000])
def test_rates_far_too_high(backend, method, factor):
    """Nothing but finite numbers, and never worse than the start."""
    start = small_start(method, backend)
    result = fit(
        picture(), SPLATS, 100, start=start, method=method.at_rates(factor), backend=backend
    )
    assert np.isfinite(figures(result)).all()
    check_sound(result, picture())


# --- Mistakes ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gaussians", 0, "gaussians is 0; it must be at least 1"),
        ("gaussians", -3, "gaussians is -3; it must be at least 1"),
        ("gaussians", SIDE * SIDE + 1, "gaussians is 1025; an image of 32x32 takes 1 to 1024"),
        ("iterations", -1, "iterations is -1; it must be at least 0"),
        ("space", "hsv", "space 'hsv' is unknown; use one of ycbcr, rgb, linear, data"),
        ("backend", "opencl", "backend 'opencl' is unknown"),
        ("image", np.zeros((0, 4, 3)), "image"),
        ("image", np.full((4, 4, 3), np.nan), "image"),
        ("image", np.zeros((4, 4, 7)), "image"),
        ("seed", -1, "seed is -1"),
        ("gaussians", 2.5, "gaussians is 2.5"),
        ("iterations", 2.5, "iterations is 2.5"),
    ],
)
def test_arguments_out_of_range(name, value, words):
    arguments = {"image": picture(), "gaussians": SPLATS, "iterations": 3, name: value}
    if name == "image":
        arguments["gaussians"] = 1
    with pytest.raises(TypeError if isinstance(value, float) else ValueError) as error:
        fit(**arguments)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"method": "default"}, "method is 'default'; pass a Method, such as eigengs_dr.DEFAULT"),
        ({"gausians": 5}, "unknown option 'gausians'; did you mean 'gaussians'?"),
        ({"target": 36}, "unknown option 'target'; did you mean 'target_psnr'?"),
        ({"init": "grid"}, "unknown option 'init'"),
    ],
)
def test_what_is_no_option(option, words):
    with pytest.raises(TypeError) as error:
        fit(picture(), **option)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_the_repr_is_short(backend):
    """It shows figures, and neither pixels nor the trace."""
    text = repr(fit(picture(), SPLATS, 0, backend=backend))
    assert len(text) < 200 and f"{SPLATS} Gaussians" in text and "psnr_rgb=" in text


def test_a_cutoff_stays_with_its_set(backend):
    result = fit(picture(), SPLATS, 10, method=replace(DEFAULT, cutoff=4), backend=backend)
    assert result.gaussians.cutoff == 4
    shown = render(result.gaussians).numpy()
    np.testing.assert_array_equal(shown, result.image)
    assert not np.array_equal(render(result.gaussians, cutoff=3).numpy(), shown)


@pytest.mark.parametrize("when", [0, 10, 30])
def test_interruption_keeps_the_best_so_far(backend, when, tmp_path):
    save_image(tmp_path / "a.pfm", picture())

    def interrupt(iteration, iterations, row):
        if iteration >= when:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as interruption:
        fit(
            tmp_path / "a.pfm",
            SPLATS,
            60,
            progress=interrupt,
            backend=backend,
            encoding="srgb",
            space="ycbcr",
        )
    result = interruption.value.result
    assert result.source == "a.pfm"
    check_sound(result, picture())
    assert (result.iterations, result.stopped) == (when, "interrupted")
    rows = [row["iteration"] for row in result.trace]
    assert rows == sorted({m for m in (0, 10, 20, 50) if m <= when} | {when})
    reached = psnr(picture(), result.image, space="ycbcr")
    assert max(figures(result)) == pytest.approx(reached, abs=1e-3)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals(backend, number):
    """They end the run at the next step, and are the caller's again afterwards."""
    before = signal.getsignal(number)

    def progress(iteration, iterations, row):
        if iteration == 10:
            signal.raise_signal(number)

    with pytest.raises(KeyboardInterrupt) as interruption:
        fit(picture(), SPLATS, 60, progress=progress, backend=backend)
    result = interruption.value.result
    assert result.stopped == "interrupted"
    assert result.iterations in (10, 11)
    assert [row["iteration"] for row in result.trace] == [0, 10]
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    assert signal.getsignal(number) is before


class Pressing:
    """A placement that presses Ctrl-C."""

    has_colors = False

    def __call__(self, objective, count, cutoff, seed):
        signal.raise_signal(signal.SIGINT)
        return gaussians_at(objective, *grid_of(objective.size, count), cutoff)


@pytest.mark.parametrize("iterations", [0, 1, 60])
def test_ctrl_c_before_refinement(backend, iterations):
    """The start is kept, and the caller told."""
    method = replace(DEFAULT, place=Pressing())
    with pytest.raises(Interrupted) as interruption:
        fit(picture(), SPLATS, iterations, method=method, backend=backend)
    result = interruption.value.result
    check_sound(result, picture())
    assert len(result.trace) == 1
    assert result.stopped == "interrupted"


def test_other_errors_of_the_caller_are_passed_on(backend):
    """Afterwards, signals are the caller's again."""
    before = signal.getsignal(signal.SIGINT)

    def fail(iteration, iterations, row):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fit(picture(), SPLATS, 10, progress=fail, backend=backend)
    assert signal.getsignal(signal.SIGINT) is before


def test_progress(backend):
    """Told every ten steps, with the last row of the trace."""
    told = []
    result = fit(picture(), SPLATS, 45, progress=lambda *a: told.append(a), backend=backend)
    assert [t[0] for t in told] == [0, 10, 20, 30, 40, 45]
    assert {t[1] for t in told} == {45}
    assert all(row in result.trace for *_, row in told)
    assert told[-1][2] == result.trace[-1]


@pytest.mark.parametrize("kind", ["image", "maps"])
def test_a_fit_leaves_no_arrays_to_the_collector(kind, backend):
    """In a frozen function of the user, Dr.Jit waits forever if the collector frees an array."""
    image = picture()
    target = image if kind == "image" else {"albedo": image, "roughness": image[..., 0]}

    def run():
        fit(target, SPLATS, 3, progress=False, backend=backend)

    run()  # what a first call imports and compiles may leave circles
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        run()
        gc.collect()
        left = {f"{type(o).__module__}.{type(o).__name__}" for o in gc.garbage}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert not [name for name in left if name.startswith(("drjit.", "eigengs_dr."))]
