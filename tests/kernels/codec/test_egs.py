"""Integers in packed files, and hostile files whose checksums are right."""

import math
import struct
import zlib
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.errors import check_refused
from _helpers.packed import peak
from _helpers.sets import COUNT, few, random_scene, scenes
from eigengs_dr.codec import egs as packed
from eigengs_dr.codec.gaussian_model import MIN_RICH_COUNT
from eigengs_dr.codec.quantization import Steps, Symbols, quantize

STEPS = Steps(0.03125, 0.25)


def content(scene=None, sections=(COUNT,)):
    scene = scene or random_scene()
    symbols = quantize(scene._asdict(), STEPS)
    ends = np.cumsum(sections)
    parts = [symbols.select(slice(end - k, end)) for end, k in zip(ends, sections, strict=True)]
    background = scene.background.astype(np.float32)
    return packed.EgsContent(parts, STEPS, background, scene.size, "data", 3.0, psnr=37.5)


def rows_of(symbols):
    return sorted(map(tuple, np.column_stack(symbols).tolist()))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.egs"


@few
@given(scenes(), st.sampled_from([(COUNT,), (1, COUNT - 1), (5, 9, COUNT - 14)]))
def test_integers_come_back(tmp_path_factory, scene, sections):
    path = tmp_path_factory.mktemp("any") / "x.egs"
    before = content(scene, sections)
    packed.write_egs(path, before)
    for count in (None, *range(1, len(sections) + 1)):
        found = packed.read_egs(path, count)
        assert len(found.sections) == (count or len(sections))
        for one, other in zip(found.sections, before.sections, strict=False):
            assert rows_of(one) == rows_of(other)
        assert found[1:2] + found[3:] == before[1:2] + before[3:]
        np.testing.assert_array_equal(found.background, before.background)


@pytest.mark.parametrize("spread", [1, 0])
def test_files_do_not_depend_on_the_order_of_splats(spread):
    scene = random_scene()
    scene = scene._replace(mean=scene.mean * spread)
    order = np.random.default_rng(1).permutation(COUNT)
    assert packed.egs_bytes(content(scene)) == packed.egs_bytes(content(scene.permuted(order)))


def test_equal_splats_take_few_bits():
    """Beside their places in cells and directions, which have no model: at least a byte."""
    same = Symbols(*(np.repeat(part[:1], 8000, axis=0) for part in content().sections[0]))
    assert 8000 < len(packed.egs_bytes(content()._replace(sections=[same]))) < 11000


@pytest.mark.parametrize("channels", [1, 5])
@pytest.mark.parametrize("count", [1, 2, 9, 16, 17, MIN_RICH_COUNT + 100])
def test_many_and_few_gaussians_come_back(path, count, channels):
    """They differ in what the model of the probabilities may use."""
    before = content(random_scene(0, count, (200, 200), channels), sections=(count,))
    packed.write_egs(path, before)
    assert rows_of(packed.read_egs(path).sections[0]) == rows_of(before.sections[0])


@pytest.mark.parametrize(("version", "digest"), [(5, "707bbef3543e2775"), (6, "c1ec74c014406d83")])
def test_stored_files_keep_their_numbers(version, digest):
    """All probabilities are the same to the last bit, in every version and on every machine."""
    stored = packed.read_egs(Path(__file__).parent / f"files/version{version}.egs")
    assert len(stored.sections) == (1 if stored.maps else 2)
    integers = np.column_stack(stored.all_symbols()).astype("<i8")
    assert sha256(integers.tobytes()).hexdigest().startswith(digest)


# --- Hostile files ---


@cache
def whole_file():
    return packed.egs_bytes(content())


def header(**changed):
    names = ["magic", "version", "space", "channels", "levels", "sections"]
    names += ["width", "height", "x", "y", *Steps._fields, "cutoff", "psnr"]
    values = packed._HEADER.unpack(whole_file()[: packed._HEADER.size])
    head = packed._HEADER.pack(*{**dict(zip(names, values, strict=True)), **changed}.values())
    channels = changed.get("channels", 3)
    head += np.zeros(channels, "<f4").tobytes()
    return head + struct.pack("<I", zlib.crc32(head))


