"""Files of sets with other bytes, other arrays and extreme values, drawn from a seed.

What `info` describes can be loaded; what is loaded renders as numbers, and can be saved.
"""

import io
import struct
import zlib

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import run
from _helpers.families import small_model
from _helpers.sets import random_scene
from eigengs_dr.codec import egs

EXTREME = [0, 1, -1, 1e-45, -1e-38, 1e20, -1e20, 3e38, -3e38, np.nan, np.inf, -np.inf]
SIDES = [0, -1, 1, 65536, 65537, 1 << 31, -(1 << 62)]
TEXTS = ["", "ycbcr", "linear", "a\x1b[31m", "\n", "x" * 65]


def flip(random, data):
    """Other bytes."""
    changed = bytearray(data)
    for _ in range(random.integers(1, 4)):
        changed[random.integers(len(changed))] ^= int(random.integers(1, 256))
    return bytes(changed)


def cut(random, data):
    return data[: random.integers(len(data))]


def resealed(random, data):
    """Another number in the header of a packed set, or other bytes of its section, with checksums
    that are right."""
    layout, channels = egs._HEADER, 3
    end = layout.size + 4 * channels
    values, start = list(layout.unpack(data[: layout.size])), end + 4 + egs.HEAD.size
    place = random.integers(3, 13)
    values[place] = float(random.choice(EXTREME)) if place > 9 else int(random.integers(0, 4))
    head = layout.pack(*values) + data[layout.size : end]
    body = flip(random, data[start:]) if random.random() < 0.5 else data[start:]
    count, length, _ = egs.HEAD.unpack(data[end + 4 : start])
    section = egs.HEAD.pack(count, length, egs.section_check(count, body))
    head = head if random.random() < 0.5 else data[:end]
    return head + struct.pack("<I", zlib.crc32(head)) + section + body


def written(arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def swapped(random, data):
    arrays = dict(np.load(io.BytesIO(data)))
    one, other = random.choice(list(arrays), 2)
    return written(arrays | {one: arrays[other], other: arrays[one]})


def extreme(random, data):
    """Another value in an array, or an array of another length."""
    arrays = dict(np.load(io.BytesIO(data)))
    key = random.choice([k for k in arrays if k not in ("format", "version")])
    array = arrays[key].copy()
    values = {"f": EXTREME, "i": SIDES, "U": TEXTS}[array.dtype.kind]
    if array.ndim and random.random() < 0.3:
        array = array[: len(array) // 2]
    elif array.ndim and random.random() < 0.3:
        array[:] = random.choice(values)
    elif array.size:
        array.flat[random.integers(array.size)] = random.choice(values)
    return written(arrays | {key: array})


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Contents of files by their suffix and space."""
    folder = tmp_path_factory.mktemp("good")
    contents = []
    for space in ("ycbcr", "log", "normal"):
        random_scene(count=8, size=(16, 12)).on("llvm", space=space).save(folder / "x.npz")
        contents.append((".npz", (folder / "x.npz").read_bytes()))
    small_model("llvm").save(folder / "m.npz")
    contents.append((".npz", (folder / "m.npz").read_bytes()))
    packed = random_scene(count=8, size=(16, 12)).on("llvm", space="rgb")
    eg.pack(packed, folder / "x.egs", max_psnr_drop=60)
    return [*contents, (".egs", (folder / "x.egs").read_bytes())]


def check_file(path):
    """Check that the readers agree on a file; return whether it can be loaded."""
    described = run("info", path)
    assert described.exit_code in (0, 2), (described.exception, described.output)
    assert described.output.count("\n") == 1 or described.exit_code == 0
    assert "\x1b" not in described.output
    try:
        kind = eg.EigenGS if b"eigenvalues" in path.read_bytes() else eg.Gaussians
        loaded = kind.load(path)
    except ValueError as error:
        assert described.exit_code == 2, error
        return False
    g = getattr(loaded, "gaussians", loaded)
    assert np.isfinite(eg.render(g, width=16, height=12).numpy()).all()
    loaded.save(path.with_name("again.npz"))
    kind.load(path.with_name("again.npz"))
    return True


@pytest.mark.parametrize("change", [flip, cut, resealed, swapped, extreme])
def test_readers_agree_on_damaged_files(tmp_path, good, change):
    random = np.random.default_rng(1)
    files = [f for f in good if (f[0] == ".egs") == (change is resealed) or change in (flip, cut)]
    loaded = 0
    for k in range(60 if change is extreme else 25):
        suffix, data = files[k % len(files)]
        path = tmp_path / f"x{suffix}"
        path.write_bytes(change(random, data))
        loaded += check_file(path)
    assert loaded or change in (flip, cut, swapped)
