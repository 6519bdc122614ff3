"""Textures in Mitsuba scenes: their visibility, and Gaussians for what the cameras resolve."""

from .. import plugins  # noqa: F401  without Mitsuba, its error says what to install
