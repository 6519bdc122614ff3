"""Recorded programs, the garbage collector, and several threads of one process."""

import gc
import threading
import time
import weakref
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_model
from _helpers.process import python_path, run_python
from _helpers.waves import half_read, picture, start
from eigengs_dr.backend import recording
from eigengs_dr.backend.doors import door
from eigengs_dr.backend.executor import LocalExecutor
from eigengs_dr.backend.recording import (
    LARGEST_RECORDED,
    collector_off,
    exclusive,
    freeze_program,
    record,
)
from eigengs_dr.backend.selection import select

LITTER = """
import gc

import numpy as np

from eigengs_dr.backend.selection import select
from eigengs_dr.backend.recording import freeze_program

class Node:
    pass

def program(x):
    made = [[] for _ in range(200_000)]  # wakes the collector up
    return 2 * x + len(made) * 0 + 1

Float = select("llvm").Float
gc.collect()
node = Node()
node.cycle, node.array = node, Float(np.ones(1_000_000, np.float32))
del node
with freeze_program(program) as call:
    print(call(Float(1, 2, 3)), gc.isenabled())
"""


def test_arrays_of_numpy_in_cycles_do_not_end_the_process():
    done = run_python(LITTER)
    assert (done.returncode, done.stdout) == (0, "[3, 5, 7] True\n"), done.stderr


def test_the_collector_is_left_as_it_was(backend):
    Float = select(backend).Float

    def refuse(x):
        assert not gc.isenabled()
        raise ValueError("no")

    with freeze_program(refuse) as call, pytest.raises(ValueError, match="no"):
        call(Float(1))
    assert gc.isenabled()
    gc.disable()
    try:
        with freeze_program(lambda x: x + 1) as call:
            call(Float(1))
        assert not gc.isenabled()
    finally:
        gc.enable()


@dataclass(frozen=True)
class Pair:
    x: Any
    factor: int


def test_a_program_of_a_module_notices_other_sizes(backend):
    """Also of arrays in lists and dataclasses, whose sizes are numbers in the program."""
    Float, traced = select(backend).Float, []

    @record
    def grown(x, rows):
        traced.append(dr.width(x))
        return [x * (dr.width(row.x) * row.factor) for row in rows]

    for size, other in ((4, 3), (5, 3), (4, 6), (4, 3), (4, 6)):
        x, row = dr.arange(Float, size), Pair(dr.arange(Float, other), 2)
        dr.eval(x, row)
        (found,) = grown(x, [row])
        assert dr.all(found == 2 * other * x)
    assert traced == [4, 5, 4]


def test_constants_are_not_mixed_up(backend):
    """Dr.Jit 1.5 replays a program of the constants 16, 32, 0 for 16, 32, 16."""
    x = dr.arange(select(backend).Float, 3)
    dr.eval(x)

    @record
    def shifted(x, constants):
        return x + constants[2], None if constants[2] == 0 else x

    for last in (0, 16, 0):
        moved, rest = shifted(x, (16, 32, last))
        assert dr.all(moved == x + last) and (rest is None) == (last == 0)


def test_a_program_takes_and_returns_what_is_made_of_arrays(backend):
    x = dr.arange(select(backend).Float, 3)
    dr.eval(x)
    with freeze_program(lambda pair, more: ({"a": pair.x + 1}, [more[1], pair])) as call:
        for number in (2, 3):
            first, (none, pair) = call(Pair(x, number), (x, None))
            assert dr.all(first["a"] == x + 1) and none is None and pair.factor == number
        with pytest.raises(TypeError, match="takes arrays and numbers, not object"):
            call(object(), ())


def test_large_arrays_are_traced(backend):
    Float, traced = select(backend).Float, []

    @record
    def increased(x):
        traced.append(dr.width(x))
        return x + 1

    for size in (3, LARGEST_RECORDED + 1, LARGEST_RECORDED + 1):
        assert dr.all(increased(dr.full(Float, 1, size)) == 2)
    assert traced == [3, LARGEST_RECORDED + 1, LARGEST_RECORDED + 1]


def test_an_interrupt_in_a_recorded_program_stays_one(backend):
    @record
    def program(value):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        program(select(backend).Float(1))


def test_errors_keep_their_type(backend):
    """Dr.Jit makes a RuntimeError of an alarm, say, inside of a program or a loop."""
    x = select(backend).Float(1)

    @record
    def program(value):
        raise TimeoutError("now")

    def late(value):
        raise TimeoutError("now")

    with pytest.raises(TimeoutError, match="now"):
        program(x)
    with pytest.raises(TimeoutError, match="now"):
        door(lambda: dr.while_loop((x,), lambda x: x < 3, late))()
    with pytest.raises(RuntimeError, match="of mine"), exclusive():
        raise RuntimeError("of mine")
    with pytest.raises(RuntimeError, match="with a cause"), exclusive():
        raise RuntimeError("with a cause") from ValueError("the cause")


