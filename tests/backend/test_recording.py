"""Frozen programs, and what the garbage collector must not do while they are recorded."""

import gc
from dataclasses import dataclass
from typing import Any

import drjit as dr
import pytest

from _helpers.process import run_python
from eigengs_dr.backend.recording import LARGEST_RECORDED, freeze_program, record
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
