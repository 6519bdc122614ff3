"""Reports: all figures of a run as JSON, with one stable key for each figure."""

import json
import math
import os
from typing import Any

from ..storage.atomic import atomic_write


def write_report(path: str | os.PathLike[str], figures: dict[str, Any]) -> None:
    """Write figures as JSON, all or nothing.

    Parameters
    ----------
    path : str or os.PathLike
        The file to write.
    figures : dict
        Strings, numbers (NumPy's too), lists and dictionaries. Infinity (the PSNR of two equal
        images) and NaN become null, because JSON has neither.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file is then unchanged.
    """
    text = json.dumps(plain(figures), indent=2, allow_nan=False)
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Convert a value to types of JSON: arrays to lists, infinity and NaN to None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
