"""Mitsuba plugins, one file a plugin; imported as ``eigengs_dr.plugins``, never as ``plugins``."""
