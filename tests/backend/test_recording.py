"""Frozen programs, and what the garbage collector must not do while they are recorded."""

import gc

import pytest

from _helpers.process import run_python
from eigengs_dr.backend.recording import freeze_program
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

    with freeze_program(refuse) as call, pytest.raises(RuntimeError):
        call(Float(1))
    assert gc.isenabled()
    gc.disable()
    try:
        with freeze_program(lambda x: x + 1) as call:
            call(Float(1))
        assert not gc.isenabled()
    finally:
        gc.enable()
