"""The split into low and high components, and when it pays."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SIDE, SPLATS, rendered, small_basis, small_model, splits
from eigengs_dr.eigenbasis.components.solve import SPLIT_COST, split_reason, wants_split
from eigengs_dr.image.color import to_planes


@splits
def test_split_keeps_sides_apart(backend, split):
    model = small_model(backend, split)
    low, first = model.low, model.low_components
    assert (low, first) == ((10, 6) if split else (0, 0))
    for weights in model.weights:
        assert not weights[:first, low:-1].any() or not split
        assert not weights[first:, :low].any()
        assert np.abs(weights).max(axis=1).min() > 0
    areas = 1 / np.prod(model.gaussians.to_arrays()["factor"][:, [0, 2]], axis=1)
    if split:
        assert areas[:low].min() > 5 * areas[low:].max()


def test_auto_splits_large_images_alone(backend, monkeypatch):
    assert wants_split(small_basis(), SPLATS, "auto", backend) == (False, {})
    monkeypatch.setattr("eigengs_dr.eigenbasis.components.solve.SPLIT_FROM", SIDE)
    decision, figures = wants_split(small_basis(), SPLATS, "auto", backend)
    assert set(figures) == {"psnr_whole", "psnr_split"}
    assert decision == (figures["psnr_split"] > figures["psnr_whole"] - 0.2)
    examples = small_basis().examples
    whole = rendered(small_model(backend), examples)
    planes = to_planes(np.concatenate(whole), "ycbcr") - to_planes(
        np.concatenate(examples), "ycbcr"
    )
    assert figures["psnr_whole"] == pytest.approx(
        -10 * np.log10(np.square(planes).mean()), abs=0.02
    )


def test_a_tenth_of_the_splats_is_low(backend):
    assert eg.EigenGS.fit(small_basis(), 17, True, backend=backend).low == 2
    assert eg.EigenGS.fit(small_basis(), 1, True, backend=backend).low == 0


@pytest.mark.parametrize(("split", "expected"), [(30.0, True), (29.9, True), (29.7, False)])
def test_what_the_split_may_cost(backend, monkeypatch, split, expected):
    figures = iter([30.0, split])
    monkeypatch.setattr("eigengs_dr.eigenbasis.components.solve.SPLIT_FROM", SIDE)
    monkeypatch.setattr(
        "eigengs_dr.eigenbasis.components.solve.psnr_from_mse", lambda mse: next(figures)
    )
    assert wants_split(small_basis(), SPLATS, "auto", backend)[0] == expected


def test_the_split_tells_why(backend, monkeypatch):
    basis = small_basis()

    def reason(count, asked):
        decision, figures = wants_split(basis, count, asked, backend)
        text = split_reason(basis, count, asked, figures)
        assert len(text) < 64 and text.isascii()
        return decision, text

    assert reason(100, True) == (True, "frequency_aware is set")
    assert reason(100, False) == (False, "frequency_aware is set")
    assert reason(1, True) == (False, "too few Gaussians or components to split")
    assert reason(100, "auto") == (False, "32 pixels a side; auto measures from 512 on")
    monkeypatch.setattr("eigengs_dr.eigenbasis.components.solve.SPLIT_FROM", 32)
    decision, text = reason(100, "auto")
    whole, split = (float(text.split(word)[1].split(" dB")[0]) for word in ("whole ", "split "))
    assert decision == (split > whole - SPLIT_COST)
    assert text.endswith("may cost 0.2")
    model = eg.EigenGS.fit(basis, 100, backend=backend)
    assert (model.low > 0, model.split_reason) == (decision, text)
