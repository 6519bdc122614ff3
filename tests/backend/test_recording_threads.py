"""Several threads of one process: fits, the garbage collector, and programs that are dropped."""

import gc
import os
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.process import run_python
from _helpers.waves import default, picture, start
from eigengs_dr.backend import recording
from eigengs_dr.backend.recording import collector_off, exclusive
from eigengs_dr.fitting.descent import FitProblem, descend

WAIT = 100
"""Seconds after which a thread that does not answer fails its test."""


def run_in_thread(function):
    """Run a function to its end in another thread; return its result or raise its error."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result(WAIT)


def test_fits_in_four_threads_have_the_bits_of_fits_one_by_one(backend):
    image = picture()

    def fit_one(number):
        found = eg.fit(np.roll(image, number, axis=0), gaussians=40, iterations=4, backend=backend)
        arrays = found.gaussians.to_arrays()
        return b"".join(arrays[name].tobytes() for name in arrays) + found.image.tobytes()

    alone = [fit_one(number) for number in range(40)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(fit_one, range(40), timeout=4 * WAIT)) == alone


def test_gradients_beside_fits_have_the_bits_of_gradients_alone(backend):
    def gradient(_):
        with eg.exclusive():
            gaussians, _ = start(backend)
            dr.enable_grad(gaussians.mean)
            rendered = eg.render(replace(gaussians, color=gaussians.color + 1))
            dr.backward(dr.sum(dr.square(rendered.array)))
            return dr.grad(gaussians.mean).numpy().tobytes()

    alone = gradient(None)
    with ThreadPoolExecutor(3) as pool:
        fits = [
            pool.submit(eg.fit, picture(), gaussians=40, iterations=4, backend=backend)
            for _ in range(4)
        ]
        assert set(pool.map(gradient, range(20), timeout=WAIT)) == {alone}
        assert len({fit.result(WAIT).image.tobytes() for fit in fits}) == 1


@pytest.mark.parametrize("use", ["fit", "arrays"])
def test_calls_wait_for_the_block_of_another_thread(use):
    image = picture()
    calls = {
        "fit": lambda: eg.fit(image, gaussians=40, iterations=0, backend="llvm"),
        "arrays": start("llvm")[0].to_arrays,
    }
    done = threading.Event()
    thread = threading.Thread(target=lambda: (calls[use](), done.set()))
    with exclusive():
        thread.start()
        assert not done.wait(0.2)
    assert done.wait(WAIT)
    thread.join()


def test_the_collector_stays_off_until_the_last_thread_is_done():
    inside, leave = threading.Event(), threading.Event()

    def other():
        with collector_off():
            inside.set()
            assert leave.wait(WAIT)

    thread = threading.Thread(target=other)
    with collector_off():
        thread.start()
        assert inside.wait(WAIT)
    assert not gc.isenabled()
    leave.set()
    thread.join()
    assert gc.isenabled()


def half_read(backend):
    """A descent of which one step was taken."""
    gaussians, target = start(backend)
    sets = descend(FitProblem(gaussians, target), default(redistribute_after=0), 5)
    next(sets)
    next(sets)
    return sets


DROP_WHILE_RECORDING = """
    import drjit as dr
    from _helpers.waves import default, start
    from eigengs_dr.backend.recording import freeze_program
    from eigengs_dr.backend.selection import select
    from eigengs_dr.fitting.descent import FitProblem
    from eigengs_dr.fitting.descent import descend

    def half_read():
        gaussians, target = start({backend!r})  # arrays that share NumPy's memory
        sets = descend(FitProblem(gaussians, target), default(redistribute_after=0), 5)
        for _ in range({count}):
            next(sets)
        return sets

    drop = [half_read()].clear
    Float = select({backend!r}).Float

    def drops(x):
        y = dr.gather(Float, x, dr.arange(dr.uint32_array_t(Float), 2))
        drop()
        return x + y

    with freeze_program(drops) as call:
        for x in (1, 2, 3):
            assert dr.all(call(Float(x, x)) == 2 * x)
    print("whole")
"""


@pytest.mark.parametrize("count", [1, 3])
def test_a_descent_that_a_program_drops_while_it_is_recorded(backend, count):
    """Dr.Jit ends the process if an array that shares NumPy's memory is freed then."""
    code = textwrap.dedent(DROP_WHILE_RECORDING).format(backend=backend, count=count)
    run = run_python(code, PYTHONPATH=os.pathsep.join(sys.path))
    assert run.stdout == "whole\n", run.stderr


def test_a_descent_dropped_in_another_thread_is_freed_by_the_thread_that_computes(backend):
    dropped = [half_read(backend)]
    with exclusive():
        run_in_thread(dropped.clear)
        assert len(recording._retired) == 2  # the program, and the set of the caller
    assert not recording._retired
    half_read(backend).close()  # at rest, at once
    assert not recording._retired


def test_errors_leave_the_lock(backend):
    with pytest.raises(ValueError, match="gaussians"):
        eg.fit(picture(), gaussians=-1, backend=backend)
    assert run_in_thread(lambda: eg.fit(picture(), gaussians=9, iterations=0).iterations) == 0
