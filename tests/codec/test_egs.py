"""Packed files, also damaged and hostile ones."""

import math
import os
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eigengs_dr as eg
from _helpers.packed import SPACES, STEPS, peak
from _helpers.sets import COUNT, SIZE, few, random_scene, scenes
from eigengs_dr.codec import egs as packed
from eigengs_dr.codec import entropy as planes
from eigengs_dr.codec.quantization import Steps, Symbols, quantize
from eigengs_dr.gaussian.covariance import log_shapes

# --- Files -------------------------------------------------------------------------------------


def content(scene=None, space="data", sections=(COUNT,)):
    scene = scene or random_scene()
    symbols = quantize(scene.mean, log_shapes(scene.factor), scene.color, STEPS)
    ends = np.cumsum(sections)
    parts = [symbols.select(slice(end - k, end)) for end, k in zip(ends, sections, strict=True)]
    return packed.EgsContent(parts, STEPS, scene.background.astype(np.float32), scene.size, space)


def rows_of(symbols):
    return sorted(map(tuple, np.concatenate(symbols, axis=1).tolist()))


@few
@given(scenes(), st.sampled_from([(COUNT,), (1, COUNT - 1), (5, 9, COUNT - 14)]))
def test_files_come_back(tmp_path_factory, scene, sections):
    path = tmp_path_factory.mktemp("any") / "x.egs"
    before = content(scene, sections=sections)
    packed.write(path, packed.to_bytes(before))
    for count in (None, *range(1, len(sections) + 1)):
        found = packed.read(path, count)
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
    assert packed.to_bytes(content(scene)) == packed.to_bytes(content(scene.permuted(order)))


def test_equal_splats_take_a_bit_a_number():
    same = Symbols(*(np.tile(part[:1], (8000, 1)) for part in content().sections[0]))
    planes_of_it = len(packed.to_bytes(content()._replace(sections=[same])))
    assert 7 * 1000 < planes_of_it < 7 * 1000 + 300


@pytest.mark.parametrize(("space", "channels"), SPACES)
def test_sets_load_as_other_files_do(backend, tmp_path, space, channels):
    before = content(random_scene(channels=channels), space)
    packed.write(tmp_path / "x.bin", packed.to_bytes(before))
    found = eg.Gaussians.load(tmp_path / "x.bin", backend)
    assert (found.width, found.height, found.space, found.channels) == (*SIZE, space, channels)
    for name, values in found.to_arrays().items():
        expected = packed.read(tmp_path / "x.bin").arrays()[name]
        np.testing.assert_array_equal(values, expected)


def test_reading_stops_after_the_sections_that_are_asked_for(tmp_path):
    path, sections = tmp_path / "x.egs", (5, 9, COUNT - 14)
    _round_to_steps = packed.to_bytes(content(sections=sections))
    first = len(
        packed.to_bytes(content()._replace(sections=content(sections=sections).sections[:1]))
    )
    path.write_bytes(_round_to_steps)
    assert len(eg.Gaussians.load(path, sections=2)) == 14
    path.write_bytes(_round_to_steps[: first + 40])
    assert len(eg.Gaussians.load(path, sections=1)) == 5
    for wanted in (0, 4, 2, None):
        with pytest.raises(ValueError, match=r"x\.egs: .*(section|cut off)"):
            eg.Gaussians.load(path, sections=wanted)
    random_scene().on("llvm").save(tmp_path / "x.npz")
    with pytest.raises(ValueError, match=r"x\.npz: has no sections"):
        eg.Gaussians.load(tmp_path / "x.npz", sections=1)


# --- Damaged and hostile files -----------------------------------------------------------------


def check_refused(path, data, words=""):
    path.write_bytes(data)
    with pytest.raises(ValueError) as error:
        eg.Gaussians.load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert words in message


def test_files_cut_off_anywhere(path):
    _round_to_steps = packed.to_bytes(content(sections=(9, COUNT - 9)))
    for length in range(0, len(_round_to_steps), 3):
        check_refused(path, _round_to_steps[:length])
    check_refused(path, _round_to_steps + b"\0", "data follow")


@few
@given(st.data())
def test_files_with_damaged_bytes(tmp_path_factory, data):
    """The checksums find every change."""
    path = tmp_path_factory.mktemp("any") / "x.egs"
    _round_to_steps = bytearray(packed.to_bytes(content()))
    for _ in range(40):
        damaged = _round_to_steps.copy()
        damaged[data.draw(st.integers(0, len(_round_to_steps) - 1))] ^= data.draw(
            st.integers(1, 255)
        )
        check_refused(path, bytes(damaged))


