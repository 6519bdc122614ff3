"""The options on which a result depends, as files store them for runs that are continued."""

from __future__ import annotations

import json

from ..backend.types import Record

Settings = Record


def to_json(settings: Settings) -> Settings:
    """Return settings as JSON stores them: without tuples and NumPy numbers."""
    plain: Settings = json.loads(json.dumps(settings, default=lambda number: number.item()))
    return plain


def difference(stored: Settings, settings: Settings) -> str:
    """Describe settings that differ, as in "gaussians 500 instead of 900"; empty if none does.

    Settings that only one of the two has, because another version wrote the file, are ignored.
    """
    changed = [key for key in settings if key in stored and stored[key] != settings[key]]
    return ", ".join(f"{key} {stored[key]} instead of {settings[key]}" for key in changed)
