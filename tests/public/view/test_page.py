"""The page in a browser: it draws as the renderer does, and answers mouse, touch and keyboard."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SIDE, family, small_model
from _helpers.lit_spheres import directions, photos
from _helpers.sets import random_scene

SIZE = (120, 90)

COUNT = 300


def make_set(space="rgb", channels=3, cutoff=3.0, count=COUNT):
    arrays = random_scene(1, count, SIZE, channels)
    color = arrays.color * 0.4
    background = np.full(channels, 0.4)
    return eg.Gaussians.from_arrays(
        arrays.mean, arrays.factor, color, background, size=SIZE, space=space, cutoff=cutoff
    )


def codes(gaussians, **size):
    """The renderer's picture in 8 bits, RGB."""
    picture = eg.picture_of(gaussians, **size)
    return np.broadcast_to(np.rint(255 * np.clip(picture, 0, 1)), (*picture.shape[:2], 3))


def differ(a, b):
    """Mean difference in steps of 8 bits."""
    assert a.shape == b.shape
    return np.abs(a - b).mean()


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
    tab = actual(replace(page, html=page.html.replace("<script>", without + "<script>", 1)))
    assert tab.run("viewer.renderer.format === viewer.renderer.gl.RGBA16F")
    assert differ(tab.image(), codes(gaussians)) < 0.2


# --- Mouse, touch and keyboard ---


def test_zoom_has_no_end(show):
    """Pixels are compared with those of the same set, moved and scaled."""
    gaussians, middle = make_set(), np.array([33.3, 41.7])
    tab = show(eg.view(gaussians))
    for scale in (7.3, 1e8):
        tab.run(f"viewer.camera.place(...{middle.tolist()}, {scale}); viewer.redraw()")
        found = tab.pixels()
        size = found.shape[1::-1]
        arrays = {name: values.astype(float) for name, values in gaussians.to_arrays().items()}
        arrays["mean"] = (arrays["mean"] - middle) * scale + 0.5 * np.array(size)
        arrays["factor"] /= scale
        moved = eg.Gaussians.from_arrays(**arrays, size=size, space="rgb", dtype=np.float64)
        assert differ(found, codes(moved)) < 0.5, scale


