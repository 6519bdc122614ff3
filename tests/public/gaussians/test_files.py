"""Files of sets: they come back as they were; damaged, hostile and made by hand."""

import io
import os
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import eigengs_dr as eg
from _helpers.errors import check_refused, file_refused
from _helpers.files import members_of
from _helpers.materials import material
from _helpers.packed import peak
from _helpers.sets import COUNT, SIZE, arrays_of, check_equal, few, random_scene


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.npz"


# --- There and back -----------------------------------------------------------------------------


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
def test_files_come_back_bit_equal(backend, path, space):
    scene = random_scene()
    scene.on(backend, space=space).save(path)
    found = eg.Gaussians.load(str(path), backend)
    check_equal(found, arrays_of(scene))
    assert (found.width, found.height, found.space) == (*SIZE, space)
    assert os.listdir(path.parent) == ["x.npz"]


@few
@given(
    values=hnp.arrays(
        np.float32, (3, 8), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)
    ),
    size=st.tuples(st.integers(1, 1 << 16), st.integers(1, 1 << 16)),
)
def test_any_numbers_come_back(tmp_path_factory, values, size):
    path = tmp_path_factory.mktemp("any") / "x.bin"  # any suffix will do
    factor = np.abs(values[:, 2:5]) + np.float32(1e-30)
    arrays = {"mean": values[:, :2], "factor": factor, "color": np.clip(values[:, 5:], -1e17, 1e17)}
    eg.Gaussians.from_arrays(**arrays, size=size, space="data").save(path)
    found = eg.Gaussians.load(path)
    check_equal(found, {**arrays, "background": np.zeros(3)})
    assert (found.width, found.height) == size


@pytest.mark.parametrize("cutoff", [2.0, 3.0, 4.5])
def test_the_cutoff_is_kept(path, cutoff):
    """It decides the rendering, and travels with the set."""
    gaussians = replace(random_scene().on("llvm"), cutoff=cutoff)
    gaussians.save(path)
    found = eg.Gaussians.load(path)
    assert found.cutoff == cutoff
    shown, third = eg.render(found).numpy(), eg.render(found, cutoff=3).numpy()
    np.testing.assert_array_equal(shown, eg.render(gaussians).numpy())
    assert np.array_equal(shown, third) == (cutoff == 3)


def test_materials_come_back(path):
    m = material()
    m.save(path)
    again = eg.Gaussians.load(path)
    assert again.maps == m.maps
    check_equal(again, m.to_arrays())


def test_what_cannot_be_loaded_is_not_saved(path):
    """One check decides for reading and for writing."""
    good = random_scene().on("llvm")
    wide = good.scaled(70_000, 1)
    diverged = replace(good, mean=good.mean * np.nan)
    bright = replace(good, color=good.color * 1e38)
    for bad, words in ((wide, "size is"), (diverged, "not finite"), (bright, "color")):
        with file_refused(path, words):
            bad.save(path)
    assert not path.exists()


# --- Files made by hand -------------------------------------------------------------------------


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
        "version": np.array(2),
        **arrays,
        "size": np.array(SIZE),
        "space": np.array("data"),
        "cutoff": np.array(3.0),
        **changed,
    }
    contents = {k: npy(v) if isinstance(v, np.ndarray) else v for k, v in good.items()}
    return {k: v for k, v in contents.items() if v is not None}


def zipped(contents, method=zipfile.ZIP_DEFLATED):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as target:
        for key, data in contents.items():
            target.writestr(f"{key}.npy", data)
    return file.getvalue()


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED])
def test_files_made_by_hand(path, method):
    path.write_bytes(zipped(members(mean=np.asfortranarray(random_scene().mean, "f4")), method))
    check_equal(eg.Gaussians.load(path), arrays_of(random_scene()))


