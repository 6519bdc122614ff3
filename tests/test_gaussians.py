"""Sets of splats: arrays in and out, bounds, selection, files - also damaged and hostile ones."""

import doctest
import importlib
import io
import os
import pkgutil
import struct
import zipfile
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scenes import COUNT, SIZE, few, random_scene

import eigengs_dr
from eigengs_dr.backend.selection import select
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION, Gaussians, concatenate
from eigengs_dr.raster.render import render
from eigengs_dr.storage import npz as archive

NAMES = ("mean", "factor", "color", "background")
LOW, HIGH = 1 / (2 * max(SIZE)), 1 / MIN_DEVIATION
"""Bounds of the diagonal of a factor."""

MODULES = [m.name for m in pkgutil.iter_modules(eigengs_dr.__path__) if m.name != "plugins"]


def arrays_of(scene):
    return {name: getattr(scene, name) for name in NAMES}


def check_equal(gaussians, arrays):
    for name, found in gaussians.to_arrays().items():
        np.testing.assert_array_equal(found, np.asarray(arrays[name], found.dtype), err_msg=name)


# --- Arrays in and out -------------------------------------------------------------------------


@pytest.mark.parametrize("module", MODULES)
def test_examples_in_docstrings(module):
    found = doctest.testmod(importlib.import_module(f"eigengs_dr.{module}"))
    assert found.failed == 0


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7])
def test_arrays_come_back(backend, channels):
    scene = random_scene(channels=channels)
    gaussians = Gaussians.from_arrays(**arrays_of(scene), size=SIZE, space="data", backend=backend)
    check_equal(gaussians, arrays_of(scene))
    assert len(gaussians) == COUNT
    assert gaussians.channels == channels
    assert type(gaussians.mean) is select(backend).Array2f
    assert {v.dtype for v in gaussians.to_arrays().values()} == {np.dtype("f4")}


def test_what_is_left_out_of_from_arrays(backend):
    gaussians = Gaussians.from_arrays(
        [[4, 5]], [[1, 0, 1]], [[1, 2, 3]], size=(np.int64(8), np.int32(9)), backend=backend
    )
    assert gaussians.space == "ycbcr"
    assert not gaussians.to_arrays()["background"].any()
    assert (type(gaussians.width), gaussians.width, gaussians.height) == (int, 8, 9)


@pytest.mark.parametrize("count", [1, COUNT])
def test_from_arrays_copies(backend, count):
    """What the caller does to the arrays afterwards does not matter, however busy the device is."""
    expected = arrays_of(random_scene(count=count))
    arrays = {k: v.astype(np.float32) for k, v in expected.items()}
    Float = select(backend).Float
    busy = Float(0)
    for k in range(4):
        busy = busy + dr.sum(dr.sin(dr.arange(Float, 1 << 23) + k))
        dr.eval(busy)
    gaussians = Gaussians.from_arrays(**arrays, size=SIZE, space="data", backend=backend)
    for array in arrays.values():
        array[:] = 7
    check_equal(gaussians, expected)


def test_arrays_of_values_that_all_splats_share(backend):
    scene = random_scene()
    gaussians = replace(scene.on(backend), factor=select(backend).Array3f(0.5, 0.25, 0.75))
    factor = np.tile([0.5, 0.25, 0.75], (COUNT, 1))
    check_equal(gaussians, {**arrays_of(scene), "factor": factor})
    check_equal(gaussians[3:7], arrays_of(scene._replace(factor=factor).permuted(slice(3, 7))))


