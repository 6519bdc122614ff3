"""What makes pages, what it refuses, and what notebooks show; no browser is needed."""

import json
import re
from base64 import b64decode
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.families import small_basis, small_model
from _helpers.sets import random_scene
from eigengs_dr.fitting.fit import Fit
from eigengs_dr.viewer.view import MAX_GAUSSIANS, describe_share, kept_counts


def make_set():
    return random_scene(0, 20, (32, 24)).on("llvm", space="rgb")


def facts_of(page):
    found = re.search(r'<script type="application/json" id="facts">(.*?)</script>', page.html)
    return json.loads(found[1])


def test_a_fit_is_its_gaussians():
    image = eg.sample("coffee")[:24, :32]
    fit = eg.fit(image, 50, iterations=2)
    assert facts_of(eg.view(fit, image))["set"] == facts_of(eg.view(fit.gaussians))["set"]


def test_a_page_is_one_file(tmp_path):
    page = eg.view(make_set(), np.zeros((24, 32, 3), np.float32), title='a "title"')
    links = re.findall(r"(?:src|href|url)\s*[=(]\s*[\"']?(?!data:)\S+", page.html)
    assert [link for link in links if "http" in link] == []
    assert "default-src 'none'" in page.html
    page.save(tmp_path / "a.html")
    assert repr(page) == f"Page({(tmp_path / 'a.html').stat().st_size:,} bytes)"
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == page.html
    with pytest.raises(ValueError, match="must end in"):
        page.save(tmp_path / "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]
    shown = page._repr_html_()
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
        ({"encoding": "hdr"}, "encoding 'hdr'"),
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
    gaussians = make_set()
    gaussians.mean.x = gaussians.mean.x / 0
    with pytest.raises(ValueError, match="mean holds values that are not finite"):
        eg.view(gaussians)


def test_a_set_of_too_many_has_no_page_and_no_picture():
    arrays = [np.ones((MAX_GAUSSIANS + 1, columns)) for columns in (2, 3, 1)]
    gaussians = eg.Gaussians.from_arrays(*arrays, size=(8, 8), space="data")
    with pytest.raises(ValueError, match=r"1,048,577 Gaussians are too many .* 1,048,576"):
        eg.view(gaussians)
    html = gaussians._repr_html_()
    assert "Gaussians(1048577" in html and "<img" not in html


def test_a_page_has_the_components_of_largest_variance():
    small = small_model("llvm")
    assert kept_counts(small) == [12, 6, 6]
    assert describe_share(small, [12, 6, 6]) == ""
    model = eg.EigenGS.load("natural")
    counts = kept_counts(model)
    assert counts == [93, 8, 8]  # all sliders, and what fits
    kept = np.concatenate([v[:n] for v, n in zip(model.eigenvalues, counts, strict=True)])
    left = np.concatenate([v[n:] for v, n in zip(model.eigenvalues, counts, strict=True)])
    assert model.eigenvalues[0][92] >= left.max()
    share = kept.sum() / (kept.sum() + left.sum())
    assert f"first 109 of 350 components, with {share:.0%}" in describe_share(model, counts)
    assert [len(c["deviations"]) for c in facts_of(eg.view(model))["model"]["channels"]] == counts


# --- Notebooks; that of the manual runs ---


NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebook.ipynb"


def pictures(html):
    """The pictures in HTML, as 8-bit arrays."""
    codes = re.findall(r'src="data:image/\w+;base64,([^"]+)"', html)
    return [np.asarray(Image.open(BytesIO(b64decode(code)))).astype(float) for code in codes]


def test_a_set_is_its_picture():
    gaussians = random_scene(0, 60, (48, 32)).on("llvm", space="rgb")
    assert repr(gaussians) == "Gaussians(60, 48x32 pixels, 3 channels, 'rgb', cutoff=3)"
    html = gaussians._repr_html_()
    assert "60, 48x32 pixels, 3 channels" in html
    [shown] = pictures(html)
    expected = np.rint(255 * np.clip(eg.picture_of(gaussians), 0, 1))
    assert np.abs(shown - expected).mean() < 4  # JPEG


@pytest.mark.parametrize(
    ("channels", "size", "shape"), [(3, (4800, 3200), (320, 480, 3)), (5, (48, 32), (32, 48))]
)
def test_large_sets_are_scaled_down_and_one_of_many_channels_is_shown(channels, size, shape):
    gaussians = random_scene(0, 60, (48, 32), channels).on("llvm").scaled(*size)
    [shown] = pictures(gaussians._repr_html_())
    assert shown.shape == shape


def test_a_fit_is_its_picture():
    html = eg.fit(eg.sample("coffee")[:32, :48], 60, iterations=20)._repr_html_()
    assert len(pictures(html)) == 1 and "psnr_rgb=" in html


def test_a_large_fit_is_scaled_down():
    """Stripes of a pixel become grey."""
    fit = eg.fit(eg.sample("coffee")[:32, :48], 60, iterations=2)
    striped = np.zeros((640, 960, 3), np.float32)
    striped[:, ::2] = 1
    [shown] = pictures(
        replace(fit, gaussians=fit.gaussians.scaled(960, 640), image=striped)._repr_html_()
    )
    assert shown.shape == (320, 480, 3)
    assert np.abs(shown[:, 2:-2] - 127.5).max() < 4


def test_bases_and_models_show_components():
    names = ["mean", *(f"Y {n}" for n in (1, 2, 3, 5, 10)), "Cb 1", "Cb 2", "Cr 1", "Cr 2"]
    basis, model = small_basis(), small_model("llvm")
    assert repr(basis) == "Eigenbasis(40 images, 32x32 pixels, 12 Y, 6 Cb, 6 Cr)"
    assert repr(model) == "EigenGS(100 Gaussians, 32x32 pixels, 12 Y, 6 Cb, 6 Cr)"
    shown = []
    for source in (basis, model):
        html = source._repr_html_()
        assert repr(source) in html
        assert re.findall("<figcaption>(.*?)</figcaption>", html) == names
        shown.append(np.stack(pictures(html)))
    # The Gaussians render the components, so both look alike.
    for a, b in zip(*shown, strict=True):
        assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.9


def test_the_stored_outputs_of_the_notebook_are_small():
    """Write them by ``python tools/manual/run_notebook.py``."""
    text = NOTEBOOK.read_text("utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert sum(bool(cell["outputs"]) for cell in cells) == 8
    assert len(text) < 200_000 and "<iframe" not in text and ".venv" not in text


@pytest.mark.slow  # 'make docs' runs it, too
def test_the_notebook_runs():
    nbformat = pytest.importorskip("nbformat", reason="no nbformat")
    client = pytest.importorskip("nbclient", reason="no nbclient")
    pytest.importorskip("ipykernel", reason="no kernel for notebooks")
    book = nbformat.read(NOTEBOOK, 4)
    client.NotebookClient(book, timeout=200, startup_timeout=200, kernel_name="python3").execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", [])]
    shown = [output for output in outputs if "text/html" in output.get("data", {})]
    assert len(shown) == 7
    [error] = [output for output in outputs if output.output_type == "error"]
    assert error.ename == "ImageError" and "divide by 255" in error.evalue
    assert all(len(line) < 600 for line in error.traceback)
