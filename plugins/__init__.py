"""Mitsuba: texture, environment, `photo_loss`; the folder `plugins/` at the top.

`register_plugins` registers them with the current variant and later ones.
"""

from typing import TYPE_CHECKING

try:
    import mitsuba  # noqa: F401
except ImportError as error:
    raise ImportError(
        f"the plugins need Mitsuba ({error}): pip install 'mitsuba>=3.9,<3.10'"
    ) from error

from ..backend.messages import no_attribute
from .cone import follow, pixel_angle
from .parameters import (
    bake_environment,
    environment_of,
    gaussians_of,
    keep_in_bounds,
    material_of,
    texture_of,
)
from .photos import photo_loss
from .registration import register_plugins
from .sums import resident_bytes

__all__ = [
    "bake_environment",
    "environment_of",
    "follow",
    "gaussians_of",
    "keep_in_bounds",
    "material_of",
    "photo_loss",
    "pixel_angle",
    "register_plugins",
    "resident_bytes",
    "texture_of",
]

if not TYPE_CHECKING:  # checkers know the names without it

    def __getattr__(name):
        raise no_attribute(__name__, name, __all__)
