"""EigenGS for Dr.Jit and Mitsuba: images as sums of differentiable 2D Gaussians.

The public names stand in ``__init__.pyi``. Each name is imported when it is first used, because
Dr.Jit loads libLLVM while it is imported: importing this package starts no backend and sets no
Mitsuba variant.
"""

import lazy_loader

from .backend.libllvm import select_libllvm

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"

select_libllvm()  # before anything imports Dr.Jit, which looks for libLLVM once
