"""`eigengs_dr.fit`: one image to Gaussians, whatever the image and the options; how it ends."""

import gc
import signal
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.clusters import FirstCall
from _helpers.command import said
from _helpers.families import small_model
from _helpers.kernels import jit, launches
from _helpers.materials import images
from _helpers.sets import check_equal
from _helpers.waves import SIDE, SPLATS, check_sound, figures, methods, often, picture


def fit(image, gaussians=SPLATS, iterations=60, **options):
    return eg.fit(image, gaussians, iterations, **options)


def test_the_result(backend):
    """It ends above its start, and the trace says when it measured what."""
    result = fit(picture(), iterations=30, backend=backend)
    check_sound(result, picture())
    assert figures(result)[-1] > figures(result)[0] + 1
    assert len(result.gaussians) == SPLATS
    assert result.image.shape == (SIDE, SIDE, 3)
    assert (result.gaussians.width, result.gaussians.height) == (SIDE, SIDE)
    assert (result.iterations, result.stopped) == (30, "iterations")
    assert [row["iteration"] for row in result.trace] == [0, 10, 20, 30]
    for row in result.trace:
        assert sorted(row) == ["gaussians", "iteration", "psnr_rgb", "psnr_ycbcr", "seconds"]
        assert all(type(row[k]) is float for k in ("seconds", "psnr_rgb", "psnr_ycbcr"))
    seconds = [row["seconds"] for row in result.trace]
    assert seconds == sorted(seconds)
    assert 0 < result.seconds_init <= seconds[0] and seconds[-1] <= result.seconds
    text = repr(result)  # neither pixels nor the trace
    assert len(text) < 200 and f"{SPLATS} Gaussians" in text and "psnr_rgb=" in text


def test_default_settings(backend):
    """One Gaussian per pixel of a small image; of a thousand steps, twice the same bits."""
    assert len(eg.fit(picture(), iterations=0, backend=backend).gaussians) == SIDE * SIDE
    first, second = (eg.fit(picture(), SPLATS, backend=backend) for _ in range(2))
    check_sound(first, picture())
    assert (first.iterations, first.stopped) == (1000, "iterations")
    assert first.psnr_ycbcr > figures(first)[0] + 3
    assert figures(first) == figures(second)
    check_equal(second.gaussians, first.gaussians.to_arrays())


def test_solve_steps_start_better(backend):
    """Zero iterations keep the solved start."""
    starts = [
        fit(picture(), iterations=0, method=replace(eg.DEFAULT, solve_steps=n), backend=backend)
        for n in (0, 2, 20)
    ]
    psnrs = [start.psnr_ycbcr for start in starts]
    assert psnrs == sorted(psnrs) and psnrs[2] > psnrs[0] + 5
    assert [len(start.trace) for start in starts] == [1, 1, 1]
    check_sound(starts[2], picture())


# --- Determinism --------------------------------------------------------------------------------


@methods
def test_one_seed_gives_one_result(method, backend):
    """Whatever was fitted in between; another seed gives another one, unless nothing is drawn."""
    start = small_model(backend) if method.needs_model else None
    options = {"start": start, "method": method, "backend": backend}

    def run(seed):
        return fit(picture(), iterations=30, seed=seed, **options)

    first = run(5)
    fit(picture(17, 22), 24, iterations=3, backend=backend)
    second = run(5)
    assert figures(first) == figures(second)
    check_equal(second.gaussians, first.gaussians.to_arrays())
    for other in (6, 5 + 2**40):
        assert (figures(run(other)) != figures(first)) == (start is None)


def test_one_seed_gives_one_search():
    first, second, other = (
        eg.fit(picture(), target_psnr=30, iterations=60, seed=seed) for seed in (0, 0, 1)
    )
    assert figures(first) == figures(second) != figures(other)
    check_equal(second.gaussians, first.gaussians.to_arrays())


@pytest.mark.slow
def test_recording_changes_nothing(backend):
    """Although Gaussians come and go, a recorded step serves all their numbers."""
    ends = []
    for recorded in (True, False):
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, recorded):
            ends.append(fit(picture(), 40, 100, method=often(), backend=backend).gaussians)
    check_equal(ends[1], ends[0].to_arrays())


