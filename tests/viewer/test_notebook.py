"""What notebooks show; the notebook of the manual runs."""

import re
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.families import small_basis, small_model
from _helpers.sets import random_scene

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


def test_the_notebook_runs():
    nbformat = pytest.importorskip("nbformat", reason="no nbformat")
    client = pytest.importorskip("nbclient", reason="no nbclient")
    pytest.importorskip("ipykernel", reason="no kernel for notebooks")
    book = nbformat.read(NOTEBOOK, 4)
    assert not any(cell.get("outputs") for cell in book.cells), "outputs are not stored"
    client.NotebookClient(book, timeout=200, startup_timeout=200, kernel_name="python3").execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", [])]
    shown = [output for output in outputs if "text/html" in output.get("data", {})]
    assert len(shown) == 7
    [error] = [output for output in outputs if output.output_type == "error"]
    assert error.ename == "ImageError" and "divide by 255" in error.evalue
    assert all(len(line) < 600 for line in error.traceback)
