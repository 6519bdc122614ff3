"""Mitsuba plugins; `register_plugins` makes them known to the variant in use and to later ones."""

from .cone import pixel_angle
from .parameters import bound_parameters, properties_of
from .registration import register_plugins

__all__ = ["bound_parameters", "pixel_angle", "properties_of", "register_plugins"]
