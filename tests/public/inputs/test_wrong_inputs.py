"""What is no input of a function: one line that names it, as TypeError or ValueError."""

import inspect
import json
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import complaint
from _helpers.process import run_python

IMAGE = np.random.default_rng(0).random((16, 16, 3), np.float32)

EIGHT = {"size": (8, 8)}
SET = eg.Gaussians.from_arrays(
    [[4, 4], [9, 9]],
    [[0.5, 0, 0.5], [0.4, 0, 0.3]],
    [[1, 0, 0], [0.5, 0.1, 0.1]],
    size=(16, 16),
)

BAD_VALUES = (
    None,
    5,
    1.5,
    True,
    object(),
    [],
    {},
    b"x",
    lambda: 0,
    3 + 4j,
    np.zeros(0),
    np.full((16, 16, 3), np.nan),
)
"""Values that are neither a string, a path nor a set."""


def functions():
    """The public functions and methods, by their names."""
    for name in eg.__all__:
        if name == "Method":  # fits call its methods
            continue
        thing = getattr(eg, name)
        if inspect.isfunction(thing):
            yield name, thing
        for method in vars(thing) if inspect.isclass(thing) else ():
            if not method.startswith("_") and callable(getattr(thing, method)):
                yield f"{name}.{method}", getattr(thing, method)


def required_of(function):
    """Values for the arguments that a function needs: 1 where it takes a number."""
    return {
        p.name: 1 if p.annotation in ("int", "float") else {} if p.name == "tensors" else "x"
        for p in inspect.signature(function).parameters.values()
        if p.default is p.empty and p.kind < p.VAR_KEYWORD
    }


KINDS = {
    "str": "a string",
    "bool": "True or False",
    "str | os.PathLike[str]": "a path",
    "PathLike": "a path",
    "Gaussians": "a set of Gaussians",
}


@pytest.mark.parametrize("kind", KINDS)
def test_an_argument_of_another_type_is_named_in_a_type_error(kind):
    checked = 0
    for name, function in functions():
        parameters = inspect.signature(function).parameters.values()
        required = required_of(function)
        for argument in [p.name for p in parameters if p.annotation in (kind, f"{kind} | None")]:
            if name in ("view", "Eigenbasis.project", "Eigenbasis.truncation_curve"):
                continue
            optional = str(inspect.signature(function).parameters[argument].annotation) != kind
            for bad in BAD_VALUES[optional:]:
                if kind == "bool" and bad is True:
                    continue
                message = complaint(TypeError, function, **(required | {argument: bad}))
                assert message.startswith(f"{argument} is "), name
                assert message.endswith(f"; it must be {KINDS[kind]}"), name
            checked += 1
    assert checked


def test_what_is_no_number_is_refused_in_one_line():
    """Everywhere in the public API where an annotation says int or float."""
    checked = 0
    for name, function in functions():
        required = required_of(function)
        for number, parameter in inspect.signature(function).parameters.items():
            if not re.fullmatch(r"(int|float)( \| None)?", str(parameter.annotation)):
                continue
            for wrong in ("5", True, np.True_, [1], 1.5 if "int" in parameter.annotation else "x"):
                message = complaint(TypeError, function, **{**required, number: wrong})
                assert re.match(f"{number} is .*; it must be a", message), name
            checked += 1
    assert checked > 30


def test_numbers_of_numpy_are_numbers(tmp_path):
    image, n = IMAGE, np.int64
    method = replace(eg.DEFAULT, solve_steps=2, cutoff=4.0)
    plain = eg.fit(image, [5, 20], iterations=3, seed=1, method=method)
    assert eg.level_counts(n(20), n(2)) == [5, 20]
    numbers = {"iterations": np.int32(3), "seed": np.uint8(1)}
    method = replace(eg.DEFAULT, solve_steps=n(2), cutoff=np.float32(4.0))
    result = eg.fit(image, np.array([5, 20]), method=method, **numbers)
    np.testing.assert_array_equal(result.image, plain.image)
    json.dumps([result.iterations, result.gaussians.cutoff])
    assert eg.render(result, width=n(9), height=n(7), cutoff=np.float32(4)).shape == (7, 9, 3)
    with pytest.raises(TypeError, match="gaussians is 'many'; it must be a whole number"):
        eg.fit_many([image], tmp_path, gaussians="many")


