"""Mitsuba plugins; `register_plugins` makes them known to the variant in use and to later ones."""

from .cone import pixel_angle
from .parameters import gaussians_of, keep_in_bounds, texture_of
from .registration import register_plugins

__all__ = ["gaussians_of", "keep_in_bounds", "pixel_angle", "register_plugins", "texture_of"]
