"""The options on which a result depends, as files keep them for runs that go on."""

from __future__ import annotations

import json

from ..backend.types import Record

Settings = Record


def to_json(settings: Settings) -> Settings:
    """Return settings as JSON holds them: it has no tuples, and no numbers of NumPy."""
    plain: Settings = json.loads(json.dumps(settings, default=lambda number: number.item()))
    return plain


def difference(known: Settings, settings: Settings) -> str:
    """Say which settings differ, as in "gaussians 500 instead of 900"; nothing if none does.

    Settings that one of both lacks, since another version wrote the file, do not differ.
    """
    both = [key for key in settings if key in known and known[key] != settings[key]]
    return ", ".join(f"{key} {known[key]} instead of {settings[key]}" for key in both)
