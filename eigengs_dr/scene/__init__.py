"""Textures in Mitsuba scenes: their visibility, and Gaussians for what the cameras resolve."""