BAD = [
    ("mean", np.zeros((0, 2)), r"mean has shape \(0, 2\)"),
    ("mean", np.zeros(2), "mean has shape"),
    ("mean", np.zeros((COUNT, 3)), "mean has shape"),
    ("factor", np.ones((COUNT - 1, 3)), "factor has shape"),
    ("factor", np.ones((COUNT, 2)), "factor has shape"),
    ("color", np.ones(COUNT), "color has shape"),
    ("color", np.ones((COUNT + 1, 3)), "color has shape"),
    ("background", np.ones(2), "background has shape"),
    ("background", np.ones((1, 3)), "background has shape"),
    ("mean", np.full((COUNT, 2), np.nan), "mean holds values that are not finite"),
    ("factor", np.full((COUNT, 3), np.inf), "factor holds values that are not finite"),
    ("color", np.full((COUNT, 3), -np.inf), "color holds values that are not finite"),
    ("background", np.full(3, np.nan), "background holds values that are not finite"),
    ("factor", np.zeros((COUNT, 3)), "a or c <= 0"),
    ("factor", np.tile([1, 0, -1], (COUNT, 1)), "a or c <= 0"),
    ("factor", np.full((COUNT, 3), 1e-60), "a or c <= 0"),  # 0 in float32
    ("size", (0, 5), "size is"),
    ("size", (5, -1), "size is"),
    ("size", (5,), "size is"),
    ("size", (5, 1 << 17), "size is"),
    ("space", "hsv", "space is 'hsv'"),
    ("space", "a\nb", "space is"),
]


@pytest.mark.parametrize(("name", "value", "message"), BAD)
def test_arrays_that_make_no_set(name, value, message):
    good = {**arrays_of(random_scene()), "size": SIZE, "space": "data"}
    with pytest.raises(ValueError, match=message) as error:
        Gaussians.from_arrays(**{**good, name: value})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("space", "channels"), [("ycbcr", 1), ("ycbcr", 4), ("rgb", 2), ("linear", 5)]
)
def test_channels_that_a_space_has_not(space, channels):
    with pytest.raises(ValueError, match=f"space '{space}' has"):
        Gaussians.from_arrays(**arrays_of(random_scene(channels=channels)), size=SIZE, space=space)


def test_a_colour_that_is_a_number():
    with pytest.raises(ValueError, match="color has shape"):
        Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], 5.0, size=SIZE, space="data")


def test_no_channels():
    with pytest.raises(ValueError, match="color"):
        Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], [[]], size=SIZE, space="data")


def test_a_size_that_is_no_integer():
    with pytest.raises((ValueError, TypeError)):
        Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], [[1]], size=(8.75, 9), space="data")


# --- Selection and concatenation ---------------------------------------------------------------


@pytest.mark.parametrize(
    "index",
    [
        slice(None),
        slice(3, 9),
        slice(None, None, -2),
        slice(-4, None),
        5,
        -1,
        [7, 0, 0, -2],
        np.array([3, 1], np.int16),
        np.arange(COUNT) % 3 == 0,
        np.ones(COUNT, bool),
    ],
    ids=str,
)
def test_selection(backend, index):
    """As NumPy selects; the background stays."""
    scene = random_scene()
    kept = np.atleast_1d(np.arange(COUNT)[index])
    chosen = scene.on(backend)[index]
    assert len(chosen) == len(kept)
    check_equal(chosen, arrays_of(scene.permuted(kept)))
    assert (chosen.width, chosen.height, chosen.space) == (*SIZE, "data")


@pytest.mark.parametrize(
    "index", [COUNT, -COUNT - 1, [0, COUNT], np.ones(COUNT - 1, bool), "x", 0.5]
)
def test_selection_of_what_is_not_there(backend, index):
    with pytest.raises(IndexError):
        random_scene().on(backend)[index]


@pytest.mark.parametrize("index", [np.array([], int), slice(5, 5), np.zeros(COUNT, bool)], ids=str)
def test_selection_of_nothing(backend, index):
    with pytest.raises(ValueError, match="empty"):
        random_scene().on(backend)[index]


def test_concatenation(backend):
    """Splats one after the other, backgrounds added."""
    parts = [random_scene(seed, count) for seed, count in ((0, COUNT), (1, 3), (2, 1))]
    joined = concatenate([p.on(backend) for p in parts])
    expected = {name: np.concatenate([getattr(p, name) for p in parts]) for name in NAMES[:3]}
    background = 3 * parts[0].background.astype(np.float32)
    assert len(joined) == COUNT + 4
    found = joined.to_arrays()
    np.testing.assert_allclose(found.pop("background"), background, rtol=1e-6)
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name])


def test_concatenation_of_one(backend):
    gaussians = random_scene().on(backend)
    check_equal(concatenate([gaussians]), gaussians.to_arrays())


