"""Packed files, also damaged and hostile ones."""

import math
import os
import struct
import zlib
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eigengs_dr as eg
from _helpers.errors import file_refused
from _helpers.packed import STEPS, few_groups, peak
from _helpers.sets import COUNT, few, random_scene, scenes
from eigengs_dr.codec import egs as packed
from eigengs_dr.codec.gaussian_model import MIN_RICH_COUNT
from eigengs_dr.codec.quantization import Steps, Symbols, quantize

FILES = Path(__file__).parent / "files"

# --- Files -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("version", "digest"), [(5, "707bbef3543e2775"), (6, "c1ec74c014406d83")])
def test_stored_files_keep_their_numbers(version, digest):
    """All probabilities are the same to the last bit, in every version and on every machine."""
    content = packed.read_egs(FILES / f"version{version}.egs")
    assert len(content.sections) == (1 if content.maps else 2)
    integers = np.column_stack(content.all_symbols()).astype("<i8")
    assert sha256(integers.tobytes()).hexdigest().startswith(digest)


def content(scene=None, space="data", sections=(COUNT,)):
    scene = scene or random_scene()
    symbols = quantize(scene._asdict(), STEPS)
    ends = np.cumsum(sections)
    parts = [symbols.select(slice(end - k, end)) for end, k in zip(ends, sections, strict=True)]
    background = scene.background.astype(np.float32)
    return packed.EgsContent(parts, STEPS, background, scene.size, space, psnr=37.5)


def rows_of(symbols):
    return sorted(map(tuple, np.column_stack(symbols).tolist()))


@few
@given(scenes(), st.sampled_from([(COUNT,), (1, COUNT - 1), (5, 9, COUNT - 14)]))
def test_files_come_back(tmp_path_factory, scene, sections):
    path = tmp_path_factory.mktemp("any") / "x.egs"
    before = content(scene, sections=sections)
    packed.write_egs(path, before)
    for count in (None, *range(1, len(sections) + 1)):
        found = packed.read_egs(path, count)
        assert len(found.sections) == (count or len(sections))
        for one, other in zip(found.sections, before.sections, strict=False):
            assert rows_of(one) == rows_of(other)
        assert found[1:2] + found[3:] == before[1:2] + before[3:]
        np.testing.assert_array_equal(found.background, before.background)
    assert os.listdir(path.parent) == ["x.egs"]


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


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("count", [1, 2, 9, 16, 17, 100, MIN_RICH_COUNT + 100])
def test_files_of_many_and_of_few_gaussians_come_back(path, count, channels):
    """They differ in what the model of the probabilities may use."""
    before = content(random_scene(0, count, (200, 200), channels), sections=(count,))
    packed.write_egs(path, before)
    assert rows_of(packed.read_egs(path).sections[0]) == rows_of(before.sections[0])


def test_reading_stops_after_the_sections_that_are_asked_for(path):
    before = content(sections=(5, 9, COUNT - 14))
    whole = packed.egs_bytes(before)
    first = len(packed.egs_bytes(before._replace(sections=before.sections[:1])))
    path.write_bytes(whole)
    assert len(eg.Gaussians.load(path, sections=2)) == 14
    path.write_bytes(whole[: first + 40])
    assert len(eg.Gaussians.load(path, sections=1)) == 5
    for wanted in (0, 4, 2, None):
        with pytest.raises(ValueError, match=r"x\.egs: .*(section|truncated)"):
            eg.Gaussians.load(path, sections=wanted)
    other = path.with_suffix(".npz")
    random_scene().on("llvm").save(other)
    with pytest.raises(ValueError, match=r"x\.npz: has no sections"):
        eg.Gaussians.load(other, sections=1)


@few_groups()
def test_the_cutoff_is_kept(path):
    gaussians = replace(random_scene().on("llvm", space="rgb"), cutoff=4.5)
    result = eg.pack(gaussians, path, max_psnr_drop=3.0)
    assert eg.Gaussians.load(path).cutoff == result.gaussians.cutoff == 4.5


# --- Damaged and hostile files -----------------------------------------------------------------


def check_refused(path, data, words=""):
    path.write_bytes(data)
    with file_refused(path, words):
        eg.Gaussians.load(path)


