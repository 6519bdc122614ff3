"""Backends that tests run on, and what this machine cannot run."""

import gc
import os
import signal
from functools import cache

import pytest
from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits

# No test depends on time: another program may use the machine, and a first example compiles.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

pytest.register_assert_rewrite("_helpers")

import eigengs_dr  # noqa: E402, F401

# isort: split
import drjit as dr  # noqa: E402  (after the package, which finds libLLVM)

# A shell that starts the tests in the background has them ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


@cache
def has_gpu():
    """Whether Dr.Jit finds a CUDA device."""
    return dr.has_backend(dr.JitBackend.CUDA)


@pytest.fixture(params=["llvm", pytest.param("cuda", marks=pytest.mark.gpu)])
def backend(request):
    """Name of a backend: a test that takes it runs once for each."""
    return request.param


def pytest_collection_modifyitems(config, items):
    """Leave out tests that need a GPU where there is none."""
    needy = [item for item in items if item.get_closest_marker("gpu")]
    if needy and not has_gpu():
        config.hook.pytest_deselected(items=needy)
        items[:] = [item for item in items if not item.get_closest_marker("gpu")]


def pytest_collection_finish():
    """Keep what imports and collection made out of later collections of garbage.

    They are some hundred thousand objects that live to the end, and every full collection, of which
    hypothesis and the package make many, would walk them all.
    """
    gc.collect()
    gc.freeze()


BESIDE_OTHERS = "PYTEST_XDIST_WORKER" in os.environ


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Let BLAS, and `register_plugins`, which takes two threads for EXR files, start none.

    Beside other processes they spin for nothing, those of Dr.Jit for 20 ms after each program.
    """
    if not BESIDE_OTHERS:
        yield
        return
    with threadpool_limits(1), pytest.MonkeyPatch.context() as patch:
        patch.setattr(dr, "thread_count", lambda: 2)
        yield


thread_count = dr.thread_count


@pytest.fixture
def counted_threads(monkeypatch):
    """Let `drjit.thread_count` say the truth, see `one_thread`."""
    monkeypatch.setattr(dr, "thread_count", thread_count)


def pytest_runtest_setup(item):
    """Leave the other cores to other processes, and let scenes have the programs of the last run.

    Threads of Dr.Jit spin. Objects of Mitsuba have numbers in programs: as long as a cycle holds
    those of the tests before, every order of tests compiles other programs, for ten times as long.
    """
    if BESIDE_OTHERS:
        dr.set_thread_count(2 if item.get_closest_marker("exr") else 1)
    if item.get_closest_marker("mitsuba"):
        gc.collect()


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call():
    """Fail a test that an interrupted fit ends; pytest would take it for Ctrl-C and end the run."""
    try:
        return (yield)
    except KeyboardInterrupt as error:
        if type(error) is KeyboardInterrupt:
            raise
        raise AssertionError(f"not expected: {error!r}") from error


def pytest_terminal_summary(terminalreporter):
    """Say what was not tested for want of a GPU."""
    if not has_gpu():
        terminalreporter.write_line("no CUDA device: the cuda path was not tested")


def pytest_unconfigure():
    """Let the last collection find what was frozen: else nanobind reports it as leaked."""
    gc.unfreeze()
