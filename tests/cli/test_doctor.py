"""What doctor says of a GPU; its trials, on llvm."""

import json

import numpy as np
import pytest

from _helpers.command import assert_refused, run, said
from eigengs_dr.backend.doctor import ALLOWED


@pytest.mark.parametrize("name", ALLOWED)
def test_a_trial_prints_figures_that_repeat(name):
    if name == "scene":
        pytest.importorskip("mitsuba", reason="scenes need mitsuba")
    first, second = (json.loads(said("doctor", "--trial", name)) for _ in range(2))
    figures = np.array(first["figures"])
    assert np.isfinite(figures).all() and np.ptp(figures) > 0
    np.testing.assert_allclose(figures, second["figures"], atol=1e-4 * abs(figures).max())


def test_a_gpu_that_is_not_there():
    ended = run("doctor", "--gpu", "--backend", "metal")
    assert ended.exit_code == 2
    assert ended.stderr.count("\n") == 1 and "metal does not work: no Metal GPU" in ended.stderr


def test_a_backend_is_compared_by_gpu_alone():
    assert_refused(run("doctor", "--backend", "metal"), "--backend needs --gpu")