def test_what_is_kept_of_calls_is_limited(backend):
    """Also the structures of their results."""
    x, types = select(backend).Float(1), []

    @record
    def program(value, number):
        types.append(weakref.ref(kind := namedtuple("Result", "value")))
        return kind(value + number)

    for number in range(recording.KEPT_RECORDINGS + 3):
        assert program(x, number).value == 1 + number
    gc.collect()
    assert sum(kind() is not None for kind in types) == recording.KEPT_RECORDINGS


FLUSHED = """
import drjit as dr
import eigengs_dr as eg
from _helpers.waves import picture

def fit():
    return eg.fit(picture(), 40, iterations=4, progress=False).image.tobytes()

def flush(picture, step):
    if step == 2:
        dr.flush_kernel_cache()
    return dr.mean(dr.square(picture), axis=None)

before = fit()
dr.flush_kernel_cache()
assert fit() == before
eg.fit(picture(), 40, iterations=6, loss=flush, progress=False)
assert fit() == before
print("whole")
"""


def test_kernels_may_be_flushed():
    """Dr.Jit 1.5 ends the process where it replays a kernel that was compiled again."""
    run = run_python(FLUSHED, PYTHONPATH=python_path())
    assert run.stdout == "whole\n", run.stderr


# --- Several threads ---


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

    alone = [fit_one(number) for number in range(16)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(fit_one, range(16), timeout=4 * WAIT)) == alone


EAGER_THREADS = """
import sys, threading
import eigengs_dr as eg
from _helpers.waves import picture

def fits():
    for _ in range(6):
        eg.fit(picture(), 40, iterations=3, progress=False)

sys.setswitchinterval(1e-6)
threads = [threading.Thread(target=fits, daemon=True) for _ in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print("whole")
"""


def test_threads_that_drop_results_do_not_hang():
    """Python changes threads as often as it may, as it does once a minute on a loaded machine."""
    assert run_python(EAGER_THREADS, PYTHONPATH=python_path()).stdout == "whole\n"


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


DOORS = {
    "fit": lambda g, image: eg.fit(image, gaussians=40, iterations=0, backend="llvm"),
    "fit_many": lambda g, image: eg.fit_many([image], gaussians=40, iterations=0, progress=False),
    "render": lambda g, image: eg.render(g),
    "picture_of": lambda g, image: eg.picture_of(g),
    "tile_lists": lambda g, image: eg.tile_lists(g),
    "ssim": lambda g, image: eg.ssim(dr.zeros(dr.llvm.ad.TensorXf, image.shape), image),
    "concatenate": lambda g, image: eg.concatenate([g, g]),
    "to_tensors": lambda g, image: eg.to_tensors(g),
    "view": lambda g, image: eg.view(g),
    "from_arrays": lambda g, image: eg.Gaussians.from_arrays(
        [[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data", backend="llvm"
    ),
    "to_arrays": lambda g, image: g.to_arrays(),
    "an index": lambda g, image: g[:2],
    "scaled": lambda g, image: g.scaled(5, 5),
    "bounded": lambda g, image: g.bounded(),
    "a task": lambda g, image: list(LocalExecutor().map(lambda task, shared: task, [1])),
    "encode": lambda g, image: small_model("llvm").encode(image),
}
"""Calls that take the lock, see `eigengs_dr.backend.doors`."""


def test_calls_wait_for_the_block_of_another_thread():
    image, gaussians, done = picture(), start("llvm")[0], []
    small_model("llvm")

    def use(name):
        DOORS[name](gaussians, image)
        done.append(name)

    threads = [threading.Thread(target=use, args=[name]) for name in DOORS]
    with exclusive():
        for thread in threads:
            thread.start()
        time.sleep(0.3)
        assert done == []
    for thread in threads:
        thread.join(WAIT)
    assert sorted(done) == sorted(DOORS)


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


DROP_WHILE_RECORDING = """
import drjit as dr

from _helpers.waves import half_read
from eigengs_dr.backend.recording import freeze_program
from eigengs_dr.backend.selection import select

Float = select({backend!r}).Float
for count in (1, 3):
    drop = [half_read({backend!r}, count)].clear

    def drops(x):
        y = dr.gather(Float, x, dr.arange(dr.uint32_array_t(Float), 2))
        drop()
        return x + y

    with freeze_program(drops) as call:
        for x in (1, 2, 3):
            assert dr.all(call(Float(x, x)) == 2 * x)
print("whole")
"""


def test_a_descent_that_a_program_drops_while_it_is_recorded(backend):
    """Dr.Jit ends the process if an array that shares NumPy's memory is freed then."""
    code = DROP_WHILE_RECORDING.format(backend=backend)
    run = run_python(code, PYTHONPATH=python_path())
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