def test_files_cut_off_anywhere(path):
    whole = packed.egs_bytes(content(sections=(9, COUNT - 9)))
    for length in range(0, len(whole), 7):
        check_refused(path, whole[:length])
    check_refused(path, whole + b"\0", "data follow")


@few
@given(st.data())
def test_files_with_damaged_bytes(tmp_path_factory, data):
    """The checksums find every change."""
    path = tmp_path_factory.mktemp("any") / "x.egs"
    whole = bytearray(whole_file())
    for _ in range(40):
        damaged = whole.copy()
        damaged[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
        check_refused(path, bytes(damaged))


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


HOSTILE = {
    "nothing": (b"", "not a file of eigengs_dr"),
    "another magic": (header(magic=b"\x89EGT") + body(), "not a file of eigengs_dr"),
    "newer": (header(version=8) + body(), "8, but this package reads versions 5 to 7; upgrade"),
    "older": (header(version=3) + body(), "reads versions 5 to 7; pack the set"),
    "older, with maps": (header(version=4) + body(), "reads versions 5 to 7; pack the set"),
    "version 0": (header(version=0) + body(), "version is 0"),
    "another space": (header(space=9) + body(), "unknown values"),
    "no channels": (header(channels=0) + body(), "claims 0 channels"),
    "more channels": (header(channels=64) + hostile(), "weights are truncated"),
    "65 channels": (header(channels=65, space=3) + body(), "65 channels"),
    "YCbCr of four": (
        header(channels=4, space=0) + hostile(model=PLAIN + bytes(99)),
        "'ycbcr' has",
    ),
    "a large square": (header(levels=25) + body(), "unknown values"),
    "no sections": (header(sections=0), "claims 0 sections"),
    "many sections": (header(sections=65535) + body(), "claims 65535 sections"),
    "one section more": (header(sections=2) + body(), "truncated"),
    "a size of 0": (header(width=0) + body(), "size is"),
    "a huge size": (header(height=1 << 31) + body(), "size is"),
    "no step": (header(cell=0.0) + body(), "the steps are"),
    "a step that is no number": (header(color=math.nan) + body(), "the steps are"),
    "an infinite step": (header(cell=math.inf) + body(), "the steps are"),
    "no cutoff": (header(cutoff=0.0) + body(), "cutoff is"),
    "a cutoff that is no number": (header(cutoff=math.nan) + body(), "cutoff is"),
    "steps that overflow": (header(cell=3e38, color=3e38) + body(), "x.egs: "),
    "many splats": (header() + body(0xFFFFFFFF), "claims 4294967295 Gaussians"),
    "no splats": (header() + body(0), "claims 0 Gaussians"),
    "a long section": (header() + body(length=0xFFFFFFFF), "section 1 is truncated"),
    "an unknown first byte": (header() + hostile(first=0x7F), "first byte is unknown"),
    "an unknown distribution": (header() + hostile(model=b"\xff"), "an unknown distribution"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(path, name):
    check_refused(path, *HOSTILE[name])


@few
@given(st.binary(max_size=400), st.booleans())
def test_codes_of_any_bytes(tmp_path_factory, data, rich):
    """They give a set or an error, and no warning."""
    path = tmp_path_factory.mktemp("any") / "x.egs"
    for content in (data, PLAIN + data):
        path.write_bytes(header() + hostile(packed.RICH * rich, content))
        try:
            found = packed.read_egs(path)
        except ValueError:
            continue
        assert len(found.sections[0].cell) == COUNT


def test_a_file_of_few_bytes_for_each_gaussian_is_refused_before_it_is_decoded(path):
    """Gaussians that take no bits, in a section of a byte for each of them."""
    count = 2 << 20
    path.write_bytes(header() + body(count, (b"\0" + PLAIN).ljust(count, b"\0")))
    with file_refused(path, "takes 931 MB in memory"):
        eg.Gaussians.load(path)
    check_refused(path, header() + body(8 * count, bytes(count)), "claims 16777216 Gaussians")


def test_what_decoding_takes_is_what_the_bound_says(path):
    for channels in (1, 16):
        packed.write_egs(
            path, content(random_scene(0, 2000, (900, 900), channels), sections=(2000,))
        )
        packed.read_egs(path)  # which keeps tables
        bound = packed.DECODING + packed.DECODING_CHANNEL * channels
        assert 0.5 < peak(lambda: packed.read_egs(path)) / (2000 * bound) < 1.5
