"""What info says of the fit and of the bytes of a file."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.cli.main import main


def info(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main(["info", *map(str, arguments)])
    said = capsys.readouterr()
    return end.value.code or 0, said.out or said.err


@pytest.fixture
def fitted(tmp_path):
    eg.save_image(tmp_path / "photo.png", eg.sample("coffee")[:32, :32])
    result = eg.fit(tmp_path / "photo.png", 40, iterations=10)
    result.save(tmp_path / "a.npz")
    return result, tmp_path / "a.npz"


def test_info_shows_the_fit_and_the_bytes(fitted, capsys):
    result, file = fitted
    code, text = info(capsys, file, "--json")
    facts = json.loads(text)
    assert code == 0 and facts["iterations"] == 10 and facts["source"] == "photo.png"
    assert facts["psnr_rgb"] == pytest.approx(result.psnr_rgb, abs=0.01)
    assert {"mean", "factor", "color", "background"} <= set(facts["ledger"])
    assert 0 < sum(facts["ledger"].values()) < facts["bytes"]
    assert "photo.png" in info(capsys, file)[1]


def test_a_set_that_was_edited_claims_no_figures(fitted, capsys, tmp_path):
    eg.Gaussians.load(fitted[1])[:20].save(tmp_path / "b.npz")
    facts = json.loads(info(capsys, tmp_path / "b.npz", "--json")[1])
    assert "psnr_rgb" not in facts and facts["gaussians"] == 20


@pytest.mark.parametrize(
    "change",
    [
        {"figures": np.zeros(2)},
        {"figures": np.zeros(3, np.float32)},
        {"figures": np.array([1.0, 2.0, -3.0])},
        {"figures": np.array([1.0, 2.0, np.nan])},
        {"source": np.array("x" * 65)},
        {"source": np.zeros(3)},
    ],
)
def test_hostile_figures_are_refused_in_one_line(change, fitted, capsys):
    members = dict(np.load(fitted[1])) | change
    np.savez(fitted[1], **members)
    code, text = info(capsys, fitted[1])
    assert code == 2 and text.count("\n") == 1 and str(fitted[1]) in text
    assert len(eg.Gaussians.load(fitted[1])) == 40  # the set itself is whole


def test_lossless_psnr_and_strange_names_are_shown(fitted, capsys, tmp_path):
    result = replace(fitted[0], source="a\x1b[31m.png", psnr_rgb=math.inf)
    result.save(tmp_path / "c.npz")
    facts = json.loads(info(capsys, tmp_path / "c.npz", "--json")[1])
    assert facts["source"] == "a?[31m.png" and facts["psnr_rgb"] == "inf"
