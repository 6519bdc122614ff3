"""EigenGS for Dr.Jit and Mitsuba: images as sums of differentiable 2D Gaussians.

``__init__.pyi`` lists the public names. Python imports a name when it is first used: importing this
package neither loads Dr.Jit nor sets a Mitsuba variant.
"""

from __future__ import annotations

from .backend import interrupts

if interrupts.is_program():  # before the imports, which take half a second
    interrupts.end_at_signals()

import lazy_loader

from .backend import messages
from .backend.selection import import_drjit, select_libllvm
from .version import __version__ as __version__

# Dr.Jit looks for libLLVM once, while it is imported; lazy_loader imports it here if EAGER_IMPORT
# is set.
select_libllvm()

_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


WITHOUT_DRJIT = {"load_image", "psnr", "sample", "save_image"}
WITHOUT_DRJIT |= {"BackendError", "ClusterError", "ImageError", "Interrupted"}


def __getattr__(name: str) -> object:
    if name in __all__:
        if name not in WITHOUT_DRJIT:
            import_drjit()  # quietly, and with one line on what to install where that fails
        return _import_name(name)
    raise messages.no_attribute(__name__, name, __all__)