TYPES = {
    "sets is ": (eg.concatenate, [None, 5, "x", [None], ["x"], {"a": 1}, object(), np.ones(3)]),
    "list of sets": (lambda wrong: eg.concatenate([SET, wrong]), [None, "x", [], {}]),
    "maps": (
        lambda wrong: eg.Gaussians.from_arrays([[4, 4]], [[1, 0, 1]], [[1]], maps=wrong, **EIGHT),
        [None, 5, "x", [None], np.ones(3)],
    ),
    "tensors is ": (lambda wrong: eg.from_tensors(wrong, SET), [None, 5, "x", [SET]]),
    "Dr.Jit tensor": (
        lambda wrong: eg.from_tensors({"mean": wrong}, SET),
        [None, 5, np.ones((2, 2)), SET.mean],
    ),
    "region is ": (
        lambda wrong: eg.render(SET, region=wrong),
        [5, "abc", (1.5, 2, 3, 4), [True, 0, 4, 4], object()],
    ),
    "tile_lists": (lambda wrong: eg.render(SET, lists=wrong), [[SET]]),
    "sections": (
        lambda wrong: eg.pack(SET, "never.egs", sections=wrong),
        [5, [1.5, 1], ["1", "1"], [True, True]],
    ),
    "images is ": (eg.Eigenbasis.from_images, [None, 5, object()]),
    " images is ": (eg.fit_many, [None, 5, object()]),
    "judge is 'x'": (lambda wrong: eg.Loss(lambda picture, step: 0, judge=wrong), ["x"]),
}
"""What the error of a call says, the call, and values of another type."""


@pytest.mark.parametrize("words", TYPES)
def test_values_of_another_type(words):
    call, values = TYPES[words]
    for wrong in values:
        assert words.strip() in complaint(TypeError, call, wrong)


def test_values_that_do_not_do():
    assert "'shake' is unknown" in complaint(ValueError, eg.DEFAULT.without, "shake")
    complaint(ValueError, eg.DEFAULT.without, np.ones(3))
    # Lists of steps without end would fill the memory.
    assert "iterations" in complaint(ValueError, eg.fit, IMAGE, 5, iterations=10**12)


@pytest.mark.parametrize("name", ["mean", "factor", "color", "background"])
def test_arrays_of_a_set(name):
    good = {"mean": [[4, 4]], "factor": [[1, 0, 1]], "color": [[1]], "background": [0]}
    options = {"size": (8, 8), "space": "data"}
    for wrong in (None, "x", {}, object(), iter([]), ["a"], [None], np.datetime64("2020")):
        if wrong is None and name == "background":
            continue
        message = complaint(
            TypeError, eg.Gaussians.from_arrays, **(good | {name: wrong}), **options
        )
        assert message.startswith(f"Gaussians: {name} is ")
    for wrong in ([[1], [1, 2]], [], [[np.nan]], [np.inf]):
        complaint(ValueError, eg.Gaussians.from_arrays, **(good | {name: wrong}), **options)


@pytest.mark.parametrize("channels", [2, 4])
def test_images_of_too_many_channels_are_refused_in_a_list_as_alone(channels):
    """They are not taken for as many grey images as they have rows."""
    wrong = np.ones((16, 16, channels), np.float32) / 2
    basis = eg.Eigenbasis.from_images([IMAGE, IMAGE[::-1]], size=(16, 16), components=1)
    for function in (basis.project, eg.fit, lambda one: eg.Eigenbasis.from_images([IMAGE, one])):
        assert f"shape (16, 16, {channels})" in complaint(ValueError, function, wrong)


