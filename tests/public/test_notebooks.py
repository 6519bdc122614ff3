"""What a notebook shows of public results, also where ipywidgets is missing."""

import re
from importlib.util import find_spec

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.lit_models import LitFormula

HTML = re.compile(r'src="data:image/\w+;base64,[\w+/=]{100,}"|<iframe srcdoc=')


def images(count=6):
    return np.random.default_rng(0).uniform(size=(count, 16, 16, 3)).astype(np.float32)


def fitted():
    return eg.fit(images()[0], gaussians=20, iterations=2, progress=False)


def basis():
    return eg.Eigenbasis.from_images(images(), (16, 16), components=3, progress=False)


@pytest.mark.parametrize(
    "make",
    [
        fitted,
        lambda: fitted().gaussians,
        basis,
        lambda: eg.EigenGS.fit(basis(), gaussians=20, progress=False),
        lambda: LitFormula().model(),
        lambda: eg.view(LitFormula().model()),
    ],
    ids=["fit", "set", "basis", "family", "model of lights", "page"],
)
def test_every_result_has_a_picture(make):
    assert HTML.search(make()._repr_html_())


def test_the_picture_of_a_model_of_lights_is_that_from_above():
    model = LitFormula().model()
    shown = model._repr_html_()
    assert repr(model) in shown
    assert shown.count("<img") == 1
    assert (
        re.search('src="[^"]*"', shown)[0]
        == re.search('src="[^"]*"', model.relight((0, 0, 1))._repr_html_())[0]
    )


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
