"""The page in a browser: it draws as the renderer does."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import family, small_model
from _helpers.shown import COUNT, SIZE, codes, differ, make_set
from eigengs_dr.viewer.view import Page


@pytest.mark.parametrize(
    "space, channels", [("ycbcr", 3), ("linear", 3), ("log", 3), ("normal", 3), ("data", 1)]
)
def test_draws_as_the_renderer(actual, space, channels):
    gaussians = make_set(space, channels, cutoff=4.0)
    found = actual(eg.view(gaussians)).image()
    assert found.std() > 20
    assert differ(found, codes(gaussians)) < 0.05
    assert np.abs(found - codes(gaussians)).max() <= 3


def test_shows_each_channel_of_data(actual):
    gaussians = make_set("data", 5)
    tab = actual(eg.view(gaussians))
    whole = np.rint(255 * np.clip(eg.picture_of(gaussians), 0, 1))
    assert differ(tab.image(), whole[..., :3]) < 0.05
    tab.page.select_option("#channels", "4,4,4")
    assert differ(tab.image(), whole[..., [4, 4, 4]]) < 0.05


def test_light_is_exposed(actual):
    gaussians = make_set("radiance")
    tab = actual(eg.view(gaussians))
    tab.page.fill("#exposure", "-2")
    assert tab.page.text_content("#exposure-text") == "-2 stops"
    arrays = gaussians.to_arrays()
    arrays["color"], arrays["background"] = arrays["color"] / 4, arrays["background"] / 4
    darker = eg.Gaussians.from_arrays(**arrays, size=SIZE, space="radiance")
    assert differ(tab.image(), codes(darker)) < 0.05


def test_the_first_gaussians_are_levels_or_the_largest(actual):
    gaussians = make_set()
    tab = actual(eg.view(gaussians, levels=[20, 100, COUNT]))
    tab.page.click("#levels button:nth-child(2)")
    assert tab.page.text_content("#count-text") == "100 of 300"
    assert differ(tab.image(), codes(gaussians[:100])) < 0.05

    factor = gaussians.to_arrays()["factor"]
    order = np.argsort(factor[:, 0] * factor[:, 2], kind="stable")
    tab = actual(eg.view(gaussians))
    tab.page.fill("#count", "600")
    count = tab.run("viewer.look.count")
    assert 10 < count < 100
    assert differ(tab.image(), codes(gaussians[order[:count]])) < 0.05


def test_text_is_escaped(show):
    title = "</title></script><script>window.broken = 1</script>&"
    tab = show(eg.view(make_set(), title=title))
    assert tab.page.title() == title
    assert tab.page.text_content("h1") == title
    assert tab.run("window.broken") is None


def test_everything_is_in_reach_on_a_phone(show):
    tab = show(eg.view(small_model("llvm"), family(count=1)[0]), "phone")
    assert tab.run("document.documentElement.scrollWidth <= innerWidth")
    for name in ("#count", "#outlines", "#compare", "#random-image", "summary"):
        tab.page.locator(name).scroll_into_view_if_needed()
        assert tab.page.locator(name).is_visible()


def test_16_bit_sums_are_close(actual):
    """Where WebGL does not add 32-bit floats, as on some phones."""
    gaussians = make_set()
    without = """<script>
        const get = WebGL2RenderingContext.prototype.getExtension;
        WebGL2RenderingContext.prototype.getExtension = function (name) {
            return name === "EXT_float_blend" ? null : get.call(this, name);
        };
    </script>"""
    page = eg.view(gaussians)
    tab = actual(Page(page.html.replace("<script>", without + "<script>", 1)))
    assert tab.run("viewer.renderer.format === viewer.renderer.gl.RGBA16F")
    assert differ(tab.image(), codes(gaussians)) < 0.2


def test_draws_again_after_the_context_is_lost(actual):
    gaussians = make_set()
    tab = actual(eg.view(gaussians))
    tab.page.evaluate("""() => new Promise((done) => {
        viewer.canvas.addEventListener("webglcontextrestored", () => setTimeout(done, 50));
        const loss = viewer.renderer.gl.getExtension("WEBGL_lose_context");
        loss.loseContext();
        setTimeout(() => loss.restoreContext(), 50);
    })""")
    tab.run("0")
    assert differ(tab.image(), codes(gaussians)) < 0.05
