"""EigenGS for Dr.Jit and Mitsuba: images as sums of differentiable 2D Gaussians.

``__init__.pyi`` lists the public names. Python imports a name when it is first used: importing this
package neither loads Dr.Jit nor sets a Mitsuba variant.
"""

from __future__ import annotations

from .backend import interrupts

if interrupts.is_program():  # before the imports, which take half a second
    interrupts.end_at_signals()

import ast
from importlib import import_module
from pathlib import Path

from .backend import messages
from .backend.selection import import_drjit, select_libllvm
from .version import __version__ as __version__

select_libllvm()  # Dr.Jit looks for it once, while it is imported

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_MODULES = {
    alias.name: node.module  # None of a module itself
    for node in _STUB.body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}

__all__ = sorted(_MODULES)

WITHOUT_DRJIT = {"load_image", "psnr", "sample", "save_image"}
WITHOUT_DRJIT |= {"BackendError", "ClusterError", "ImageError", "Interrupted"}


def __getattr__(name: str) -> object:
    if name in __all__:
        if name not in WITHOUT_DRJIT:
            import_drjit()  # quietly, and with one line on what to install where that fails
        module = import_module(f".{_MODULES[name] or name}", __name__)
        return getattr(module, name) if _MODULES[name] else module
    raise messages.no_attribute(__name__, name, __all__)


def __dir__() -> list[str]:
    return __all__
