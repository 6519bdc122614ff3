"""Every kind of file that the manual names is written, and read or refused as it says."""

import re
import warnings
from pathlib import Path

import numpy as np
import PIL
import pytest

import eigengs_dr as eg
from _helpers.image_kinds import KINDS

PAGE = Path(__file__).parents[3] / "docs/reference/image-files.md"
TABLE = re.findall(r"^\| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", PAGE.read_text("utf-8"), re.M)[1:]
ROWS = [(formats, content.split("; "), result) for formats, content, result in TABLE]
"""Formats, beginnings of names of kinds, and what becomes of them."""

LOSSY = {"JPEG": 0.1, "YCbCr": 0.02, "AVIF": 0.1, "JPEG 2000": 0.02, "Radiance HDR": 0.01}
"""Largest mean error of a value."""

OLD_PILLOW = int(PIL.__version__.split(".")[0]) < 13


def row_of(kind):
    """The row of a kind: that with the longest of the beginnings of its name."""
    return max(
        (len(part), row)
        for row, (formats, content, _) in enumerate(ROWS)
        for part in content
        if kind.format in formats and kind.what.startswith(part)
    )[1]


def result_of(kind, path):
    """Write a file of a kind and read it; say what came of it, or fail if the pixels are wrong."""
    expected = kind.write(path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            image = eg.load_image(path)
        except eg.ImageError as error:
            assert expected is None, error
            return "refused: " + str(error).removeprefix(f"{path}: ")
    assert expected is not None
    tolerance = LOSSY.get(kind.what, LOSSY.get(kind.format, 0.006))
    difference = np.abs(image - expected)
    assert difference.mean() < tolerance
    assert tolerance > 0.01 or difference.max() < 0.01
    notes = [str(warning.message).removeprefix(f"{path}: ") for warning in caught]
    return "; ".join(["read", *notes])


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.format}, {kind.what}")
def test_the_manual_says_what_becomes_of_a_file(kind, tmp_path):
    """It may leave out of a message what the file holds, but no reason and no advice."""
    if kind.what == "YCbCr" and OLD_PILLOW:
        pytest.skip("TIFF of YCbCr needs Pillow 13")
    result = result_of(kind, tmp_path / f"a{kind.suffix}")
    begin, *parts = ROWS[row_of(kind)][2].split("; ")
    assert result.startswith(begin) and (result == begin) == (not parts)
    assert all(part in result for part in parts)


def test_every_row_of_the_manual_is_of_a_kind():
    assert {row_of(kind) for kind in KINDS} == set(range(len(ROWS)))
