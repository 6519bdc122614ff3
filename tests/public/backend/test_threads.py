"""Several threads of one process, the garbage collector, and kernels that are flushed."""

import gc
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import smooth_pixels
from _helpers.families import small_model
from _helpers.process import python_path, run_python
from _helpers.sets import random_scene

WAIT = 100
"""Seconds after which a thread that does not answer fails its test."""

IMAGE = smooth_pixels(32, 32)

FEW = {"gaussians": 40, "iterations": 4}


def test_fits_in_four_threads_have_the_bits_of_fits_one_by_one(backend):
    def fit_one(number):
        found = eg.fit(np.roll(IMAGE, number, axis=0), backend=backend, **FEW)
        arrays = found.gaussians.to_arrays()
        return b"".join(arrays[name].tobytes() for name in arrays) + found.image.tobytes()

    alone = [fit_one(number) for number in range(16)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(fit_one, range(16), timeout=4 * WAIT)) == alone


def test_gradients_beside_fits_have_the_bits_of_gradients_alone(backend):
    def gradient(_):
        with eg.exclusive():
            gaussians = random_scene().on(backend)
            dr.enable_grad(gaussians.mean)
            rendered = eg.render(replace(gaussians, color=gaussians.color + 1))
            dr.backward(dr.sum(dr.square(rendered.array)))
            return dr.grad(gaussians.mean).numpy().tobytes()

    alone = gradient(None)
    with ThreadPoolExecutor(3) as pool:
        fits = [pool.submit(eg.fit, IMAGE, backend=backend, **FEW) for _ in range(4)]
        assert set(pool.map(gradient, range(20), timeout=WAIT)) == {alone}
        assert len({fit.result(WAIT).image.tobytes() for fit in fits}) == 1


CALLS = {
    "fit": lambda g: eg.fit(IMAGE, **FEW, backend="llvm"),
    "fit_many": lambda g: eg.fit_many([IMAGE], **FEW, backend="llvm", progress=False),
    "render": lambda g: eg.render(g),
    "picture_of": lambda g: eg.picture_of(g),
    "tile_lists": lambda g: eg.tile_lists(g),
    "ssim": lambda g: eg.ssim(dr.zeros(dr.llvm.ad.TensorXf, IMAGE.shape), IMAGE),
    "concatenate": lambda g: eg.concatenate([g, g]),
    "to_tensors": lambda g: eg.to_tensors(g),
    "view": lambda g: eg.view(g),
    "from_arrays": lambda g: eg.Gaussians.from_arrays(
        [[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data", backend="llvm"
    ),
    "to_arrays": lambda g: g.to_arrays(),
    "an index": lambda g: g[:2],
    "scaled": lambda g: g.scaled(5, 5),
    "bounded": lambda g: g.bounded(),
    "encode": lambda g: small_model("llvm").encode(IMAGE),
}
"""Public functions that use Dr.Jit, of which each takes the lock."""


def test_calls_wait_for_the_block_of_another_thread():
    gaussians, done = random_scene().on("llvm", space="rgb"), []
    small_model("llvm")

    def use(name):
        CALLS[name](gaussians)
        done.append(name)

    threads = [threading.Thread(target=use, args=[name]) for name in CALLS]
    with eg.exclusive():
        for thread in threads:
            thread.start()
        time.sleep(0.3)
        assert done == []
    for thread in threads:
        thread.join(WAIT)
    assert sorted(done) == sorted(CALLS)


LITTER = """
import gc
import drjit as dr
import numpy as np
import eigengs_dr as eg
from _helpers.command import smooth_pixels

class Node:
    pass

def loss(picture, step):
    node = Node()  # a cycle that holds memory of NumPy, which a collection frees
    node.cycle, node.array = node, dr.llvm.ad.Float(np.ones(1_000_000, np.float32))
    return dr.mean(dr.square(picture), axis=None)

gc.collect()
gc.freeze()
for threshold in (50, 100, 200, 300):  # one of them lets a collection begin in a recording
    gc.set_threshold(threshold, 1, 1)
    eg.fit(smooth_pixels(24 + threshold % 17, 32), 40, iterations=5, progress=False, loss=loss)
assert gc.isenabled()
print("whole")
"""

FLUSHED = """
import drjit as dr
import eigengs_dr as eg
from _helpers.command import smooth_pixels

def fit():
    return eg.fit(smooth_pixels(32, 32), 40, iterations=4, progress=False).image.tobytes()

def flush(picture, step):
    if step == 2:
        dr.flush_kernel_cache()
    return dr.mean(dr.square(picture), axis=None)

before = fit()
dr.flush_kernel_cache()
assert fit() == before
eg.fit(smooth_pixels(32, 32), 40, iterations=6, loss=flush, progress=False)
assert fit() == before
print("whole")
"""

PROGRAMS = {
    # Dr.Jit 1.5 ends the process if an array that shares NumPy's memory is freed in a recording.
    "garbage in cycles": LITTER,
    # Dr.Jit 1.5 ends the process where it replays a kernel that was compiled again.
    "kernels that are flushed": FLUSHED,
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_that_must_not_hang_or_end_the_process(name):
    process = run_python(PROGRAMS[name], PYTHONPATH=python_path())
    assert process.stdout == "whole\n", process.stderr


def test_errors_leave_the_lock_and_keep_their_type(backend):
    """Dr.Jit makes a RuntimeError of an alarm, say, inside of a program or a loop."""

    def late(*arguments):
        raise TimeoutError("now")

    with pytest.raises(TimeoutError, match="now"):
        eg.fit(IMAGE, loss=late, backend=backend, **FEW)
    one = dr.opaque(getattr(dr, backend).ad.Float, 1)
    with pytest.raises(TimeoutError, match="now"), eg.exclusive():
        dr.while_loop((one,), lambda x: x < 3, late)
    with pytest.raises(RuntimeError, match="with a cause"), eg.exclusive():
        raise RuntimeError("with a cause") from ValueError("the cause")
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(eg.fit, IMAGE, backend=backend, **FEW).result(WAIT).iterations == 4
    assert gc.isenabled()