def header(**changed):
    names = ["magic", "version", "space", "channels", "levels", "sections"]
    names += ["width", "height", "x", "y", *Steps._fields]
    values = packed._HEADER.unpack(packed.to_bytes(content())[: packed._HEADER.size])
    head = packed._HEADER.pack(*{**dict(zip(names, values, strict=True)), **changed}.values())
    channels = changed.get("channels", 3)
    head += np.zeros(channels, "<f4").tobytes()
    return head + struct.pack("<I", zlib.crc32(head))


def body(splats=COUNT, data=None, length=None):
    _round_to_steps = packed.to_bytes(content())
    data = _round_to_steps[len(header()) + packed._SECTION.size :] if data is None else data
    return (
        packed._SECTION.pack(splats, len(data) if length is None else length, zlib.crc32(data))
        + data
    )


ZEROS = planes.encode(np.zeros(COUNT, np.int64))


def ways(*steps):
    """A section whose first splats are so many steps apart on the curve."""
    plane = planes.encode(np.array([*steps, *[0] * (COUNT - len(steps))], np.int64))
    return plane + 6 * ZEROS


HOSTILE = {
    "nothing": (b"", "not a readable"),
    "another magic": (header(magic=b"\x89EGT") + body(), "not a readable"),
    "newer": (header(version=3) + body(), "version is 3"),
    "version 0": (header(version=0) + body(), "version is 0"),
    "another space": (header(space=9) + body(), "unknown values"),
    "no channels": (header(channels=0) + body(), "claims 0 channels"),
    "more channels": (header(channels=64) + body(), "invalid first byte"),
    "65 channels": (
        header(channels=65, space=3) + body(data=ways() + 62 * ZEROS),
        "65 channels",
    ),
    "YCbCr of four": (
        header(channels=4, space=0) + body(data=ways() + ZEROS),
        "'ycbcr' has",
    ),
    "a large square": (header(levels=25) + body(), "unknown values"),
    "no sections": (header(sections=0), "claims 0 sections"),
    "many sections": (header(sections=65535) + body(), "claims 65535 sections"),
    "one section more": (header(sections=2) + body(), "cut off"),
    "a size of 0": (header(width=0) + body(), "size is"),
    "a huge size": (header(height=1 << 31) + body(), "size is"),
    "no step": (header(mean=0.0) + body(), "the steps are"),
    "a step that is no number": (header(scale=math.nan) + body(), "the steps are"),
    "an infinite step": (header(stretch=math.inf) + body(), "the steps are"),
    "steps that overflow": (header(scale=3e38, color=3e38) + body(), "x.egs: "),
    "many splats": (header() + body(0xFFFFFFFF), "claims 4294967295 Gaussians"),
    "no splats": (header() + body(0), "claims 0 Gaussians"),
    "a splat more": (header() + body(COUNT + 1), "does not hold 25"),
    "a long section": (header() + body(length=0xFFFFFFFF), "section 1 is cut off"),
    "a plane more": (header() + body(data=ways() + b"\0"), "follow the last plane"),
    "back along the curve": (header() + body(data=ways(1, -1)), "leaves its square"),
    "beyond the curve": (header(levels=2) + body(data=ways(15, 1)), "leaves its square"),
    "round the numbers": (header() + body(data=ways(*[(1 << 48) - 1] * COUNT)), "leaves its"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(path, name):
    check_refused(path, *HOSTILE[name])


def test_files_made_by_hand(path):
    path.write_bytes(header(levels=2) + body(data=ways(15)))
    found = packed.read(path).sections[0]
    assert (np.ptp(found.mean, axis=0) == 0).all()
    assert len(eg.Gaussians.load(path)) == COUNT


def test_reading_reserves_no_more_than_the_file_is_long(path):
    """A section of a few bytes that inflates to gigabytes, whose checksum is right."""
    bomb = b"\x01\0\0" + zlib.compress(bytes(1 << 26), 9, -15)
    content = header() + body(8 * len(bomb) // 7, bomb)
    assert peak(lambda: check_refused(path, content, "does not hold")) < 1 << 22


def test_splats_are_bounded(path, monkeypatch):
    """As those of other files are: by the numbers in the widest array."""
    monkeypatch.setattr(packed, "MAX_ENTRIES", 3 * COUNT)
    path.write_bytes(header() + body())
    assert len(eg.Gaussians.load(path)) == COUNT
    monkeypatch.setattr(packed, "MAX_ENTRIES", 3 * COUNT - 1)
    check_refused(path, header() + body(), "but at most 23 more")


@pytest.mark.parametrize("cutoff", [3.0, 4.5])
def test_the_cutoff_is_kept(path, cutoff):
    """A set with the default cutoff makes a file of version 1, which older packages read."""
    gaussians = replace(random_scene().on("llvm", space="rgb"), cutoff=cutoff)
    result = eg.pack(gaussians, path, budget=3.0)
    assert path.read_bytes()[4] == (1 if cutoff == 3 else 2)
    assert eg.Gaussians.load(path).cutoff == result.gaussians.cutoff == cutoff
