"""How a fit ends: Ctrl-C, signals, errors of the caller, and what it tells meanwhile."""

import signal
from unittest.mock import patch

import numpy as np
import pytest

from _helpers.waves import SPLATS, check_sound, figures, picture
from eigengs_dr.fitting import start as starting
from eigengs_dr.fitting.fit import FitInterrupted, fit
from eigengs_dr.fitting.start import place_grid
from eigengs_dr.image.metrics import psnr


@pytest.mark.parametrize("when", [0, 10, 30])
def test_interruption_keeps_the_best_so_far(backend, when):
    def interrupt(iteration, iterations, row):
        if iteration >= when:
            raise KeyboardInterrupt

    with pytest.raises(FitInterrupted) as interruption:
        fit(picture(), SPLATS, 60, progress=interrupt, backend=backend)
    result = interruption.value.result
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


def place_and_press(image, count, generator):
    signal.raise_signal(signal.SIGINT)
    return place_grid(image, count, generator)


@pytest.mark.parametrize("iterations", [0, 1, 60])
def test_ctrl_c_before_refinement(backend, iterations):
    """The start is kept, and the caller told."""
    entry = {"grid": place_and_press}
    with patch.dict(starting.PLACEMENTS, entry), pytest.raises(FitInterrupted) as interruption:
        fit(picture(), SPLATS, iterations, init="grid", backend=backend)
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
    assert told[-1][2] is result.trace[-1]
