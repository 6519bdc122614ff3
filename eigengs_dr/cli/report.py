"""Reports: all figures of a run as JSON, one stable key a figure."""

import json
import math
import os
from typing import Any

from ..storage.atomic import atomic_write


def write_report(path: str | os.PathLike[str], figures: dict[str, Any]) -> None:
    """Write figures as JSON, in one step.

    Parameters
    ----------
    path : str or os.PathLike
        The file to write.
    figures : dict
        Strings, numbers (NumPy's too), lists and dictionaries. Infinity and NaN, which JSON does
        not have, become null: the PSNR of two equal images is one.

    Raises
    ------
    OSError
        If the file cannot be written; one that was there is then unchanged.
    """
    text = json.dumps(plain(figures), indent=2, allow_nan=False)
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Turn a value into one that JSON has: NumPy to lists, infinity and NaN to None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
