"""EigenGS for Dr.Jit and Mitsuba: images as sums of differentiable 2D Gaussians.

``__init__.pyi`` lists the public names. Python imports a name when it is first used: importing this
package neither loads Dr.Jit nor sets a Mitsuba variant.
"""

from pkgutil import resolve_name
from typing import Any

import lazy_loader

from .backend.libllvm import select_libllvm

__version__ = "0.1.0"

# Dr.Jit looks for libLLVM once, while it is imported; lazy_loader imports it here if EAGER_IMPORT
# is set.
select_libllvm()

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def load_ipython_extension(shell: Any) -> None:
    """Shorten errors in a notebook: what ``%load_ext eigengs_dr`` calls."""
    resolve_name("eigengs_dr.viewer.short_errors:install")(shell)
