"""JSON from files, which may come from elsewhere."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

MAX_DEPTH = 64
"""Levels of nesting of a value; files of the package have fewer than ten."""

MAX_BYTES = 1 << 26
"""Bytes of a file that holds one value, such as a scheduler's address."""


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text.

    Raises
    ------
    ValueError
        If the text is no JSON, or is nested deeper than `MAX_DEPTH`: whoever prints or compares
        such a value reaches Python's limit of recursion.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError(f"JSON is nested deeper than {MAX_DEPTH} levels") from None
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [
            child
            for parent in level
            if isinstance(parent, (list, dict))
            for child in (parent.values() if isinstance(parent, dict) else parent)
        ]
        if not level:
            return value
    raise ValueError(f"JSON is nested deeper than {MAX_DEPTH} levels")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Return the value of a JSON file.

    Raises
    ------
    ValueError
        As `parse_json`; also if the file has more than `MAX_BYTES`.
    OSError
        If the file cannot be read.
    """
    with Path(path).open("rb") as file:
        text = file.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise ValueError(f"JSON has more than {MAX_BYTES} bytes")
    return parse_json(text)