def test_concatenation_of_values_that_all_splats_share(backend):
    scene = random_scene()
    gaussians = replace(scene.on(backend), factor=select(backend).Array3f(0.5, 0.25, 0.75))
    joined = concatenate([gaussians, gaussians])
    np.testing.assert_array_equal(
        joined.to_arrays()["factor"], np.tile([0.5, 0.25, 0.75], (2 * COUNT, 1))
    )


def test_concatenation_of_nothing():
    with pytest.raises(ValueError, match="no sets"):
        concatenate([])


def test_concatenation_of_what_differs(backend):
    first = random_scene().on(backend)
    others = [
        random_scene(size=(9, 9)).on(backend),
        random_scene(channels=1).on(backend),
        replace(first, space="rgb"),
        random_scene().on(backend, 64),
    ]
    for other in others:
        with pytest.raises(ValueError, match="sets differ") as error:
            concatenate([first, other])
        assert "\n" not in str(error.value)


# --- Size and bounds ---------------------------------------------------------------------------


def test_scaled(backend):
    scene = random_scene()
    larger = scene.on(backend).scaled(44, 51)
    assert (larger.width, larger.height) == (44, 51)
    found = larger.to_arrays()
    np.testing.assert_allclose(found["mean"], scene.mean * [2, 3], rtol=1e-6)
    np.testing.assert_allclose(found["factor"], scene.factor / [2, 3, 3], rtol=1e-6)
    np.testing.assert_array_equal(found["color"], np.float32(scene.color))


def test_scaled_there_and_back(backend):
    scene = random_scene()
    back = scene.on(backend).scaled(7, 90).scaled(*SIZE)
    for name, value in back.to_arrays().items():
        np.testing.assert_allclose(value, getattr(scene, name), rtol=1e-6)


@pytest.mark.parametrize("size", [(0, 1), (1, 0), (-1, -1)])
def test_scaled_to_nothing(backend, size):
    with pytest.raises(ValueError, match="at least 1 pixel"):
        random_scene().on(backend).scaled(*size)


any_floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


def unbounded(backend, values):
    """A set with any numbers: values has shape (COUNT, 8)."""
    scene = random_scene()._replace(mean=values[:, :2], factor=values[:, 2:5], color=values[:, 5:])
    return scene.on(backend)


def check_bounds(arrays):
    mean, factor = arrays["mean"], arrays["factor"].astype(np.float64)
    assert ((mean >= 0) & (mean <= SIZE)).all()
    a, b, c = factor.T
    for diagonal in (a, c):
        assert ((diagonal >= LOW * (1 - 1e-6)) & (diagonal <= HIGH)).all()
    assert (np.abs(b) <= HIGH).all()
    assert np.isfinite(arrays["color"]).all()
    inverse = np.array([[a * a, a * b], [a * b, b * b + c * c]]).transpose(2, 0, 1)
    assert (np.linalg.det(inverse) > 0).all()


@few
@given(values=hnp.arrays(np.float32, (COUNT, 8), elements=any_floats))
def test_bounds_hold_after_any_step(backend, values):
    bounded = unbounded(backend, values).bounded()
    check_bounds(bounded.to_arrays())
    check_equal(bounded.bounded(), bounded.to_arrays())


def test_bounds_leave_alone_what_is_inside(backend):
    scene = random_scene()
    scene = scene._replace(mean=np.clip(scene.mean, 0, SIZE))
    check_equal(scene.on(backend).bounded(), arrays_of(scene))


def test_what_replaces_numbers_that_are_not_finite(backend):
    """A mean by the middle, a factor by its bound, a colour by 0."""
    for value in (np.nan, np.inf, -np.inf):
        found = unbounded(backend, np.full((COUNT, 8), value)).bounded().to_arrays()
        np.testing.assert_array_equal(found["mean"][0], [SIZE[0] / 2, SIZE[1] / 2])
        np.testing.assert_array_equal(found["factor"][0], [HIGH, 0, HIGH])
        assert not found["color"].any()


def test_bounded_background_is_finite(backend):
    scene = random_scene()._replace(background=np.array([np.nan, 0, np.inf]))
    assert np.isfinite(scene.on(backend).bounded().to_arrays()["background"]).all()


