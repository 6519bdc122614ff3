"""What makes pages, and what it refuses; no browser is needed."""

import json
import re

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_basis, small_model
from _helpers.sets import random_scene
from eigengs_dr.fitting.fit import Fit
from eigengs_dr.viewer import facts
from eigengs_dr.viewer.facts import describe_share, kept_counts


def make_set(count=20, size=(32, 24)):
    return random_scene(0, count, size).on("llvm", space="rgb")


def facts_of(page):
    found = re.search(r'<script type="application/json" id="facts">(.*?)</script>', page.html)
    return json.loads(found[1])


def test_a_fit_is_its_gaussians():
    image = eg.sample("coffee")[:24, :32]
    fit = eg.fit(image, 50, iterations=2)
    assert facts_of(eg.view(fit, image))["set"] == facts_of(eg.view(fit.gaussians))["set"]


def test_a_page_needs_no_other_file():
    page = eg.view(make_set(), np.zeros((24, 32, 3), np.float32))
    links = re.findall(r"(?:src|href|url)\s*[=(]\s*[\"']?(?!data:)\S+", page.html)
    assert [link for link in links if "http" in link] == []
    assert "default-src 'none'" in page.html


def test_saves_the_whole_page(tmp_path):
    page = eg.view(make_set())
    page.save(tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == page.html
    with pytest.raises(ValueError, match="must end in"):
        page.save(tmp_path / "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_a_notebook_shows_it_in_a_frame():
    shown = eg.view(make_set(), title='a "title"')._repr_html_()
    assert shown.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert shown.count('"') == 4  # of two attributes


@pytest.mark.parametrize(
    "change, message",
    [
        ({"levels": [5, 3]}, r"levels are \[5, 3\]; expected ascending numbers up to 20"),
        ({"levels": [5, 21]}, "expected ascending numbers up to 20"),
        ({"levels": [0, 5]}, "expected ascending numbers up to 20"),
        ({"image": np.zeros((32, 32, 3), np.float32)}, "the photo has 32x32 pixels, the set 32x24"),
        ({"image": np.full((24, 32, 3), np.nan, np.float32)}, "not finite"),
        ({"image": np.zeros((24, 32, 3), np.float32), "encoding": "hdr"}, "encoding 'hdr'"),
    ],
)
def test_refuses_bad_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        eg.view(make_set(), **change)


def test_accepts_a_photo_of_another_size():
    assert facts_of(eg.view(make_set(), np.zeros((49, 65), np.float32)))["photo"]


def test_refuses_other_things():
    with pytest.raises(TypeError, match="Eigenbasis cannot be shown"):
        eg.view(small_basis())
    fit = Fit(make_set(), [], np.zeros((24, 32, 3)), 0, 0, 0, "", np.zeros((24, 32, 3)))
    with pytest.raises(ValueError, match="mean image of pixels"):
        eg.view(fit)


def test_refuses_values_that_are_not_finite():
    gaussians = make_set()
    gaussians.mean.x = gaussians.mean.x / 0
    with pytest.raises(ValueError, match="mean holds values that are not finite"):
        eg.view(gaussians)


def test_refuses_too_many(monkeypatch):
    monkeypatch.setattr(facts, "MAX_GAUSSIANS", 10)
    with pytest.raises(ValueError, match="20 Gaussians are too many for a page; the most is 10"):
        eg.view(make_set())


def test_a_page_has_the_components_of_largest_variance(monkeypatch):
    model = small_model("llvm")
    assert kept_counts(model) == [12, 6, 6]
    assert describe_share(model) == ""
    monkeypatch.setattr("eigengs_dr.viewer.facts.FEWEST", 1)
    monkeypatch.setattr("eigengs_dr.viewer.facts.MAX_BYTES", 2 * 101 * 10 + 5)
    counts = kept_counts(model)
    assert sum(counts) == 10
    kept = np.concatenate([v[:n] for v, n in zip(model.eigenvalues, counts, strict=True)])
    left = np.concatenate([v[n:] for v, n in zip(model.eigenvalues, counts, strict=True)])
    assert kept.min() >= left.max()
    share = kept.sum() / (kept.sum() + left.sum())
    assert f"first 10 of 24 components, with {share:.0%}" in describe_share(model)
    assert [len(c["deviations"]) for c in facts_of(eg.view(model))["model"]["channels"]] == counts