WHOLE = [(60, 68, 290), (96, 40, 500), (64, 104, 301)]
"""Width, height and number of Gaussians; the width is a power of two or not. Dr.Jit merges programs
of like size, therefore no two arrays of one rendering may happen to have the same size."""

OVERHANGING = [(61, 67, 290), (97, 39, 500)]
"""Sizes that are no multiples of a tile."""

MORE = {"llvm": 0, "cuda": 5}
"""Programs that a size may add: on cuda, two searches, the keys and the two passes of a sort depend
on the number of bits of a size."""


@pytest.mark.parametrize("sizes", [WHOLE, OVERHANGING], ids=["whole", "overhanging"])
def test_fits_of_all_sizes_share_their_programs(backend, sizes):
    """The first size comes twice: what was compiled lets the next call look for flushed kernels."""
    programs = []
    for width, height, count in (sizes[0], *sizes):
        image = np.random.default_rng(0).uniform(0, 1, (height, width, 3))
        with launches() as launched:
            eg.fit(image, count, iterations=30, backend=backend)
        programs.append({kernel.hash for kernel in jit(launched)})
    first, again, *others = programs
    assert first and all(len(other - (first | again)) <= MORE[backend] for other in others)


# --- Images -------------------------------------------------------------------------------------


@methods
@pytest.mark.parametrize("value", [0.0, 0.3])
def test_constant_images(method, value, backend):
    image = np.full((SIDE, SIDE, 3), value, np.float32)
    start = small_model(backend) if method.needs_model else None
    result = fit(image, method=method, start=start, backend=backend)
    check_sound(result, image)
    if method is eg.DEFAULT:
        assert figures(result)[0] > 100
        assert value or result.stopped == "exact"


@pytest.mark.parametrize("shape", [(1, 1), (1, 37)])
@pytest.mark.parametrize("init", ["adaptive", "grid", "random"])
def test_narrow_images(shape, init, tmp_path):
    """By every placement of the command line."""
    image = np.random.default_rng(0).uniform(0, 1, (*shape, 3)).astype(np.float32)
    eg.save_image(tmp_path / "a.png", image)
    count = max(1, shape[0] * shape[1] // 2)
    options = ["--gaussians", count, "--iterations", 12, "--init", init]
    said("fit", tmp_path / "a.png", "-o", tmp_path / "a.npz", *options)
    found = eg.Gaussians.load(tmp_path / "a.npz")
    assert len(found) == count and eg.picture_of(found).shape == image.shape
    assert np.isfinite(eg.picture_of(found)).all()


@pytest.mark.parametrize("count", [1, 9, SIDE * SIDE])
def test_fewest_and_most_gaussians(count):
    """Also in descents whose rounds move a share of them."""
    result = fit(picture(), count, 100 if count == 9 else 10, method=often())
    check_sound(result, picture())
    assert len(result.gaussians) == count


def test_kinds_of_images():
    """Grey of two and of three axes, bytes, double precision, lists: one picture, one result."""
    grey = np.round(picture()[..., :1] * 255).astype(np.uint8)
    expected = figures(fit(np.repeat(grey, 3, axis=2), iterations=10))
    kinds = (grey, grey[..., 0], grey / 255, (grey / 255).astype(np.float32), (grey / 255).tolist())
    for same in kinds:
        np.testing.assert_allclose(figures(fit(same, iterations=10)), expected, atol=1e-3)


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
def test_the_image_is_left_alone(space):
    """An image of float32 is not copied, so nothing may write to it: it can be read-only."""
    image = picture()
    image.setflags(write=False)
    found = fit(image, iterations=3, space=space)
    np.testing.assert_array_equal(image, picture())
    expected = fit(picture().astype(np.float64), iterations=3, space=space)
    np.testing.assert_array_equal(found.image, expected.image)


# --- Mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gaussians": 0}, "gaussians is 0; it must be at least 1"),
        ({"gaussians": SIDE**2 + 1}, "gaussians is 1025; an image of 32x32 takes 1 to 1024"),
        ({"iterations": -1}, "iterations is -1; it must be at least 0"),
        ({"space": "hsv"}, "space 'hsv' is unknown; use one of ycbcr, rgb, linear, data"),
        ({"backend": "opencl"}, "backend 'opencl' is unknown"),
        ({"image": np.zeros((1, 70_000, 3), np.float32)}, "sides from 1 to 65536"),
        ({"seed": -1}, "seed is -1"),
        ({"gaussians": 2.5}, "gaussians is 2.5; it must be a whole number"),
        ({"gaussians": b"5"}, "gaussians is b'5'; it must be a whole number"),
        ({"method": "default"}, "method is 'default'; pass a Method, such as eigengs_dr.DEFAULT"),
        ({"gausians": 5}, "unknown option 'gausians'; did you mean 'gaussians'?"),
    ],
    ids=lambda value: value if isinstance(value, str) else "-".join(value),
)
def test_options_that_are_refused(options, words):
    kinds = ("whole number", "pass a Method", "unknown option")
    with pytest.raises(TypeError if any(k in words for k in kinds) else ValueError) as error:
        eg.fit(**{"image": picture(), "gaussians": 9, "iterations": 3, **options})
    assert words in str(error.value)
    assert "\n" not in str(error.value)