def test_bounds_of_the_smallest_image(backend):
    scene = random_scene(size=(1, 1))
    found = scene.on(backend).bounded().to_arrays()
    assert ((found["mean"] >= 0) & (found["mean"] <= 1)).all()
    assert found["factor"][:, [0, 2]].min() >= 0.5


# --- Files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
def test_files_come_back_bit_equal(backend, tmp_path, space):
    scene = random_scene()
    scene.on(backend, space=space).save(tmp_path / "x.npz")
    found = Gaussians.load(str(tmp_path / "x.npz"), backend)
    check_equal(found, arrays_of(scene))
    assert (found.width, found.height, found.space) == (*SIZE, space)
    assert os.listdir(tmp_path) == ["x.npz"]


@few
@given(
    values=hnp.arrays(
        np.float32, (3, 8), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)
    ),
    size=st.tuples(st.integers(1, 1 << 16), st.integers(1, 1 << 16)),
)
def test_any_numbers_come_back(tmp_path_factory, values, size):
    path = tmp_path_factory.mktemp("any") / "x.npz"
    factor = np.abs(values[:, 2:5]) + np.float32(1e-30)
    arrays = {"mean": values[:, :2], "factor": factor, "color": values[:, 5:]}
    Gaussians.from_arrays(**arrays, size=size, space="data").save(path)
    found = Gaussians.load(path)
    check_equal(found, {**arrays, "background": np.zeros(3)})
    assert (found.width, found.height) == size


def test_files_of_attached_and_of_shared_values(backend, tmp_path):
    gaussians = replace(random_scene().on(backend), factor=select(backend).Array3f(0.5, 0, 0.75))
    dr.enable_grad(gaussians.mean)
    gaussians.save(tmp_path / "x.npz")
    check_equal(Gaussians.load(tmp_path / "x.npz"), gaussians.to_arrays())


def test_files_of_double_precision(backend, tmp_path):
    random_scene().on(backend, 64).save(tmp_path / "x.npz")
    check_equal(Gaussians.load(tmp_path / "x.npz"), arrays_of(random_scene()))


def test_the_suffix_is_free(tmp_path):
    random_scene().on("llvm").save(tmp_path / "fit.bin")
    check_equal(Gaussians.load(tmp_path / "fit.bin"), arrays_of(random_scene()))


@pytest.mark.parametrize("failure", [OSError("disk full"), KeyboardInterrupt()])
def test_saving_that_fails_leaves_the_old_file(tmp_path, monkeypatch, failure):
    path = tmp_path / "x.npz"
    random_scene(0).on("llvm").save(path)
    before = path.read_bytes()

    def half(file, **arrays):
        file.write(b"PK half of a file")
        raise failure

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises(type(failure)):
        random_scene(1).on("llvm").save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["x.npz"]


def test_saving_where_nothing_can_be_saved(tmp_path):
    gaussians = random_scene().on("llvm")
    for path in (tmp_path / "missing" / "x.npz", tmp_path):
        with pytest.raises(OSError):
            gaussians.save(path)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("path", ["missing.npz", "."])
def test_loading_what_cannot_be_opened(tmp_path, path):
    with pytest.raises(OSError):
        Gaussians.load(tmp_path / path)


# --- Damaged and hostile files -----------------------------------------------------------------


def npy(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def npy_with_header(header, data=bytes(64)):
    """An array file with any text as its header."""
    text = (header + "\n").encode("latin1")
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def header(descr="'<f4'", order="False", shape="(8, 2)", more=""):
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, {more}}}"


def members(**changed):
    """Contents of a good file, some of them changed, or left out where None."""
    arrays = {k: np.float32(v) for k, v in arrays_of(random_scene()).items()}
    good = {
        "format": np.array("eigengs_dr.gaussians"),
        "version": np.array(1),
        **arrays,
        "size": np.array(SIZE),
        "space": np.array("data"),
    }
    contents = {**{k: npy(v) for k, v in good.items()}, **changed}
    contents = {k: npy(v) if isinstance(v, np.ndarray) else v for k, v in contents.items()}
    return {k: v for k, v in contents.items() if v is not None}


def zipped(contents, method=zipfile.ZIP_DEFLATED):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as target:
        for key, data in contents.items():
            target.writestr(f"{key}.npy", data)
    return file.getvalue()