def test_zoomed_out_it_averages(show):
    """As the renderer does, not samples at the centres of pixels."""
    gaussians = make_set()
    tab = show(eg.view(gaussians))
    for times in (2, 6):
        width, height = (round(side / times) for side in SIZE)
        canvas = tab.pixels().shape[1::-1]
        left, top = ((a - b) // 2 for a, b in zip(canvas, (width, height), strict=True))
        x, y = (times * (c / 2 - first) for c, first in zip(canvas, (left, top), strict=True))
        tab.run(f"Object.assign(viewer.camera, {{x: {x}, y: {y}, scale: {1 / times}}}) && 0")
        tab.run("viewer.redraw()")
        found = tab.pixels()[top : top + height, left : left + width]
        assert differ(found, codes(gaussians, width=width, height=height)) < 0.05
        assert differ(found, codes(gaussians, width=width, height=height, filter=False)) > 0.5


def test_mouse_and_keyboard_move_the_picture(show):
    tab = show(eg.view(make_set()))
    page = tab.page
    assert tab.run("viewer.camera.x") == SIZE[0] / 2

    at = tab.run("viewer.camera.toImage(150, 200)")
    page.mouse.move(150, 200)
    page.mouse.wheel(0, -240)
    tab.wait("viewer.camera.scale > 1.5 * viewer.camera.fitScale")  # the wheel answers later
    np.testing.assert_allclose(tab.run("viewer.camera.toImage(150, 200)"), at)  # stays under it

    page.mouse.down()
    page.mouse.move(190, 170, steps=3)
    page.mouse.up()
    np.testing.assert_allclose(tab.run("viewer.camera.toImage(190, 170)"), at)

    page.keyboard.press("0")
    assert tab.run("viewer.camera.fitted")
    for key in ("+", "ArrowRight", "ArrowDown"):
        page.keyboard.press(key)
    x, y, zoom = tab.run("((c) => [c.x, c.y, c.scale / c.fitScale])(viewer.camera)")
    assert x > SIZE[0] / 2 and y > SIZE[1] / 2 and zoom == pytest.approx(1.25)
    page.keyboard.press("1")
    assert tab.run("byId('zoom').textContent") == "100 %"

    before = tab.run("viewer.camera.x")
    page.focus("#count")
    page.keyboard.press("ArrowLeft")  # moves the slider alone
    assert tab.run("[viewer.camera.x, viewer.look.count < viewer.set.count]") == [before, True]


def test_two_fingers_zoom(show):
    tab = show(eg.view(make_set()), "phone")
    send = tab.fingers()
    before = tab.run("viewer.camera.scale")
    at = tab.run("viewer.camera.toImage(2 * 180, 2 * 150)")
    send("touchStart", (150, 150), (210, 150))
    for step in range(1, 7):
        send("touchMove", (150 - 10 * step, 150), (210 + 10 * step, 150))
    send("touchEnd")
    assert tab.run("viewer.camera.scale") == pytest.approx(3 * before, rel=0.01)
    np.testing.assert_allclose(tab.run("viewer.camera.toImage(2 * 180, 2 * 150)"), at, atol=0.1)

    tab.page.touchscreen.tap(180, 150)
    tab.page.locator("#chosen").wait_for()


def test_the_photo_is_right_of_the_divider(actual):
    gaussians = make_set()
    photo = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    photo[:, ::2] = (200, 100, 50)
    tab = actual(eg.view(gaussians, photo))
    tab.page.check("#compare")
    left = tab.run("viewer.camera.frame[0]")
    split = int(tab.run("viewer.camera.width") / 2 - left)
    assert 0 < split < SIZE[0]
    found = tab.image()
    assert differ(found[:, :split], codes(gaussians)[:, :split]) < 0.05
    np.testing.assert_array_equal(found[:, split:], photo[:, split:])

    tab.page.focus("#divider")
    tab.page.keyboard.press("ArrowRight")
    assert tab.run("viewer.wipe") == pytest.approx(0.52)
    box = tab.page.locator("#divider i").bounding_box()
    tab.page.mouse.move(box["x"] + 1, 50)
    tab.page.mouse.down()
    tab.page.mouse.move(box["x"] + 1 - 50, 50)
    tab.page.mouse.up()
    canvas = tab.run("viewer.canvas.clientWidth")
    assert tab.run("viewer.wipe") == pytest.approx(0.52 - 50 / canvas, abs=0.01)

    tab.page.mouse.wheel(0, -240)  # over the divider
    tab.wait("viewer.camera.scale > 1.5")


def test_points_at_a_gaussian(show):
    mean = [[30, 30], [90, 60]]
    factor = [[0.2, 0, 0.1], [0.25, 0, 0.25]]
    color = [[0.5, 0.25, 0.125], [0.3, 0.3, 0.3]]
    gaussians = eg.Gaussians.from_arrays(mean, factor, color, size=SIZE, space="rgb")
    tab = show(eg.view(gaussians))
    left, top, width, _ = tab.run("viewer.camera.frame")
    corner, scale = np.array([top, left]), width / SIZE[0]
    before = tab.pixels()
    tab.page.mouse.move(left + 30 * scale, top + 30 * scale)
    for name, expected in {
        "number": "1 of 2",
        "mean": "30.00, 30.00 px",
        "size": "10.0 \u00d7 5.00 px",
        "angle": "90°",
        "color": "0.500, 0.250, 0.125",
        "reach": "1 Gaussians",
    }.items():
        assert tab.page.text_content(f"#chosen-{name}") == expected
    changed = np.argwhere(np.abs(tab.pixels() - before).max(axis=2) > 30)
    box = (np.array([changed.min(axis=0), changed.max(axis=0)]) - corner) / scale
    np.testing.assert_allclose(box, [[20, 25], [40, 35]], atol=1)

    tab.page.mouse.move(5, 5)
    tab.page.locator("#chosen").wait_for(state="hidden")
    np.testing.assert_array_equal(tab.pixels(), before)


def test_outlines(show):
    tab = show(eg.view(make_set()))
    before = tab.pixels()
    tab.page.check("#outlines")
    assert 0.02 < (np.abs(tab.pixels() - before).max(axis=2) > 30).mean() < 0.3
    colors = tab.run("[0, viewer.set.count - 1].map((i) => viewer.inks[i])")
    assert colors[0][2] > colors[0][0] and colors[1][0] > colors[1][2]  # the largest is first
    tab.page.uncheck("#outlines")
    np.testing.assert_array_equal(tab.pixels(), before)


def scored(model, scores):
    """The Gaussians of a model for scores: coefficients in standard deviations."""
    pairs = zip(scores, model.eigenvalues, strict=True)
    return model.reconstruct([np.array(s) * np.sqrt(v[: len(s)]) for s, v in pairs])


def test_sliders_move_a_model(actual):
    model = small_model("llvm")
    tab = actual(eg.view(model))
    assert differ(tab.image(), codes(model.gaussians)) < 0.05
    assert tab.page.locator("#components fieldset").count() == 3
    tab.page.locator("#components fieldset:nth-child(1) input").nth(1).fill("2")
    tab.page.locator("#components fieldset:nth-child(3) input").nth(0).fill("-1.5")
    scores = tab.run("model.scores")
    assert scores[0][1] == 2 and scores[2][0] == -1.5
    assert np.count_nonzero(np.concatenate(scores)) == 2
    assert differ(tab.image(), codes(scored(model, scores))) < 0.1

    tab.page.click("#random-image")
    scores = tab.run("model.scores")
    assert 0.4 < np.std(np.concatenate(scores)) < 1.8
    assert differ(tab.image(), codes(scored(model, scores))) < 0.1
    tab.page.click("#mean-image")
    assert differ(tab.image(), codes(model.gaussians)) < 0.05


def test_a_photo_moves_along_the_components(actual):
    model, photo = small_model("llvm"), family(count=3, seed=5)[2]
    photo = np.ascontiguousarray(np.repeat(photo, 2, axis=1))  # another aspect ratio
    tab = actual(eg.view(model, photo))
    assert differ(tab.image(), codes(model.encode(photo))) < 0.05
    scores = tab.run("model.scores")
    pairs = zip(model.project(photo), model.eigenvalues, strict=True)
    expected = [coefficients / np.sqrt(values) for coefficients, values in pairs]
    for a, b in zip(scores, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)

    slider = tab.page.locator("#components fieldset:nth-child(1) input").first
    slider.fill(str(round(scores[0][0] + 1)))
    moved = zip(tab.run("model.scores"), expected, strict=True)
    change = scored(model, [np.array(new) - old for new, old in moved])
    before, after = (codes(g.scaled(2 * SIDE, SIDE)) for g in (model.gaussians, change))
    assert np.abs(after - before).mean() > 1
    assert differ(tab.image(), codes(model.encode(photo)) + after - before) < 1.0
    tab.page.click("#photo-image")
    assert differ(tab.image(), codes(model.encode(photo))) < 0.05


@pytest.fixture(scope="module")
def lit():
    """A model of a bump under lights."""
    lights = directions(20)
    return eg.Relightable.fit(photos(lights), lights, gaussians=80, planes=3, iterations=20)


@pytest.mark.parametrize("kind", ["thin_plate", "hsh"])
def test_a_page_relights_by_each_table(actual, lit, kind):
    model = replace(lit, table=replace(lit.table, kind=kind))
    tab = actual(eg.view(model, light=(0.6, 0, 0.8)))
    assert differ(tab.image(), codes(model.relight((0.6, 0, 0.8)))) < 0.1


def test_the_light_follows_the_pointer(actual, lit):
    model, tab = lit, actual(eg.view(lit))
    left, top, width, height = tab.run("viewer.camera.frame")
    tab.page.mouse.move(left + 0.75 * width, top + 0.25 * height)
    light = tab.run("lights.direction")
    np.testing.assert_allclose(light, [0.5, 0.5, 0.5**0.5], atol=0.1)
    assert differ(tab.image(), codes(model.relight(light))) < 0.1

    tab.page.uncheck("#follows")
    tab.page.mouse.move(left + 0.25 * width, top + 0.25 * height)
    assert tab.run("lights.direction") == light
    tab.page.mouse.move(0, 0)
    tab.page.fill("#height", "30")
    tab.page.fill("#turn", "180")
    light = tab.run("lights.direction")
    np.testing.assert_allclose(light, [-(0.75**0.5), 0, 0.5], atol=1e-6)
    assert differ(tab.image(), codes(model.relight(light))) < 0.1
    tab.page.check("#follows")
    tab.page.locator("#view").press("+")
    assert tab.run("lights.direction") == light


def test_the_light_follows_a_finger(show, lit):
    tab = show(eg.view(lit), "phone")
    send = tab.fingers()
    left, top, width, height = (v / 2 for v in tab.run("viewer.camera.frame"))
    place = tab.run("[viewer.camera.x, viewer.camera.y]")
    for kind, share in (("touchStart", 0.5), ("touchMove", 0.7), ("touchMove", 0.9)):
        send(kind, (left + share * width, top + 0.5 * height))
    send("touchEnd")
    np.testing.assert_allclose(tab.run("lights.direction"), [0.8, 0, 0.6], atol=0.05)
    assert tab.run("[viewer.camera.x, viewer.camera.y]") == place


def test_buttons_turn_the_light_and_leave_it_there(actual, lit):
    """A photo starts under its light, to which the first button turns back."""
    light = lit.lights[7].tolist()
    tab = actual(eg.view(lit, photos(lit.lights[7:8])[0], light=light))
    left, top, width, height = tab.run("viewer.camera.frame")
    place = left + 0.75 * width, top + 0.25 * height
    tab.page.mouse.move(*place)
    np.testing.assert_allclose(tab.run("lights.direction"), light)
    tab.page.click("#presets button:nth-child(4)")
    assert tab.run("lights.direction") == [0, 0, 1]
    tab.page.focus("#presets button:nth-child(3)")
    tab.page.keyboard.press("Enter")
    above = tab.run("lights.direction")
    assert above[1] > 0.9 and above[2] == pytest.approx(lit.lights[:, 2].min())
    tab.page.mouse.move(*place)
    assert tab.run("lights.direction") == above
    tab.page.click("#presets button:nth-child(1)")
    np.testing.assert_allclose(tab.run("lights.direction"), light)
    assert differ(tab.image(), codes(lit.relight(light))) < 0.1
