"""What makes pages, what it refuses, and what notebooks show; no browser is needed."""

import json
import re
from base64 import b64decode
from dataclasses import replace
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.families import small_basis, small_model
from _helpers.lit_models import LitFormula
from _helpers.materials import material
from _helpers.photos import coffee
from _helpers.sets import random_scene


def make_set(count=20, size=(32, 24)):
    return random_scene(0, count, size).on("llvm", space="rgb")


@pytest.fixture(scope="module")
def fit():
    return eg.fit(coffee(32), 64, iterations=2)


def facts_of(page):
    facts = re.search(r'<script type="application/json" id="facts">(.*?)</script>', page.html)
    return json.loads(facts[1])


def test_a_fit_is_its_gaussians(fit):
    page = eg.view(fit, coffee(32))
    assert facts_of(page)["set"] == facts_of(eg.view(fit.gaussians))["set"]


def test_the_heading_says_how_close_the_photo_is(fit):
    heading = f"64 Gaussians, 32 x 32 pixels; psnr_rgb {fit.psnr_rgb:.2f} dB"
    assert heading in eg.view(fit).html and heading in eg.view(fit.gaussians, coffee(32)).html
    assert "psnr_rgb" not in eg.view(fit.gaussians).html


def test_a_gaussian_takes_26_bytes_of_a_page():
    """It takes 32 of a file without compression."""
    few, many = (len(eg.view(make_set(n, (320, 240))).html) for n in (1, 3001))
    assert many - few < 27 * 3000


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


def test_refuses_other_things(fit):
    with pytest.raises(TypeError, match="Eigenbasis cannot be shown"):
        eg.view(small_basis())
    with pytest.raises(ValueError, match="mean image of pixels"):
        eg.view(replace(fit, mean_image=np.zeros((32, 32, 3))))
    gaussians = make_set()
    gaussians.mean.x = gaussians.mean.x / 0
    with pytest.raises(ValueError, match="mean holds values that are not finite"):
        eg.view(gaussians)


def test_a_page_has_the_components_of_largest_variance():
    model = eg.EigenGS.load("natural")
    counts = [len(c["deviations"]) for c in facts_of(eg.view(model))["model"]["channels"]]
    assert counts == [93, 8, 8]  # all sliders, and what fits
    left = np.concatenate([v[n:] for v, n in zip(model.eigenvalues, counts, strict=True)])
    assert model.eigenvalues[0][92] >= left.max()
    share = 1 - left.sum() / sum(map(np.sum, model.eigenvalues))
    assert f"first 109 of 350 components, with {share:.0%}" in eg.view(model).html
    assert "components, with" not in eg.view(small_model("llvm")).html


# --- Notebooks ---


def pictures(html):
    """The pictures in HTML, as 8-bit arrays."""
    codes = re.findall(r'src="data:image/\w+;base64,([^"]+)"', html)
    return [np.asarray(Image.open(BytesIO(b64decode(code)))).astype(float) for code in codes]


def test_a_set_is_its_picture():
    gaussians = make_set(60)
    assert repr(gaussians) == "Gaussians(60, 32x24 pixels, 3 channels, 'rgb', cutoff=3)"
    html = gaussians._repr_html_()
    assert "60, 32x24 pixels, 3 channels" in html
    [shown] = pictures(html)
    expected = np.rint(255 * np.clip(eg.picture_of(gaussians), 0, 1))
    assert np.abs(shown - expected).mean() < 4  # JPEG


def test_maps_have_a_picture_each():
    html = material(backend="llvm")._repr_html_()
    assert len(pictures(html)) == 3 and "roughness" in html


@pytest.mark.parametrize(("channels", "shape"), [(3, (320, 480, 3)), (5, (320, 480))])
def test_large_sets_are_scaled_down_and_one_of_many_channels_is_shown(channels, shape):
    gaussians = random_scene(0, 20, (48, 32), channels).on("llvm").scaled(960, 640)
    [shown] = pictures(gaussians._repr_html_())
    assert shown.shape == shape


def test_a_set_of_too_many_has_no_picture():
    arrays = [np.ones(((1 << 20) + 1, columns)) for columns in (2, 3, 1)]
    html = eg.Gaussians.from_arrays(*arrays, size=(8, 8), space="data")._repr_html_()
    assert "Gaussians(1048577" in html and "<img" not in html


def test_a_fit_is_its_picture(fit):
    """A large one is scaled down: stripes of a pixel become grey."""
    html = fit._repr_html_()
    assert len(pictures(html)) == 1 and "psnr_rgb=" in html
    striped = np.zeros((640, 960, 3), np.float32)
    striped[:, ::2] = 1
    large = replace(fit, gaussians=fit.gaussians.scaled(960, 640), image=striped)
    [shown] = pictures(large._repr_html_())
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


def test_the_picture_of_a_model_of_lights_is_that_from_above():
    model = LitFormula().model()
    html = model._repr_html_()
    assert repr(model) in html
    [shown], [above] = pictures(html), pictures(model.relight((0, 0, 1))._repr_html_())
    np.testing.assert_array_equal(shown, above)
    assert eg.view(model)._repr_html_().startswith("<iframe srcdoc=")


NOTEBOOK = Path(__file__).parents[3] / "docs" / "notebook.ipynb"


def test_the_stored_outputs_of_the_notebook_are_small():
    """Write them by ``python tools/manual/run_notebook.py``; 'make docs' runs the notebook."""
    text = NOTEBOOK.read_text("utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert sum(bool(cell["outputs"]) for cell in cells) == 8
    assert len(text) < 200_000 and "<iframe" not in text and ".venv" not in text


@pytest.mark.slow  # it starts a kernel
@pytest.mark.skipif(find_spec("ipywidgets") is not None, reason="ipywidgets is installed")
def test_a_notebook_without_widgets_warns_about_nothing():
    nbformat = pytest.importorskip("nbformat", reason="no nbformat")
    client = pytest.importorskip("nbclient", reason="no nbclient")
    pytest.importorskip("ipykernel", reason="no kernel for notebooks")
    code = """
import warnings
warnings.simplefilter("always")
import numpy as np, eigengs_dr as eg
photo = np.random.default_rng(0).uniform(size=(64, 64, 3)).astype(np.float32)
eg.fit(photo, gaussians=50, iterations=20)
"""
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    client.NotebookClient(book, timeout=200, startup_timeout=200, kernel_name="python3").execute()
    outputs = book.cells[0].outputs
    told = "".join(o.text for o in outputs if o.output_type == "stream")
    assert "Warning" not in told and "IProgress" not in told
    assert sum("text/html" in o.get("data", {}) for o in outputs) == 1
