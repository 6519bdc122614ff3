"""EigenGS for Dr.Jit and Mitsuba: images as sums of differentiable 2D Gaussians.

``__init__.pyi`` lists the public names. Python imports a name when it is first used: importing this
package neither loads Dr.Jit nor sets a Mitsuba variant.
"""

from .backend import ending

if ending.is_program():  # before the imports, which take half a second
    ending.end_at_signals()

import sys
from importlib.util import spec_from_file_location
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import lazy_loader

from .backend.executor import EXECUTORS
from .backend.feedback import HTML
from .backend.libllvm import select_libllvm
from .storage.atomic import READERS, Reader

__version__ = "0.1.0"

# Dr.Jit looks for libLLVM once, while it is imported; lazy_loader imports it here if EAGER_IMPORT
# is set.
select_libllvm()


class _Checkout:
    """Finds the plugins of a checkout, which lie beside the package; an install has them inside.

    Python started in the root of a checkout takes the package from there, also beside an install.
    """

    FOLDER = Path(__file__).parents[1] / "plugins"

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        """Return how to import the plugins, and nothing else."""
        if name != f"{__name__}.plugins" or not (cls.FOLDER / "__init__.py").is_file():
            return None
        return spec_from_file_location(
            name, cls.FOLDER / "__init__.py", submodule_search_locations=[str(cls.FOLDER)]
        )


sys.meta_path.append(_Checkout)  # type: ignore[arg-type]


def _later(name: str) -> Any:
    """Return a function of the package, which is imported when it is called."""
    return lambda *args: resolve_name(f"{__name__}.{name}")(*args)


# Folders that know nothing of the codec, the viewer and Dask use them through these names.
READERS[b"\x89EGS"] = Reader(_later("codec.egs:read_set"), _later("codec.egs:maps_of"))
HTML[:] = [_later("viewer.notebook:to_html")]
EXECUTORS["distributed"] = _later("cluster.executor:ClusterExecutor")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
