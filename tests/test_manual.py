"""Pages of the manual: their Python runs in order, and what they claim of derivatives holds."""

import re
import runpy
import warnings
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg

FOLDER = Path(__file__).parent.parent / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.M | re.S)


def run_page(name, gaussians=None):
    """Run the blocks of a page as one program, perhaps with fewer Gaussians; its variables."""
    text = (FOLDER / name).read_text()
    if gaussians:
        text = re.sub(r"gaussians=\d+", f"gaussians={gaussians}", text)
    space = {"__name__": "page"}
    for found in BLOCK.finditer(text):
        line = text.count("\n", 0, found.start(1))
        exec(compile("\n" * line + found[1], str(FOLDER / name), "exec"), space)
    return space


@pytest.fixture(scope="module")
def own_loop():
    return run_page("how-to/own-loop.md")


def numbers(tensor):
    return np.array(dr.detach(tensor).numpy(), np.float64)


def test_the_loss_of_the_page_is_ssim(own_loop):
    pictures = [np.clip(numbers(eg.render(own_loop[name])), 0, 1) for name in ("found", "start")]
    tensors = [own_loop["TensorXf"](p.astype(np.float32)) for p in pictures]
    found = own_loop["ssim"](*tensors).array[0]
    assert abs(found - eg.ssim(*pictures)) < 1e-5


def test_the_loops_of_the_page_fit(own_loop):
    """The frozen loop takes the steps of the plain one, but for the lists of five steps."""
    image = own_loop["image"]
    before, plain, frozen = (
        eg.psnr(numbers(eg.render(own_loop[name])), image) for name in ("start", "found", "frozen")
    )
    assert plain > before + 2
    assert abs(plain - frozen) < 0.1
    assert own_loop["take_step"].n_recordings <= 3
    a, _, c = own_loop["found"].factor.numpy()
    assert (a > 0).all() and (c > 0).all()


def test_the_loss_of_the_page_has_the_derivative_of_finite_differences(own_loop):
    found, image, step = np.random.default_rng(3).uniform(0.2, 0.8, (3, 24, 24, 3))
    Tensor = type(own_loop["exact"])  # in double precision
    picture = Tensor(found)
    dr.enable_grad(picture)
    dr.backward(own_loop["loss_of"](picture, Tensor(image)))
    up, down = (
        own_loop["loss_of"](Tensor(found + s * step), Tensor(image)).array[0] for s in (1e-6, -1e-6)
    )
    wanted = (up - down) / 2e-6
    assert (dr.grad(picture).numpy() * step).sum() == pytest.approx(wanted, rel=1e-5)


def test_the_traced_loop_of_the_page_is_a_sum_with_derivatives(own_loop):
    g = dr.detach(own_loop["double"])
    Float = dr.leaf_t(g.mean)
    at = [np.array([10.5, 30.5]), np.array([20.5, 40.5])]
    x, y = map(Float, at)
    dr.enable_grad(g.mean)
    found = own_loop["brightness"](g, x, y, len(g))
    dr.backward(dr.sum(found))

    def total(mean):
        (a, b, c), (dx, dy) = g.factor.numpy()[..., None], np.array(at)[:, None] - mean[..., None]
        return np.exp(-0.5 * ((a * dx + b * dy) ** 2 + (c * dy) ** 2)).sum(0)

    mean = dr.detach(g.mean).numpy()
    np.testing.assert_allclose(found.numpy(), total(mean), rtol=1e-9)
    step = np.random.default_rng(1).normal(size=mean.shape)
    wanted = (total(mean + 1e-6 * step) - total(mean - 1e-6 * step)).sum() / 2e-6
    assert (dr.grad(g.mean).numpy() * step).sum() == pytest.approx(wanted, rel=1e-5)


def test_getting_started_runs_without_a_warning(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    eg.save_image("photo.jpg", eg.sample("coffee")[100:164, 200:264])
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        run_page("getting-started.md", gaussians="300")
    assert eg.load_image("large.png").shape == (2048, 2048, 3)


def test_getting_started_lists_all_extras():
    text = (FOLDER / "getting-started.md").read_text()
    said = set(re.findall(r"^\| `(\w+)` \|", text, re.M))
    extras = (FOLDER.parent / "pyproject.toml").read_text()
    extras = extras.split("[project.optional-dependencies]")[1].split("\n[")[0]
    assert set(re.findall(r"^(\w+) = \[", extras, re.M)) == said


@pytest.fixture(scope="module")
def check():
    return runpy.run_path(str(FOLDER / "check_pages.py"))


def test_names_are_where_the_manual_says(check):
    assert check["missing"]() == []
    assert check["exists"]("eigengs_dr.fitting.placement.density.target_density")
    assert not check["exists"]("eigengs_dr.fitting.placement.adaptive.target_density")
    assert not check["exists"]("eigengs_dr.fitting.placement.adaptive.nothing")


def test_figures_of_the_manual_can_be_traced(check):
    assert check["untraced"]() == []


@pytest.mark.parametrize(
    ("text", "traced"),
    [
        ("it takes 3.5 s", False),
        ("it gains 0.1 to\n0.2 dB", False),
        ("| a | b |\n|---|---:|\n| x | 2 |", False),
        ("it takes {measured}`3.5 s`", False),
        ("it takes {measured}`3.5 s (2 photos, commit 0a1b2c3)`", True),
        ("it takes {{ kernels.fast_ms|round(1) }} ms, as `36 dB` and $6$ dB are set", True),
        ("```sh\nfit photo.jpg  # 36 dB\n```\n16 bits, 3 x 3 pixels, 24 photos, min(k, 2)", True),
    ],
)
def test_what_a_traced_figure_is(check, text, traced):
    assert (check["untraced_in"](text) == []) == traced


def test_figures_of_the_readme_are_of_rows():
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    from eigengs_bench import kodak, rows

    [table] = kodak.summarize(rows.read(FOLDER / "rows.jsonl", "kodak")).tables
    figures = re.findall(r"(\d+\.\d+) dB \|", (FOLDER.parent / "README.md").read_text())
    assert figures and set(figures) <= set(table.frame["PSNR, float"])