def test_what_is_no_file_of_a_set(path):
    for name, kind, words in (
        (path, FileNotFoundError, "no such file; check"),
        (path.parent, IsADirectoryError, "is a folder; give a file"),
    ):
        with pytest.raises(kind) as error:
            eg.Gaussians.load(name)
        assert str(error.value).startswith(f"{name}: {words}")
    content = zipped(members())
    check_refused(path, content[: len(content) // 2], "is truncated; copy or save it again")
    check_refused(path, b"a photo, or text", "not a file of eigengs_dr; give one that")


def test_files_cut_off_anywhere(path):
    content = zipped(members())
    for length in range(0, len(content), 7):
        check_refused(path, content[:length])


@pytest.mark.parametrize("start", [b"", b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY\x01\x00"])
@pytest.mark.parametrize("size", [0, 22, 100_000])
def test_files_of_random_bytes(path, start, size):
    check_refused(path, start + np.random.default_rng(size).bytes(size))


def test_files_with_a_damaged_byte_anywhere(path):
    """Refused in one line, or the byte did not matter; every fifth byte, to save time."""
    content = zipped(members())
    for position in range(0, len(content), 5):
        damaged = bytearray(content)
        damaged[position] ^= (0x01, 0x40, 0xFF)[position % 3]
        path.write_bytes(damaged)
        try:
            found = eg.Gaussians.load(path)
        except ValueError as error:
            assert str(error).startswith(f"{path}: ")
            assert "\n" not in str(error)
        else:
            check_equal(found, arrays_of(random_scene()))


# --- Hostile files ------------------------------------------------------------------------------

HOSTILE = {
    "another format": ({"format": np.array("other")}, "format is 'other'"),
    "a format of two lines": ({"format": np.array("a\nb")}, "format is"),
    "a format that is no text": ({"format": np.array(1)}, "'format'"),
    "newer": ({"version": np.array(3)}, "version is 3"),
    "a version that is a float": ({"version": np.array(1.0)}, "'version'"),
    **{f"no {key}": ({key: None}, f"'{key}' is missing") for key in members()},
    **{f"empty {key}": ({key: b""}, "not a readable") for key in members()},
    "double precision": ({"mean": random_scene().mean}, "'mean' is 2-dimensional float64"),
    "big endian": ({"mean": random_scene().mean.astype(">f4")}, "'mean'"),
    "objects": ({"mean": np.full((COUNT, 2), None)}, "'mean' is 2-dimensional object"),
    "one dimension": ({"mean": np.zeros(COUNT, "f4")}, "'mean' is 1-dimensional"),
    "NaN": ({"mean": np.full((COUNT, 2), np.nan, "f4")}, "mean holds"),
    "three sides": ({"size": np.array([1, 2, 3])}, "size"),
    "a space that is no text": ({"space": np.array(3)}, "'space'"),
    "no unicode": ({"space": npy_with_header(header("'<U2'", shape="()"), b"\xff" * 8)}, "space"),
    "a giant shape": ({"mean": npy_with_header(header(shape=f"({1 << 40}, 2)"))}, "'mean' claims"),
    "more than there is": ({"mean": npy_with_header(header(shape="(9, 2)"))}, "'mean'"),
    "a negative shape": ({"mean": npy_with_header(header(shape="(-1, 2)"))}, ""),
    "no dtype": ({"mean": npy_with_header(header("'garbage'"))}, "not a readable"),
    "a header of zeros": ({"mean": npy_with_header("\0" * 9)}, "not a readable"),
    "a long header": ({"mean": npy_with_header(" " * 20_000)}, "not a readable"),
    "a version of .npy": ({"mean": b"\x93NUMPY\x09\x00" + bytes(64)}, "not a readable"),
    **{f"cutoff {c}": ({"cutoff": np.array(c)}, "cutoff") for c in (0.0, -1.0, 12.5, np.nan)},
    # What Python's parser makes of these: a MemoryError, a TokenError, a TypeError.
    "deep signs": ({"mean": npy_with_header(header(shape="(" + "-" * 9000 + "1, 2)"))}, ""),
    "deep brackets": ({"mean": npy_with_header("(" * 9000)}, ""),
    "a truth value": ({"mean": npy_with_header(header(shape="(True, 2)"))}, ""),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(path, name):
    changes, words = HOSTILE[name]
    try:
        check_refused(path, zipped(members(**changes)), words)
    except MemoryError as error:  # which pytest would take for its own
        raise AssertionError("MemoryError") from error


@pytest.mark.parametrize("rows", [1 << 20, 1 << 27, 1 << 28])
def test_a_file_that_claims_gigabytes(path, rows):
    """The directory claims 4 GiB for every array, and a header 2 GiB: nothing is reserved."""
    content = bytearray(zipped(members(mean=npy_with_header(header(shape=f"({rows}, 2)")))))
    place = content.find(b"PK\x01\x02")
    while place >= 0:
        struct.pack_into("<I", content, place + 24, 0xFFFFFFFE)
        place = content.find(b"PK\x01\x02", place + 4)
    check_refused(path, bytes(content))


def test_a_small_file_of_large_arrays(path, monkeypatch):
    """Zeros shrink a thousand times."""
    monkeypatch.setenv("EIGENGS_DR_MAX_FILE_MB", "20")
    content = zipped(members(color=npy(np.zeros((1 << 20, 4), np.float32))))
    assert len(content) < 1 << 18
    check_refused(path, content, "takes 34 MB in memory, the limit is 21 MB; if you trust the f")


def test_a_header_of_gigabytes_is_not_read(path):
    """Headers of version 2 name their length by 32 bits, and blanks shrink a thousand times."""
    text = header(shape=f"({COUNT}, 2)").encode().ljust(1 << 26)
    content = zipped(members(mean=b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text))
    path.write_bytes(content)
    with file_refused(path, "'mean' is not a readable array"):
        assert peak(lambda: eg.Gaussians.load(path)) < 1 << 24


MATERIALS = {
    "a name": ({"names": np.array(["albedo", "../x", "normal"])}, "a name starts with a letter"),
    "lengths": ({"weights": np.ones(2)}, "differ in length"),
    "too many": ({"names": np.array(["a"] * 99)}, "claims shape"),
    "long": ({"names": np.array(["a" * 70, "b", "c"])}, "longer than 64 characters"),
    "missing": ({"names": None}, "key 'names' is missing"),
    "values": ({"color": np.full((24, 7), np.nan, np.float32)}, "color holds values that are not"),
}


@pytest.mark.parametrize("case", MATERIALS)
def test_hostile_files_of_materials(path, case):
    changes, words = MATERIALS[case]
    material().save(path)
    kind = {"format": np.array("eigengs_dr.material"), "version": np.array(1)}
    contents = {k: v for k, v in (kind | members_of(path) | changes).items() if v is not None}
    check_refused(path, zipped({k: npy(v) for k, v in contents.items()}), words)
