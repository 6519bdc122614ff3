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
        if name == "Method":  # fits call its methods; what it is made of is tested below
            continue
        if name in NEED_MITSUBA:
            pytest.importorskip("mitsuba", reason="scenes need mitsuba")
        thing = getattr(eg, name)
        if not inspect.isclass(thing):
            if callable(thing):
                yield name, thing
            continue
        for method in vars(thing):
            if not method.startswith("_") and callable(getattr(thing, method)):
                yield f"{name}.{method}", getattr(thing, method)


def test_what_is_no_number_is_refused_in_one_line():
    """Everywhere in the public API where an annotation says int or float."""
    checked = 0
    for name, function in functions():
        for number, parameter in inspect.signature(function).parameters.items():
            if not re.fullmatch(r"(int|float)( \| None)?", str(parameter.annotation)):
                continue
            required = {
                p.name: 1 if re.match("int|float", str(p.annotation)) else "x"
                for p in inspect.signature(function).parameters.values()
                if p.default is p.empty and p.kind is not p.VAR_KEYWORD
            }
            for wrong in ("5", True, np.True_, [1], 1.5 if "int" in parameter.annotation else "x"):
                with pytest.raises(TypeError, match=f"^{number} is .*; it must be a") as error:
                    function(**{**required, number: wrong})
                assert "\n" not in str(error.value), name
            checked += 1
    assert checked > 30


@pytest.mark.parametrize("name", ["cutoff", "solve_steps", "warm_up", "decay"])
def test_what_is_no_number_of_a_method_is_refused_in_one_line(name):
    for wrong in ("5", True, [1], None):
        with pytest.raises(TypeError, match=f"^Method: {name} is .*; it must be a"):
            replace(eg.DEFAULT, **{name: wrong})


def test_a_fit_checks_types_of_numpy(tmp_path):
    image = family(1, side=16)[0]
    n = np.int64
    method = replace(eg.DEFAULT, solve_steps=2, cutoff=2.5)
    plain = eg.fit(image, [5, 20], iterations=3, seed=1, method=method)
    assert eg.level_counts(n(20), n(2)) == [5, 20]
    numbers = {"iterations": np.int32(3), "seed": np.uint8(1)}
    method = replace(eg.DEFAULT, solve_steps=n(2), cutoff=np.float32(2.5))
    result = eg.fit(image, np.array([5, 20]), method=method, **numbers)
    for name, array in plain.gaussians.to_arrays().items():
        np.testing.assert_array_equal(array, result.gaussians.to_arrays()[name])
    json.dumps([result.iterations, result.gaussians.cutoff])
    rows = eg.fit_many([image, image], tmp_path, gaussians=n(20), iterations=n(3))
    assert [row.gaussians for row in rows] == [20, 20]
    assert eg.render(result, width=n(9), height=n(7), cutoff=np.float32(2)).shape == (7, 9, 3)
    with pytest.raises(TypeError, match="gaussians is 'many'; it must be a whole number"):
        eg.fit_many([image], tmp_path, gaussians="many")
