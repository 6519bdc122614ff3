"""Mitsuba plugins; `register_plugins` makes them known to the variant in use and to later ones."""

import eigengs_dr  # noqa: F401  finds a libLLVM that works before Mitsuba imports Dr.Jit

try:
    import mitsuba  # noqa: F401
except ImportError as error:
    raise ImportError(
        f"the plugins need Mitsuba ({error}): pip install 'mitsuba==3.9.*'"
    ) from error

from .cone import pixel_angle
from .parameters import gaussians_of, keep_in_bounds, texture_of
from .registration import register_plugins

__all__ = ["gaussians_of", "keep_in_bounds", "pixel_angle", "register_plugins", "texture_of"]
