"""What doctor says of a GPU; its trials, on llvm."""

import json
from functools import partial

import numpy as np
import pytest

from _helpers.command import assert_refused, run, said
from eigengs_dr.backend.doctor import ALLOWED, Agreement, Trial


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


def test_a_trial_that_failed_is_valid_json(monkeypatch):
    good, bad = Trial(1.0, [0.5]), Trial(0.0, [], "out of memory")
    facts = {"llvm": {"works": True}, "cuda": {"works": True}, "metal": {"works": False}}
    monkeypatch.setattr("eigengs_dr.backend.doctor.report", lambda: facts)
    failed = partial(Agreement, llvm=good, gpu=bad, difference=float("inf"))
    monkeypatch.setattr("eigengs_dr.cli.doctor.compare_backends", lambda name, device: failed(name))
    ended = run("doctor", "--gpu", "--json")
    [trial, *_] = json.loads(ended.stdout, parse_constant=pytest.fail)["trials"]
    assert ended.exit_code == 1 and trial["difference"] is None
    assert trial["gpu"]["problem"] == "out of memory"
