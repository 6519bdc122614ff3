"""Packed sets: whole numbers, planes, files - also damaged and hostile ones - and the search."""

import math
import os
import re
import struct
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scenes import COUNT, SIZE, family, few, random_scene, scenes

import eigengs_dr as eg
from eigengs_dr.cli import main as cli
from eigengs_dr.cli import pack as cli_pack
from eigengs_dr.codec import bit_allocation as packing
from eigengs_dr.codec import egs as packed
from eigengs_dr.codec import entropy as planes
from eigengs_dr.codec.hilbert_index import MAX_LEVELS, hilbert_decode, hilbert_encode
from eigengs_dr.codec.quantization import (
    MAX_SYMBOL,
    Steps,
    Symbols,
    _round_to_steps,
    factors_from_log_shapes,
    log_shapes,
    quantize,
)
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.raster.render import picture_of
from eigengs_dr.storage.npz import BadValue

STEPS = Steps(0.25, 0.125, 0.0625, 0.03125)
SPACES = [("ycbcr", 3), ("rgb", 1), ("rgb", 4), ("linear", 3), ("data", 2)]


# --- The curve ---------------------------------------------------------------------------------


@pytest.mark.parametrize("levels", [0, 1, 2, 5])
def test_the_curve_visits_every_point_by_single_steps(levels):
    side = 1 << levels
    points = np.indices((side, side)).reshape(2, -1).T
    places = hilbert_encode(points, levels)
    assert sorted(places) == list(range(side * side))
    path = points[np.argsort(places)]
    assert (np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()
    np.testing.assert_array_equal(hilbert_decode(places, levels), points)


@given(hnp.arrays(np.int64, (7, 2), elements=st.integers(0, (1 << MAX_LEVELS) - 1)))
def test_places_on_the_largest_curve_come_back(points):
    places = hilbert_encode(points, MAX_LEVELS)
    assert (places >> 2 * MAX_LEVELS == 0).all()
    np.testing.assert_array_equal(hilbert_decode(places, MAX_LEVELS), points)


# --- Planes of numbers -------------------------------------------------------------------------

NUMBERS = st.one_of(
    st.integers(-9, 9), st.integers(0, (1 << 48) - 1), st.integers(-MAX_SYMBOL, MAX_SYMBOL)
)


@given(hnp.arrays(np.int64, st.integers(1, 40), elements=NUMBERS), st.binary(max_size=4))
def test_planes_come_back_and_end_where_they_end(values, rest):
    found, left = planes.decode(memoryview(planes.encode(values) + rest), len(values))
    np.testing.assert_array_equal(found, values)
    assert bytes(left) == rest


def test_planes_come_close_to_their_entropy():
    values = np.random.default_rng(0).normal(0, 12, 5000).round().astype(np.int64)
    share = np.unique(values, return_counts=True)[1] / len(values)
    least = -len(values) * (share * np.log2(share)).sum() / 8
    assert least < len(planes.encode(values)) < 1.03 * least + 30


@given(st.binary(max_size=60), st.integers(1, 50))
def test_planes_of_any_bytes(data, count):
    for head in (b"", b"\x01\0\0", b"\x0a\x05\0"):
        try:
            values, _ = planes.decode(memoryview(head + data), count)
        except BadValue:
            continue
        assert values.shape == (count,)


def test_planes_cut_off_anywhere():
    _round_to_steps = planes.encode(np.array([3, 1 << 30, 5, 77777], np.int64))
    for length in range(len(_round_to_steps)):
        with pytest.raises(BadValue):
            planes.decode(memoryview(_round_to_steps[:length]), 4)


def test_planes_that_claim_much():
    bomb = zlib.compress(bytes(1 << 24), 9, -15)
    with pytest.raises(BadValue, match="does not hold 9"):
        planes.decode(memoryview(b"\x01\0\0" + bomb), 9)
    wide = zlib.compress(bytes([255] * 9), 9, -15)  # widths of 127 bits
    with pytest.raises(BadValue, match="more bits"):
        planes.decode(memoryview(b"\x01\0\0" + wide + bytes(999)), 9)


# --- Splats as whole numbers -------------------------------------------------------------------


@given(scenes())
def test_shapes_are_the_logarithms_of_matrices(scene):
    shape = log_shapes(scene.factor)
    np.testing.assert_allclose(factors_from_log_shapes(shape), scene.factor, rtol=1e-6, atol=1e-6)
    a, b, c = scene.factor.T
    inverse = np.stack([a * a, a * b, a * b, b * b + c * c], -1).reshape(-1, 2, 2)
    values, vectors = np.linalg.eigh(inverse)
    log = np.einsum("nij,nj,nkj->nik", vectors, 0.5 * np.log(values), vectors)
    s, u, v = shape.T
    expected = np.stack([s + u, v, v, s - u], -1).reshape(-1, 2, 2)
    np.testing.assert_allclose(log, expected, atol=1e-5)


def test_shapes_of_extreme_splats():
    factor = np.array([[1e-4, 0, 4], [4, 0, 1e-4], [1, 0, 1], [1e-30, 0, 1e-30], [4, -4, 1e-4]])
    np.testing.assert_allclose(
        factors_from_log_shapes(log_shapes(factor)), factor, rtol=1e-6, atol=1e-9
    )


@few
@given(scenes())
def test_rounding_moves_by_half_a_step(scene):
    shape = log_shapes(scene.factor)
    symbols = quantize(scene.mean, shape, scene.color, STEPS)
    found = packed.EgsContent([symbols], STEPS, np.zeros(3, np.float32), SIZE, "data").arrays()
    near = log_shapes(found["factor"])
    assert np.abs(found["mean"] - scene.mean).max() <= STEPS.mean / 2 + 1e-5
    assert np.abs(near - shape)[:, 0].max() <= STEPS.scale / 2 + 1e-5
    assert np.abs(near - shape)[:, 1:].max() <= STEPS.stretch / 2 + 1e-5
    unit = np.exp(near[:, :1]) * STEPS.color
    assert (np.abs(found["color"] - scene.color) <= unit / 2 + 1e-5).all()


def test_numbers_beyond_the_largest_are_refused():
    with pytest.raises(ValueError, match="a mean is 8388608 steps or more"):
        quantize(np.full((1, 2), 1e9), np.zeros((1, 3)), np.zeros((1, 3)), STEPS)
    ends = np.array([[-MAX_SYMBOL + 1.0], [MAX_SYMBOL - 1.0]])
    assert int(np.ptp(_round_to_steps("mean", ends, 1.0))).bit_length() == MAX_LEVELS
    with pytest.raises(ValueError, match="a mean is"):
        _round_to_steps("mean", ends + 1, 1.0)


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


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.egs"


def test_files_cut_off_anywhere(path):
    _round_to_steps = packed.to_bytes(content(sections=(9, COUNT - 9)))
    for length in range(0, len(_round_to_steps), 3):
        check_refused(path, _round_to_steps[:length])
    check_refused(path, _round_to_steps + b"\0", "something follows")


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
    "newer": (header(version=2) + body(), "version is 2"),
    "version 0": (header(version=0) + body(), "version is 0"),
    "another space": (header(space=9) + body(), "not known"),
    "no channels": (header(channels=0) + body(), "claims 0 channels"),
    "more channels": (header(channels=64) + body(), "does not begin as one"),
    "65 channels": (
        header(channels=65, space=3) + body(data=ways() + 62 * ZEROS),
        "65 channels",
    ),
    "YCbCr of four": (
        header(channels=4, space=0) + body(data=ways() + ZEROS),
        "'ycbcr' has",
    ),
    "a large square": (header(levels=25) + body(), "not known"),
    "no sections": (header(sections=0), "claims 0 sections"),
    "many sections": (header(sections=65535) + body(), "claims 65535 sections"),
    "one section more": (header(sections=2) + body(), "cut off"),
    "a size of 0": (header(width=0) + body(), "size is"),
    "a huge size": (header(height=1 << 31) + body(), "size is"),
    "no step": (header(mean=0.0) + body(), "the steps are"),
    "a step that is no number": (header(scale=math.nan) + body(), "the steps are"),
    "an infinite step": (header(stretch=math.inf) + body(), "the steps are"),
    "steps that overflow": (header(scale=3e38, color=3e38) + body(), "x.egs: "),
    "many splats": (header() + body(0xFFFFFFFF), "claims 4294967295 splats"),
    "no splats": (header() + body(0), "claims 0 splats"),
    "a splat more": (header() + body(COUNT + 1), "does not hold 25"),
    "a long section": (header() + body(length=0xFFFFFFFF), "section 1 is cut off"),
    "a plane more": (header() + body(data=ways() + b"\0"), "follows the last plane"),
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


def test_low_bits_take_no_more_memory_than_numbers():
    """Of numbers of 47 bits each, where a number a bit would be forty times as much."""
    values = np.random.default_rng(0).integers(1 << 46, 1 << 47, 1 << 16)
    coded = memoryview(planes.encode(values))
    assert peak(lambda: planes.decode(coded, len(values))) < 12 * values.nbytes


def test_splats_are_bounded(path, monkeypatch):
    """As those of other files are: by the numbers in the widest array."""
    monkeypatch.setattr(packed, "MAX_ENTRIES", 3 * COUNT)
    path.write_bytes(header() + body())
    assert len(eg.Gaussians.load(path)) == COUNT
    monkeypatch.setattr(packed, "MAX_ENTRIES", 3 * COUNT - 1)
    check_refused(path, header() + body(), "more than may be read")


def peak(work):
    """Most bytes that Python and NumPy hold at once, beside what they held before."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


# --- Packing -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted():
    """A fit of 100 splats, and its image."""
    image = family(1, side=32, seed=5)[0]
    return eg.fit(image, 100, iterations=60, backend="llvm").gaussians, image


def decibels(gaussians, image):
    return eg.psnr(picture_of(gaussians), image, "ycbcr")


@pytest.fixture(scope="module")
def receipts(fitted, tmp_path_factory):
    """Receipts and files of two budgets."""
    folder = tmp_path_factory.mktemp("packed")
    files = {budget: folder / f"{budget}.egs" for budget in (0.5, 2.0)}
    return {b: (eg.pack(fitted[0], file, fitted[1], b), file) for b, file in files.items()}


@pytest.mark.parametrize("budget", [0.5, 2.0])
def test_the_budget_holds_and_is_used(fitted, receipts, budget):
    gaussians, image = fitted
    receipt, file = receipts[budget]
    found = eg.Gaussians.load(file)
    lost = decibels(gaussians, image) - decibels(found, image)
    assert lost == pytest.approx(receipt.psnr_drop, abs=1e-3)
    assert 0.7 * budget < lost <= budget + 1e-3
    assert receipt.psnr == pytest.approx(decibels(found, image), abs=1e-3)
    assert receipt.bytes == file.stat().st_size
    assert receipt.bits_per_pixel == 8 * receipt.bytes / 32**2
    np.testing.assert_array_equal(picture_of(found), picture_of(receipt.gaussians))


def test_files_are_small_and_equal_for_equal_arguments(fitted, receipts, path):
    gaussians, image = fitted
    (_, file), (_, smaller) = receipts.values()
    assert smaller.stat().st_size < 0.9 * file.stat().st_size
    eg.pack(gaussians, path, image)
    assert path.read_bytes() == file.read_bytes()
    gaussians.save(path)
    assert file.stat().st_size < path.stat().st_size / 4


def test_without_an_image_the_rendering_is_kept(fitted, path):
    gaussians, _ = fitted
    receipt = eg.pack(gaussians, path)
    error = np.mean(
        np.square(
            rgb_to_ycbcr(picture_of(eg.Gaussians.load(path))) - rgb_to_ycbcr(picture_of(gaussians))
        )
    )
    allowed = packing.MSE_WITHOUT_IMAGE * (10 ** (packing.BUDGET / 10) - 1)
    assert 0.5 * allowed < error <= 1.001 * allowed
    assert receipt.psnr == pytest.approx(-10 * np.log10(error), abs=1e-2)


def test_light_is_compared_as_it_is_shown(fitted, path):
    image = fitted[1] ** 3  # dark
    gaussians = eg.fit(image, 60, iterations=40, color="linear", backend="llvm").gaussians
    found = eg.pack(gaussians, path, image).gaussians
    before, after = (eg.psnr(picture_of(g), image, "data") for g in (gaussians, found))
    assert 0.7 * packing.BUDGET < before - after <= packing.BUDGET + 1e-3


def test_steps_of_equal_marginal_cost_give_smaller_files(fitted, receipts, path, monkeypatch):
    gaussians, image = fitted
    balanced, least = packing._water_fill, receipts[0.5][0].bytes

    def tilted(*arguments):
        steps = balanced(*arguments)
        return steps._replace(mean=steps.mean * 4, color=steps.color / 4)

    monkeypatch.setattr(packing, "_water_fill", tilted)
    assert eg.pack(gaussians, path, image).bytes > 1.05 * least


def test_a_perfect_fit_may_be_rounded(path):
    scene = random_scene(2)
    gaussians = replace(
        scene.on("llvm", space="rgb"), background=0.5 + 0 * scene.on("llvm").background
    )
    gaussians = replace(gaussians, color=0 * gaussians.color)
    receipt = eg.pack(gaussians, path, np.full((*SIZE[::-1], 3), 0.5, np.float32))
    assert receipt.psnr > 89
    assert receipt.psnr_drop <= packing.BUDGET + 1e-3


def test_sections_hold_the_splats_in_their_order(fitted, path):
    gaussians, image = fitted
    eg.pack(gaussians, path, image, sections=[10, 30, 60])
    found = packed.read(path)
    assert [len(section.mean) for section in found.sections] == [10, 30, 60]
    first = eg.Gaussians.load(path, sections=1).to_arrays()["mean"]
    before = gaussians.to_arrays()["mean"][:10]
    nearest = np.linalg.norm(first[:, None] - before, axis=2).min(axis=1)
    assert nearest.max() < 3


@pytest.mark.parametrize(("space", "channels"), SPACES)
def test_all_spaces_and_channels(backend, path, space, channels):
    gaussians = random_scene(3, channels=channels).on(backend, space=space)
    receipt = eg.pack(gaussians, path)
    assert 0 < receipt.psnr_drop <= packing.BUDGET + 1e-3
    found = eg.Gaussians.load(path, backend)
    assert (found.space, found.channels, len(found)) == (space, channels, COUNT)


def edge_cases():
    scene = random_scene(7)
    return {
        "one splat": scene.permuted([0]),
        "equal splats": scene.permuted([0] * COUNT),
        "at the corners": scene._replace(
            mean=np.array([[0, 0], [SIZE[0], 0], [0, SIZE[1]], SIZE] * (COUNT // 4), float)
        ),
        "outside": scene._replace(mean=scene.mean * 5 - 30),
        "black": scene._replace(color=0 * scene.color),
        "needles": scene._replace(factor=np.array([[0.001, 0.0, 4.0]] * COUNT)),
        "an image of one pixel": scene._replace(size=(1, 1)),
    }


@pytest.mark.parametrize("name", edge_cases())
def test_edge_cases(backend, path, name):
    gaussians = edge_cases()[name].on(backend)
    receipt = eg.pack(gaussians, path)
    error = np.square(picture_of(eg.Gaussians.load(path)) - picture_of(gaussians)).mean()
    assert error <= 1.001 * packing.MSE_WITHOUT_IMAGE * (10 ** (packing.BUDGET / 10) - 1)
    assert receipt.psnr_drop <= packing.BUDGET + 1e-3
    assert len(receipt.gaussians) == len(gaussians)


def test_mistakes_leave_the_old_file(fitted, path):
    gaussians, image = fitted
    path.write_text("old")
    for words, arguments in {
        "budget is 0": (None, 0),
        "no rounding is fine enough": (None, 1e-16),
        "budget is 10000.*at most 100 dB": (None, 1e4),
        "budget is nan": (None, math.nan),
        r"shape \(16, 32, 3\)": (image[:16],),
        "sections are": (None, 0.5, [50, 49]),
        "sections are ": (None, 0.5, [0, 100]),
    }.items():
        with pytest.raises(ValueError, match=words):
            eg.pack(gaussians, path, *arguments)
    far = replace(gaussians, mean=gaussians.mean + 1e9)
    with pytest.raises(ValueError, match=r"bounded\(\)"):
        eg.pack(far, path)
    assert path.read_text() == "old"


# --- The command line --------------------------------------------------------------------------


def command(*arguments):
    return CliRunner().invoke(cli.main, list(map(str, arguments)))


def test_commands_pack_and_read(fitted, tmp_path):
    gaussians, image = fitted
    gaussians.save(tmp_path / "x.npz")
    eg.save_image(tmp_path / "x.png", image)
    source, target = tmp_path / "x.npz", tmp_path / "x.egs"
    told = command("pack", source, "-o", target, "--image", tmp_path / "x.png", "--budget", 0.2)
    assert told.exit_code == 0, told.output
    size = (tmp_path / "x.egs").stat().st_size
    assert f"{size:,} bytes, {8 * size / 1024:.3f} bits a pixel" in told.output
    told = command("info", target).output
    for line in (rf"bytes +{size}", r"bpp +\d", r"mean_bits +\[\d+, \d+\]"):
        assert re.search(f"(?m)^{line}", told)
    assert "bpp" in command("info", tmp_path / "x.npz").output
    for suffix in ("npz", "egs"):
        command("render", tmp_path / f"x.{suffix}", "-o", tmp_path / f"{suffix}.png")
    one, other = (eg.load_image(tmp_path / f"{suffix}.png") for suffix in ("npz", "egs"))
    assert eg.psnr(one, other) > 30
    assert command("pack", tmp_path / "x.npz", "-o", tmp_path / "y.zip").exit_code == 2
    told = command("pack", source, "-o", target, "--image", tmp_path / "x.png", "--levels", 9)
    assert told.exit_code == 2 and "x.npz: levels is 9" in told.output


def test_the_command_knows_the_defaults():
    assert (packed.SUFFIX, packing.BUDGET) == (cli_pack.SUFFIX, cli_pack.BUDGET)
    assert "Examples" in command("pack", "--help").output
