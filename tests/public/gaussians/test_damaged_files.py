"""Files of sets that are damaged, hostile, or made by hand."""

import io
import struct
import zipfile

import numpy as np
import pytest

from _helpers.errors import file_refused
from _helpers.packed import peak
from _helpers.sets import COUNT, SIZE, arrays_of, check_equal, random_scene
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.storage.memory import SETTING


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
    with file_refused(path, words):
        Gaussians.load(path)


def test_files_made_by_hand(path):
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED):
        path.write_bytes(zipped(members(mean=np.asfortranarray(random_scene().mean, "f4")), method))
        check_equal(Gaussians.load(path), arrays_of(random_scene()))


def test_what_is_no_file_of_a_set(path):
    for name, kind, words in (
        (path, FileNotFoundError, "no such file; check"),
        (path.parent, IsADirectoryError, "is a folder; give a file"),
    ):
        with pytest.raises(kind) as error:
            Gaussians.load(name)
        assert str(error.value).startswith(f"{name}: {words}")
    content = zipped(members())
    check_refused(path, content[: len(content) // 2], "is truncated; copy or save it again")
    check_refused(path, b"a photo, or text", "not a file of eigengs_dr; give one that")


def test_files_cut_off_anywhere(path):
    content = zipped(members())
    for length in range(0, len(content), 7):
        check_refused(path, content[:length])


@pytest.mark.parametrize("start", [b"", b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY\x01\x00"])
@pytest.mark.parametrize("size", [0, 22, 500, 100_000])
def test_files_of_random_bytes(path, start, size):
    check_refused(path, start + np.random.default_rng(size).bytes(size))


HOSTILE = {
    "another format": (members(format=np.array("other")), "format is 'other'"),
    "a format of two lines": (members(format=np.array("a\nb")), "format is"),
    "a long format": (members(format=np.array("x" * 65)), "format"),
    "a format that is no text": (members(format=np.array(1)), "'format'"),
    "newer": (members(version=np.array(3)), "version is 3"),
    "older": (members(version=np.array(1)), "version is 1"),
    "version 0": (members(version=np.array(0)), "version is 0"),
    "a version that is a float": (members(version=np.array(1.0)), "'version'"),
    **{f"no {key}": (members(**{key: None}), f"'{key}' is missing") for key in members()},
    **{f"empty {key}": (members(**{key: b""}), "not a readable") for key in members()},
    "double precision": (members(mean=random_scene().mean), "'mean' is 2-dimensional float64"),
    "big endian": (members(mean=random_scene().mean.astype(">f4")), "'mean'"),
    "integers": (members(color=np.ones((COUNT, 3), int)), "'color'"),
    "objects": (members(mean=np.full((COUNT, 2), None)), "'mean' is 2-dimensional object"),
    "one dimension": (members(mean=np.zeros(COUNT, "f4")), "'mean' is 1-dimensional"),
    "NaN": (members(mean=np.full((COUNT, 2), np.nan, "f4")), "mean holds"),
    "three sides": (members(size=np.array([1, 2, 3])), "size"),
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
    "no dtype": (members(mean=npy_with_header(header("'garbage'"))), "not a readable"),
    "a header of zeros": (members(mean=npy_with_header("\0" * 9)), "not a readable"),
    "a header of more": (members(mean=npy_with_header(header(more="'x': 1"))), "not a readable"),
    "a long header": (members(mean=npy_with_header(" " * 20_000)), "not a readable"),
    "a version of .npy": (members(mean=b"\x93NUMPY\x09\x00" + bytes(64)), "not a readable"),
}


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 12.5, np.nan, np.inf])
def test_cutoffs_out_of_range_are_refused(path, cutoff):
    check_refused(path, zipped(members(cutoff=np.array(cutoff))), "cutoff")


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
    """Refused in one line, or the byte did not matter; every fifth byte, to save time."""
    content = zipped(members())
    for position in range(0, len(content), 5):
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


def test_a_small_file_of_large_arrays(path, monkeypatch):
    """Zeros shrink a thousand times."""
    monkeypatch.setenv(SETTING, "20")
    content = zipped(members(color=npy(np.zeros((1 << 20, 4), np.float32))))
    assert len(content) < 1 << 18
    check_refused(path, content, "takes 34 MB in memory, the limit is 21 MB; if you trust the f")


def test_a_header_of_gigabytes_is_not_read(path):
    """Headers of version 2 name their length by 32 bits, and blanks shrink a thousand times."""
    text = header(shape=f"({COUNT}, 2)").encode().ljust(1 << 26)
    content = zipped(members(mean=b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text))
    path.write_bytes(content)
    with file_refused(path, "'mean' is not a readable array"):
        assert peak(lambda: Gaussians.load(path)) < 1 << 24
