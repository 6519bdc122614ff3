"""Refinement: the loop over steps, on any image, however it goes."""

import numpy as np
import pytest

from _helpers.sets import Scene
from _helpers.waves import SIDE, SPLATS, default, figures, picture, presets, start
from eigengs_dr.fitting.descent import FitProblem
from eigengs_dr.fitting.options import PRESETS
from eigengs_dr.fitting.refine import refine
from eigengs_dr.image.color import rgb_to_ycbcr


@presets
def test_refinement_descends(backend, preset):
    gaussians, target = start(backend)
    result = refine(FitProblem(gaussians, target), picture(), PRESETS[preset].schedule, 100)
    psnrs = figures(result)
    assert [row["iteration"] for row in result.trace] == [0, 10, 20, 50, 100]
    assert psnrs == sorted(psnrs)
    assert psnrs[-1] > psnrs[0] + 1
    assert (result.iterations, result.stopped) == (100, "iterations")


def test_other_runs_change_nothing(backend):
    """Programs of other counts, sizes and rates between two equal runs."""
    gaussians, target = start(backend)
    first = figures(refine(FitProblem(gaussians, target), picture(), default(), 10))
    for count in (200, 50, 1):
        problem = FitProblem(*start(backend, count))
        refine(problem, picture(), default(rates=default().rates), 10)
    refine(FitProblem(gaussians, target), picture(), PRESETS["gaussianimage"].schedule, 10)
    assert figures(refine(FitProblem(gaussians, target), picture(), default(), 10)) == first


@pytest.mark.parametrize("seed", range(3))
def test_all_splats_on_one_pixel(backend, seed):
    rng = np.random.default_rng(seed)
    mean, factor = np.full((SPLATS, 2), 16.0), np.tile([0.5, 0, 0.5], (SPLATS, 1))
    color = rng.uniform(0, 1e-3, (SPLATS, 3))
    gaussians = Scene(mean, factor, color, np.zeros(3), (SIDE, SIDE)).on(backend, space="ycbcr")
    result = refine(FitProblem(gaussians, rgb_to_ycbcr(picture())), picture(), default(), 60)
    assert np.isfinite(figures(result)).all()
    assert all(np.isfinite(v).all() for v in result.gaussians.to_arrays().values())
    assert figures(result)[-1] > figures(result)[0] + 1
