"""Every kind of image file is written, read, and compared with its picture and with the manual."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from _helpers.image_kinds import KINDS, NEEDS_PILLOW_13
from eigengs_dr.image.io import ImageError, check_image, load_image
from eigengs_dr.many.windows import open_source

PAGE = Path(__file__).parents[2] / "docs/reference/image-files.md"

LOSSY = {"JPEG": 0.1, "YCbCr": 0.02, "AVIF": 0.1, "JPEG 2000": 0.02, "Radiance HDR": 0.01}
"""Largest mean error of a value."""


def verdict_of(kind, folder):
    """Write a file of a kind and read it; say what came of it, or fail if the pixels are wrong."""
    path = folder / f"a{kind.suffix}"
    expected = kind.write(path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            image = load_image(path)
        except ImageError as error:
            assert expected is None, error
            return "refused: " + str(error).removeprefix(f"{path}: ")
    assert expected is not None
    expected = np.broadcast_to(expected, (*expected.shape[:2], 3))
    assert image.shape == expected.shape
    tolerance = LOSSY.get(kind.what.split(",")[0], LOSSY.get(kind.format, 0.006))
    assert np.abs(image - expected).mean() < tolerance
    assert tolerance > 0.01 or np.abs(image - expected).max() < 0.01
    notes = [str(warning.message).removeprefix(f"{path}: ") for warning in caught]
    return "; ".join(["read", *notes])


def read_rows():
    """The rows of the table of the manual: formats, beginnings of names of kinds, and a verdict."""
    rows = re.findall(
        r"^\| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", PAGE.read_text(encoding="utf-8"), re.M
    )
    return [(formats, what.split("; "), verdict) for formats, what, verdict in rows[1:]]


def row_of(kind):
    """The row of a kind: that with the longest of the beginnings of its name."""
    return max(
        (len(part), row)
        for row, (formats, what, _) in enumerate(read_rows())
        for part in what
        if kind.format in formats and kind.what.startswith(part)
    )[1]


def marked(kinds):
    """Kinds as parameters, but for those that an older Pillow writes wrong."""
    return [
        pytest.param(kind, marks=NEEDS_PILLOW_13) if kind.what == "YCbCr, 8 bits" else kind
        for kind in kinds
    ]


@pytest.mark.parametrize("kind", marked(KINDS), ids=lambda kind: f"{kind.format}, {kind.what}")
def test_the_manual_says_what_becomes_of_a_file(kind, tmp_path):
    """It may leave out of a message what the file holds, but no reason and no advice."""
    verdict, (said, *parts) = verdict_of(kind, tmp_path), read_rows()[row_of(kind)][2].split("; ")
    assert verdict.startswith(said) and (verdict == said) == (not parts)
    assert all(part in verdict for part in parts)


def test_every_row_of_the_manual_is_of_a_kind():
    assert {row_of(kind) for kind in KINDS} == set(range(len(read_rows())))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "kind", marked(kind for kind in KINDS if kind.format == "TIFF"), ids=lambda kind: kind.what
)
def test_a_window_of_a_large_file_shows_the_same(kind, tmp_path):
    path = tmp_path / "a.tif"
    if kind.write(path) is None:
        with pytest.raises(ImageError):
            open_source(path)
        return
    whole = check_image(path)
    source = open_source(path)
    assert (source.height, source.width) == whole.shape[:2]
    found = source.window(slice(1, 5), slice(2, 6)).read()
    np.testing.assert_allclose(found, whole[1:5, 2:6], atol=1e-6)
