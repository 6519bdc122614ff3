"""Numbers of NumPy are numbers wherever a number is; truth values and text are none."""

import inspect
import json
import re
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import family

NEED_MITSUBA = ("fit_for_scene", "register_plugins")


def functions():
    """Yield the public functions and methods, by their names."""
    for name in eg.__all__:
        if name == "Method":  # fits call its methods
            continue
        if name in NEED_MITSUBA:
            pytest.importorskip("mitsuba", reason="scenes need mitsuba")
        thing = getattr(eg, name)
        if callable(thing) and not inspect.isclass(thing):
            yield name, thing
        for method in vars(thing) if inspect.isclass(thing) else ():
            if not method.startswith("_") and callable(getattr(thing, method)):
                yield f"{name}.{method}", getattr(thing, method)


def test_what_is_no_number_is_refused_in_one_line():
    """Everywhere in the public API where an annotation says int or float."""
    checked = 0
    for name, function in functions():
        parameters = inspect.signature(function).parameters
        required = {
            p.name: 1 if re.match("int|float", str(p.annotation)) else "x"
            for p in parameters.values()
            if p.default is p.empty and p.kind is not p.VAR_KEYWORD
        }
        for number, parameter in parameters.items():
            if not re.fullmatch(r"(int|float)( \| None)?", str(parameter.annotation)):
                continue
            for wrong in ("5", True, np.True_, [1], 1.5 if "int" in parameter.annotation else "x"):
                with pytest.raises(TypeError, match=f"^{number} is .*; it must be a") as error:
                    function(**{**required, number: wrong})
                assert "\n" not in str(error.value), name
            checked += 1
    assert checked > 30


def test_numbers_of_numpy_are_numbers(tmp_path):
    image, n = family(1, side=16)[0], np.int64
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