# --- Progress and interruptions -----------------------------------------------------------------


def test_progress():
    """Told every ten steps, with the last row of the trace."""
    told = []
    result = fit(picture(), iterations=45, progress=lambda *a: told.append(a))
    assert [t[0] for t in told] == [0, 10, 20, 30, 40, 45]
    assert {t[1] for t in told} == {45}
    assert all(row in result.trace for *_, row in told)
    assert told[-1][2] == result.trace[-1]
    with pytest.raises(ZeroDivisionError):  # errors of the caller are passed on
        fit(picture(), iterations=10, progress=lambda *a: 1 / 0)


@pytest.mark.parametrize("when", [0, 10, 30])
def test_interruption_keeps_the_best_so_far(when, tmp_path):
    eg.save_image(tmp_path / "a.pfm", picture())

    def interrupt(iteration, iterations, row):
        if iteration >= when:
            raise KeyboardInterrupt

    with pytest.raises(eg.Interrupted) as interruption:
        fit(tmp_path / "a.pfm", progress=interrupt, encoding="srgb", space="ycbcr")
    result = interruption.value.result
    assert result.source == "a.pfm"
    check_sound(result, picture())
    assert (result.iterations, result.stopped) == (when, "interrupted")
    rows = [row["iteration"] for row in result.trace]
    assert rows == sorted({m for m in (0, 10, 20, 50) if m <= when} | {when})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals(number):
    """They end the run at the next step, and are the caller's again afterwards."""
    before = signal.getsignal(number)

    def progress(iteration, iterations, row):
        if iteration == 10:
            signal.raise_signal(number)

    with pytest.raises(KeyboardInterrupt) as interruption:
        fit(picture(), progress=progress)
    result = interruption.value.result
    assert result.stopped == "interrupted"
    assert result.iterations in (10, 11)
    assert [row["iteration"] for row in result.trace] == [0, 10]
    check_sound(result, picture())
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("iterations", [0, 1, 60])
def test_ctrl_c_before_refinement(iterations):
    """The start is kept, and the caller told."""
    pressing = FirstCall(lambda path: signal.raise_signal(signal.SIGINT))
    with pytest.raises(eg.Interrupted) as interruption:
        fit(picture(), iterations=iterations, method=replace(eg.DEFAULT, place=pressing))
    result = interruption.value.result
    check_sound(result, picture())
    assert (len(result.trace), result.stopped) == (1, "interrupted")


@pytest.mark.parametrize("kind", ["image", pytest.param("maps", marks=pytest.mark.slow)])
def test_a_fit_leaves_no_arrays_to_the_collector(kind):
    """In a frozen function of the user, Dr.Jit waits forever if the collector frees an array."""
    target = picture() if kind == "image" else images()

    def run():
        fit(target, iterations=3, progress=False)

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