def check_refused(path, content, words=""):
    """Loading says in one line which file it is and what is wrong."""
    path.write_bytes(content)
    with pytest.raises(ValueError) as error:
        Gaussians.load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert words in message
    assert len(message) < len(str(path)) + 300


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.npz"


def test_files_made_by_hand(path):
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED):
        path.write_bytes(zipped(members(mean=np.asfortranarray(random_scene().mean, "f4")), method))
        check_equal(Gaussians.load(path), arrays_of(random_scene()))


def test_files_cut_off_anywhere(path):
    content = zipped(members())
    for length in range(0, len(content), 7):
        check_refused(path, content[:length])


@pytest.mark.parametrize("size", [0, 1, 22, 1000, 100_000])
def test_files_of_random_bytes(path, size):
    check_refused(path, np.random.default_rng(size).bytes(size))


@pytest.mark.parametrize("start", [b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY\x01\x00"])
def test_files_that_start_well(path, start):
    check_refused(path, start + np.random.default_rng(0).bytes(500))


def test_a_single_array(path):
    check_refused(path, npy(np.zeros((3, 2))))


HOSTILE = {
    "another format": (members(format=np.array("other")), "format is 'other'"),
    "a format of two lines": (members(format=np.array("a\nb")), "format is"),
    "a long format": (members(format=np.array("x" * 65)), "format"),
    "a format that is no text": (members(format=np.array(1)), "'format'"),
    "newer": (members(version=np.array(2)), "version is 2"),
    "version 0": (members(version=np.array(0)), "version is 0"),
    "a version that is a float": (members(version=np.array(1.0)), "'version'"),
    "several versions": (members(version=np.array([1])), "'version'"),
    **{f"no {key}": (members(**{key: None}), f"'{key}' is missing") for key in members()},
    **{f"empty {key}": (members(**{key: b""}), "not a readable") for key in members()},
    "double precision": (members(mean=random_scene().mean), "'mean' is 2-dimensional float64"),
    "big endian": (members(mean=random_scene().mean.astype(">f4")), "'mean'"),
    "integers": (members(color=np.ones((COUNT, 3), int)), "'color'"),
    "objects": (members(mean=np.full((COUNT, 2), None)), "'mean' is 2-dimensional object"),
    "records": (members(mean=np.zeros((COUNT, 2), [("a", "f4")])), "'mean'"),
    "one dimension": (members(mean=np.zeros(COUNT, "f4")), "'mean' is 1-dimensional"),
    "no splats": (members(mean=np.zeros((0, 2), "f4")), "mean has shape (0, 2)"),
    "fewer factors": (members(factor=np.ones((COUNT - 1, 3), "f4")), "factor has shape"),
    "more colours": (members(color=np.ones((COUNT + 1, 3), "f4")), "color has shape"),
    "another background": (members(background=np.ones(4, "f4")), "background has shape"),
    "NaN": (members(mean=np.full((COUNT, 2), np.nan, "f4")), "mean holds"),
    "infinite": (members(color=np.full((COUNT, 3), np.inf, "f4")), "color holds"),
    "a = 0": (members(factor=np.zeros((COUNT, 3), "f4")), "a or c <= 0"),
    "a size of 0": (members(size=np.array([0, 1])), "size"),
    "a huge size": (members(size=np.array([1 << 40, 1])), "size"),
    "three sides": (members(size=np.array([1, 2, 3])), "size"),
    "another space": (members(space=np.array("hsv")), "space is 'hsv'"),
    "a space that is no text": (members(space=np.array(3)), "'space'"),
    "no unicode": (
        members(space=npy_with_header(header("'<U2'", shape="()"), b"\xff" * 8)),
        "space",
    ),
    "a giant shape": (
        members(mean=npy_with_header(header(shape=f"({1 << 40}, 2)"))),
        "'mean' claims",
    ),
    "a giant number": (
        members(mean=npy_with_header(header(shape=f"({10**30}, 2)"))),
        "'mean' claims",
    ),
    "more than there is": (members(mean=npy_with_header(header(shape="(9, 2)"))), "'mean'"),
    "a negative shape": (members(mean=npy_with_header(header(shape="(-1, 2)"))), ""),
    "negative shapes": (members(mean=npy_with_header(header(shape="(-4, -2)"))), ""),
    "no dtype": (members(mean=npy_with_header(header("'garbage'"))), "not a readable"),
    "no dictionary": (members(mean=npy_with_header("[1, 2]")), "not a readable"),
    "no header": (members(mean=npy_with_header("")), "not a readable"),
    "a header of zeros": (members(mean=npy_with_header("\0" * 9)), "not a readable"),
    "a header of more": (members(mean=npy_with_header(header(more="'x': 1"))), "not a readable"),
    "a long header": (members(mean=npy_with_header(" " * 20_000)), "not a readable"),
    "a version of .npy": (members(mean=b"\x93NUMPY\x09\x00" + bytes(64)), "not a readable"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(path, name):
    contents, words = HOSTILE[name]
    check_refused(path, zipped(contents), words)


LEAKS = {
    "MemoryError": header(shape="(" + "-" * 9000 + "1, 2)"),
    "TokenError": "(" * 9000,
    "TypeError": header(shape="(True, 2)"),
}


@pytest.mark.parametrize("leaks", LEAKS)
def test_headers_that_python_cannot_read(path, leaks):
    try:
        check_refused(path, zipped(members(mean=npy_with_header(LEAKS[leaks]))))
    except MemoryError as error:  # which pytest would take for its own
        raise AssertionError("MemoryError") from error


def test_files_with_a_damaged_byte_anywhere(path):
    """Refused in one line, or the byte did not matter."""
    content = zipped(members())
    for position in range(len(content)):
        damaged = bytearray(content)
        damaged[position] ^= (0x01, 0x40, 0xFF)[position % 3]
        path.write_bytes(damaged)
        try:
            found = Gaussians.load(path)
        except ValueError as error:
            assert str(error).startswith(f"{path}: ")
            assert "\n" not in str(error)
        else:
            check_equal(found, arrays_of(random_scene()))


@pytest.mark.parametrize("rows", [1 << 20, 1 << 27, 1 << 28])
def test_a_file_that_claims_gigabytes(path, rows):
    """The directory claims 4 GiB for every array, and a header 2 GiB: nothing is reserved."""
    content = bytearray(zipped(members(mean=npy_with_header(header(shape=f"({rows}, 2)")))))
    place = content.find(b"PK\x01\x02")
    while place >= 0:
        struct.pack_into("<I", content, place + 24, 0xFFFFFFFE)
        place = content.find(b"PK\x01\x02", place + 4)
    check_refused(path, bytes(content))


def test_archive_reads_what_it_wrote(tmp_path):
    layout = {"a": archive.Field("f4", 3), "b": archive.Field("i8", 0), "c": archive.Field("U", 0)}
    arrays = {
        "a": np.arange(24, dtype="f4").reshape(2, 3, 4),
        "b": np.array(-5),
        "c": np.array("été"),
    }
    archive.write(tmp_path / "x", "some.format", 3, arrays)
    for version in (3, 4):
        found = archive.read(tmp_path / "x", "some.format", version, layout)
        for key, value in arrays.items():
            np.testing.assert_array_equal(found[key], value)
    with pytest.raises(ValueError, match="version is 3, this package reads up to 2"):
        archive.read(tmp_path / "x", "some.format", 2, layout)


def test_sets_are_trees_of_arrays(backend):
    """Dr.Jit's own functions reach all parameters."""
    gaussians = random_scene().on(backend)
    dr.enable_grad(gaussians)
    assert all(dr.grad_enabled(getattr(gaussians, name)) for name in NAMES)
    dr.backward(dr.sum(dr.square(gaussians.color)) + dr.sum(gaussians.mean))
    gradient = dr.grad(gaussians)
    assert isinstance(gradient, Gaussians)
    np.testing.assert_allclose(gradient.color, 2 * gaussians.to_arrays()["color"].T, rtol=1e-6)
    assert not dr.grad_enabled(dr.detach(gaussians).mean)


def test_a_loaded_set_renders_the_same(backend, path):
    gaussians = random_scene().on(backend)
    gaussians.save(path)
    np.testing.assert_array_equal(render(Gaussians.load(path, backend)), render(gaussians))
