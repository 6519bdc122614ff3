"""What a loss that Dr.Jit records may use.

Dr.Jit 1.5 ends the process if an array that shares NumPy's memory is freed while it records, and
already ``picture * np.float32(2)`` makes such an array. No error can be caught then. Therefore the
code of a function is read before, and one that names more than arrays and numbers is refused.
"""

from __future__ import annotations

from dis import get_instructions
from types import CodeType, FunctionType, ModuleType
from typing import Any

import drjit as dr

from ..backend.recording import CONSTANTS
from ..backend.types import DrJitArray
from ..image.metrics import ssim

KNOWN = ("drjit", "math")
"""Packages whose functions and types Dr.Jit records, or refuses by an error."""

REFUSED = {"numpy", "torch", "jax", "tf", "__array__", "__dlpack__", "sort", "argsort"}
"""Members of an array that share its memory; and sorting, which ends the process on cuda."""


def arrays_of(function: FunctionType) -> list[DrJitArray]:
    """Return the arrays that a function uses, also in functions that it calls.

    They have to be inputs of what Dr.Jit records. Numbers are constants of it.

    Parameters
    ----------
    function : function

    Returns
    -------
    list of Dr.Jit arrays
        Evaluated and flat, without derivatives.

    Raises
    ------
    TypeError
        If it uses what may convert arrays of NumPy, see above.
    """
    arrays, seen, values = list[DrJitArray](), set[int](), _used(function)
    for name, value in values:  # it grows
        if id(value) in seen or value is ssim:
            continue
        seen.add(id(value))
        package = _package(value)
        if dr.is_array_v(value):  # or a type of them
            if dr.is_jit_v(value) and not isinstance(value, type):
                arrays.append(dr.detach(value.array if dr.is_tensor_v(value) else value))
        elif isinstance(value, (list, tuple, dict)):
            parts = value.values() if isinstance(value, dict) else value
            values += [(name, part) for part in parts]
        elif isinstance(value, FunctionType) and package != "eigengs_dr":
            values += _used(value)
        elif value is not None and type(value) not in (*CONSTANTS, slice) and package not in KNOWN:
            raise TypeError(
                f"loss: frozen=True, but its function uses {name} of {package}; make arrays of "
                "Dr.Jit or numbers of what it needs before the fit, or drop frozen=True"
            )
    dr.eval(arrays)
    return arrays


def _used(function: FunctionType) -> list[tuple[str, Any]]:
    """Return what a function names in its code; of modules, their members that it names."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    used = {name: cell.cell_contents for name, cell in cells}
    if _package(function) in KNOWN:  # it may hold a function of the user, as those of `drjit.wrap`
        return list(used.items())
    codes, names, imports = [function.__code__], set[str](), set[str]()
    for code in codes:  # it grows
        codes += [part for part in code.co_consts if isinstance(part, CodeType)]
        names |= {*code.co_names}
        imports |= {s.argval for s in get_instructions(code) if s.opname == "IMPORT_NAME"}
    if refused := names & REFUSED | imports - {*KNOWN}:  # `drjit.syntax` imports drjit
        raise TypeError(
            f"loss: frozen=True, but its function uses {min(refused)}, which Dr.Jit cannot record; "
            "drop frozen=True"
        )
    used |= {name: function.__globals__[name] for name in names & {*function.__globals__}}
    used["a default"] = (function.__defaults__, function.__kwdefaults__)
    for name, module in list(used.items()):
        if isinstance(module, ModuleType) and _package(module) not in KNOWN:
            del used[name]
            used |= {f"{name}.{n}": getattr(module, n) for n in names & {*dir(module)}}
    return list(used.items())


def _package(value: object) -> str:
    """Return the name of the package that a value, or else its type, comes from."""
    name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
    return str(name or type(value).__module__).split(".")[0]