@pytest.mark.parametrize("text", ["1GB", "-5", "0", "1.5", "x"])
def test_a_limit_in_the_environment_that_is_no_number(text, tmp_path, monkeypatch):
    eg.save_image(tmp_path / "a.png", IMAGE)
    monkeypatch.setenv("EIGENGS_DR_MAX_FILE_MB", text)
    message = complaint(ValueError, eg.load_image, tmp_path / "a.png")
    assert f"EIGENGS_DR_MAX_FILE_MB is {text!r}; set a whole number" in message
    monkeypatch.setenv("EIGENGS_DR_MAX_FILE_MB", "50")
    assert eg.load_image(tmp_path / "a.png").shape == (16, 16, 3)


def test_arrays_in_place_of_options_give_one_line():
    """NumPy prints them in many."""
    wrong = np.ones((16, 16, 3))
    for name in ("gaussians", "method", "encoding", "backend"):
        complaint(TypeError, eg.fit, IMAGE, **{"gaussians": 5, "iterations": 1, name: wrong})
    complaint(ValueError, eg.fit, IMAGE, 5, space=wrong)
    complaint(ValueError, eg.Eigenbasis.from_images, [IMAGE], components=wrong)


def test_what_is_no_plugin_of_mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    plugins = eg.plugins
    for wrong in (None, "x", 5, [], object(), np.ones(3)):
        assert "sensor is " in complaint(TypeError, plugins.pixel_angle, wrong)
        assert "texture is " in complaint(TypeError, plugins.resident_bytes, wrong)
        for function in (plugins.gaussians_of, plugins.keep_in_bounds):
            assert "parameters is " in complaint(TypeError, function, wrong, "a", SET)
            assert "like is " in complaint(TypeError, function, {}, "a", wrong)
        for function in (plugins.texture_of, plugins.bake_environment):
            complaint(TypeError, function, wrong)


ESCAPE = "a\x1b[31m\nb\u202e"
"""A name that would colour a terminal, break a line and turn what follows."""


def test_control_characters_of_names_are_escaped(tmp_path):
    image, damaged = tmp_path / f"{ESCAPE}.png", tmp_path / f"{ESCAPE}.npz"
    message = complaint(ValueError, eg.load_image, image)
    assert r"a\x1b[31m\nb\u202e.png: no such file" in message
    image.write_bytes(b"none")
    assert complaint(ValueError, eg.load_image, image).count(".png: ") == 1
    damaged.write_bytes(b"PK\3\4")
    complaint(ValueError, eg.Gaussians.load, damaged)
    eg.save_image(tmp_path / "rgb.png", np.ones((4, 4, 3), np.float32))
    transparent = tmp_path / f"{ESCAPE}2.png"
    from PIL import Image

    Image.new("RGBA", (4, 4)).save(transparent)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        eg.load_image(transparent)
    assert all(str(one.message).isprintable() for one in told) and told


def test_libraries_print_nothing_of_damaged_files(tmp_path):
    """A PNG file cut in its header or its pixels, or with a flipped byte in each chunk."""
    path = tmp_path / "a.png"
    eg.save_image(path, IMAGE)
    content = path.read_bytes()
    bad = [content[:40], content[:100], content[:-20]]
    bad += [content[:k] + bytes([content[k] ^ 255]) + content[k + 1 :] for k in (9, 13, 20, 30, 99)]
    for number, damaged in enumerate(bad):
        (tmp_path / f"{number}.png").write_bytes(damaged)
    code = f"""
import eigengs_dr as eg
for number in range({len(bad)}):
    try:
        eg.load_image(f"{tmp_path.as_posix()}/{{number}}.png")
    except eg.ImageError as error:
        print(error)
"""
    run = run_python(code)
    lines = run.stdout.splitlines()
    assert len(lines) >= len(bad) - 1 and all(".png: damaged" in line for line in lines)
    assert run.returncode == 0 and "libpng" not in run.stderr
