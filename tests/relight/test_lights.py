"""Lists of lights, and the table of factors: reproduction, interpolation, derivatives."""

import drjit as dr
import numpy as np
import pytest

from _helpers.lit_spheres import directions
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.relight.lights import LightTable, check_lights, read_lights

KINDS = pytest.mark.parametrize("kind", ["thin_plate", "hsh"])


def table_of(kind, function, count=30, smoothing=1e-6):
    lights = directions(count)
    values = np.stack([function(light) for light in lights])
    return LightTable(lights, values, kind, smoothing)


def linear(light):
    """Factors (3, 2) that are linear in the direction, so that both kinds contain them."""
    return np.array([[light[2], 1.0], [2 * light[2] - 1, 0.5], [-light[2], 0.0]])


def wavy(light):
    """Factors (3, 2) with more than nine harmonics."""
    x, y, z = light
    return np.array([[np.sin(3 * x) * y, x], [np.cos(2 * y), z * z], [x * y * z, y]])


@KINDS
def test_table_reproduces_linear_functions(kind):
    table = table_of(kind, linear)
    between = directions(17, 0.4)
    expected = np.stack([linear(light) for light in between])
    assert np.abs(table.at(between) - expected).max() < 1e-4


def test_thin_plates_pass_through_the_lights_and_are_close_between():
    table = table_of("thin_plate", wavy, 60)
    assert np.abs(table.at(table.lights) - table.values).max() < 1e-4
    between = directions(37, 0.35)
    expected = np.stack([wavy(light) for light in between])
    assert np.abs(table.at(between) - expected).max() < 0.05


def test_lights_on_a_circle_have_a_table():
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    lights = np.stack([0.6 * np.cos(turn), 0.6 * np.sin(turn), np.full(12, 0.8)], 1)
    values = np.stack([wavy(light) for light in lights])
    table = LightTable(lights, values, "thin_plate", 1e-3)
    assert np.abs(table.at(lights) - values).max() < 0.01


@KINDS
def test_drjit_gives_the_numbers_of_numpy(kind, backend):
    table, types = table_of(kind, wavy), types_in(select(backend), 64)
    for light in directions(5, 0.5):
        factors = table.factors(types, [types.Float(float(v) * 2) for v in light])
        found = np.array([[f.numpy()[0] for f in row] for row in factors])
        assert np.abs(found - table.at(light[None])[0]).max() < 1e-9


@KINDS
def test_derivative_by_the_direction_is_that_of_finite_differences(kind, backend):
    table, types = table_of(kind, wavy), types_in(select(backend), 64)
    light, step = np.array([0.3, -0.2, 0.7]), 1e-6

    def value(direction):
        factors = table.factors(types, direction)
        return sum(f * (k + 1) for k, f in enumerate(f for row in factors for f in row))

    variables = [types.Float(float(v)) for v in light]
    dr.enable_grad(variables)
    dr.backward(value(variables))
    for axis, variable in enumerate(variables):
        pair = [light + sign * step * np.eye(3)[axis] for sign in (1, -1)]
        high, low = (value([types.Float(float(v)) for v in p]).numpy()[0] for p in pair)
        assert dr.grad(variable).numpy()[0] == pytest.approx((high - low) / (2 * step), rel=1e-5)


def test_a_list_of_lights_may_have_folders_and_spaces_in_names(tmp_path):
    path = tmp_path / "dirs.lp"
    path.write_text("2\r\nC:\\photos\\image 1.jpg 0 0 2\n\nfolder/b.png 0.6 0 0.8\n")
    names, lights = read_lights(path)
    assert names == ["image 1.jpg", "b.png"]
    assert np.allclose(lights, [[0, 0, 1], [0.6, 0, 0.8]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line is ''"),
        ("3\na.jpg 0 0 1\n", "first line is '3', but 1 photos follow"),
        ("1\na.jpg 0 0\n", "line 2 is 'a.jpg 0 0'"),
        ("1\na.jpg 0 0 up\n", "line 2"),
        ("1\na.jpg 0 0 0\n", "no direction"),
        ("1\na.jpg 0 0 nan\n", "no direction"),
        ("1\na.jpg 0.6 0 -0.8\n", "light 1 is 0.6, 0, -0.8, below the horizon"),
    ],
)
def test_a_damaged_list_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "dirs.lp"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_lights(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_list_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "dirs.lp"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00photo")
    with pytest.raises(ValueError, match="no text"):
        read_lights(path)


def test_lights_need_three_numbers():
    with pytest.raises(ValueError, match=r"shape \(4, 2\)"):
        check_lights(np.ones((4, 2)))