def body(splats=COUNT, data=None, length=None):
    data = whole_file()[len(header()) + packed.HEAD.size :] if data is None else data
    check = packed.section_check(splats, data)
    return packed.HEAD.pack(splats, len(data) if length is None else length, check) + data


def hostile(first=0, model=b""):
    """The body of a section with a first byte, and weights or codes after it."""
    return body(data=(bytes([first]) + model).ljust(COUNT, b"\0"))


PLAIN = b"\0\0\0\0" * 5
"""Weights of 0 for three channels, the scale and the stretch."""

HEADERS = [
    ({"magic": b"\x89EGT"}, "not a file of eigengs_dr"),
    ({"version": 9}, "9, but this package reads 5, 6 and 8; upgrade"),
    ({"version": 4}, "reads 5, 6 and 8; pack the set"),
    ({"version": 0}, "version is 0"),
    ({"space": 9}, "unknown values"),
    ({"channels": 0}, "claims 0 channels"),
    ({"channels": 65, "space": 3}, "65 channels"),
    ({"levels": 25}, "unknown values"),
    ({"sections": 0}, "claims 0 sections"),
    ({"sections": 65535}, "claims 65535 sections"),
    ({"sections": 2}, "truncated"),
    ({"width": 0}, "size is"),
    ({"height": 1 << 31}, "size is"),
    ({"cell": 0.0}, "the steps are"),
    ({"color": math.nan}, "the steps are"),
    ({"cell": math.inf}, "the steps are"),
    ({"cutoff": 0.0}, "cutoff is"),
    ({"cutoff": math.nan}, "cutoff is"),
    ({"cell": 3e38, "color": 3e38}, "x.egs: "),
]


@pytest.mark.parametrize(("changed", "words"), HEADERS)
def test_hostile_headers(path, changed, words):
    check_refused(path, header(**changed) + body(), words)


@pytest.mark.parametrize(
    ("changed", "section", "words"),
    [
        ({"channels": 64}, hostile, "weights are truncated"),
        ({"channels": 4, "space": 0}, lambda: hostile(0, PLAIN + bytes(99)), "'ycbcr' has"),
        ({}, lambda: body(0xFFFFFFFF), "claims 4294967295 Gaussians"),
        ({}, lambda: body(0), "claims 0 Gaussians"),
        ({}, lambda: body(length=0xFFFFFFFF), "section 1 is truncated"),
        ({}, lambda: hostile(first=0x7F), "first byte is unknown"),
        ({}, lambda: hostile(model=b"\xff"), "an unknown distribution"),
        ({}, lambda: body(16 << 20, bytes(2 << 20)), "claims 16777216 Gaussians"),
        # Gaussians that take no bits, in a section of a byte for each of them.
        ({}, lambda: body(2 << 20, (b"\0" + PLAIN).ljust(2 << 20, b"\0")), "takes 931 MB in"),
    ],
)
def test_hostile_sections(path, changed, section, words):
    check_refused(path, header(**changed) + section(), words)


@few
@given(st.binary(max_size=400), st.booleans())
def test_codes_of_any_bytes(tmp_path_factory, data, rich):
    """They give a set or an error, and no warning."""
    path = tmp_path_factory.mktemp("any") / "x.egs"
    for codes in (data, PLAIN + data):
        path.write_bytes(header() + hostile(packed.RICH * rich, codes))
        try:
            found = packed.read_egs(path)
        except ValueError:
            continue
        assert len(found.sections[0].cell) == COUNT


def test_what_decoding_takes_is_what_the_bound_says(path):
    for channels in (1, 16):
        scene = random_scene(0, 2000, (900, 900), channels)
        packed.write_egs(path, content(scene, sections=(2000,)))
        packed.read_egs(path)  # which keeps tables
        bound = packed.DECODING + packed.DECODING_CHANNEL * channels
        assert 0.5 < peak(lambda: packed.read_egs(path)) / (2000 * bound) < 1.5
