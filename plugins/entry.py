"""The module that Mitsuba 3.10 imports to find the plugins, once a variant is set."""

from . import register_plugins

register_plugins()
