"""Files that lie, full disks, outputs that their owners protect, and files loaded twice."""

import json
import os
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run, succeeded
from _helpers.process import python_path, run_python
from _helpers.sets import check_equal
from _helpers.writers import OUTPUTS, refused, writers

QUICK = ("--gaussians", 4, "--iterations", 1, "--quiet")
TRAINED = ("--size", "16x16", "--components", 1, "--gaussians", 4)


def nested(depth, start="[", end="]"):
    return start * depth + end * depth


DEEP = {
    "lists": nested(100_000),
    "objects": nested(100_000, '{"a":', "}").replace(":}", ":1}"),
    "an option": f'{{"settings": {{"seed": {nested(800)}}}, "files": ["a"]}}',
    "an address": f'{{"address": {nested(800)}}}',
}


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for place in range(3):
        pixels = np.random.default_rng(place).random((16, 16, 3), np.float32)
        eg.save_image(folder / f"p{place}.png", pixels)
    return folder


@pytest.fixture(scope="module", params=DEEP)
def deep(request):
    return DEEP[request.param]


def test_a_checkpoint_of_deep_json_is_begun_anew_with_a_word(photos, tmp_path, deep):
    folder = tmp_path / "m.npz.checkpoint"
    folder.mkdir()
    (folder / "run.json").write_text(deep)
    result = succeeded(run("train", photos, "-o", tmp_path / "m.npz", "--quiet", *TRAINED))
    assert result.stderr.count("\n") == 1
    assert f"{folder}: run.json is unreadable; the interrupted run begins anew" in result.stderr
    assert os.listdir(tmp_path) == ["m.npz"]


def test_a_scheduler_file_of_deep_json_is_refused(photos, tmp_path, deep):
    (tmp_path / "s.json").write_text(deep)
    command = ("fit", photos, "-o", tmp_path / "out", "--cluster", tmp_path / "s.json")
    assert_refused(run(*command, *QUICK), tmp_path / "s.json", "is not the file of a scheduler")


def test_deep_json_is_no_value_of_an_integrator(tmp_path):
    pytest.importorskip("mitsuba")
    (tmp_path / "s.xml").write_text('<scene version="3.0.0"/>')
    value = f"path,max_depth={DEEP['lists']}"
    result = run("scene", tmp_path / "s.xml", "-o", tmp_path / "s.png", "--integrator", value)
    assert result.exit_code == 2 and isinstance(result.exception, SystemExit)


LIMITS = ("0", "300", "-1")


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A folder for each limit, and what writers said there."""
    if os.name == "nt":
        pytest.skip("Windows has no limit of the length of files")
    folder = tmp_path_factory.mktemp("full")
    code = f"""
import json
from pathlib import Path
from _helpers.writers import fill
fill(Path({str(folder)!r}) / "whole", 1 << 30)  # Dr.Jit cannot compile on a full disk
print(json.dumps([fill(Path({str(folder)!r}) / limit, int(limit)) for limit in {LIMITS}]))
"""
    process = run_python(code, PYTHONPATH=python_path())
    said = json.loads(process.stdout.splitlines()[-1])
    return {limit: (folder / limit, one) for limit, one in zip(LIMITS, said, strict=True)}


@pytest.mark.parametrize("limit", LIMITS)
def test_a_full_disk_is_told_by_the_name_of_the_output(full, limit):
    folder, said = full[limit]
    written = ["set.egs", "packed.egs"] if limit == "300" else []
    results = {"report.json": ["report.json.egs"], "sets": ["sets"]}
    for name, (error, left) in said.items():
        # A run by blocks keeps those that are done.
        names = [os.path.basename(path) for path in left if ".checkpoint" not in path]
        if name in written:
            assert (error, names) == (None, [name])
            continue
        assert str(folder / name) in error and "\n" not in error
        assert names in ([], results.get(name) if limit == "300" else [])
    assert set(said) == {*OUTPUTS, "sets"}


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("{}", "is a folder; choose another path"),
        ("/dev/null", "is a device; choose another path"),
        ("{}/missing/x.npz", "No such file|cannot create a file in .*missing"),
    ],
)
def test_what_cannot_be_written_is_named(tmp_path, path, words):
    path = path.format(tmp_path)
    with pytest.raises((OSError, ValueError), match=words) as error:
        eg.EigenGS.load("natural").save(path)
    assert path in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such modes")
def test_what_its_owner_made_read_only_is_refused_by_every_writer(tmp_path):
    for name, write in writers(tmp_path).items():
        out = tmp_path / name
        write(out)
        before = out.read_bytes()
        out.chmod(0o444)
        error = refused(write, out)
        assert error, name
        assert f"{out}: is read-only; allow writing (chmod u+w)" in error and "\n" not in error
        assert (out.read_bytes(), out.stat().st_mode & 0o777) == (before, 0o444)
        out.chmod(0o644)
        write(out)
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such modes")
def test_results_of_a_folder_that_are_read_only_stay(photos, tmp_path):
    few = {"gaussians": 4, "iterations": 1}
    eg.fit_many(photos, tmp_path, **few)
    result = tmp_path / "p1.npz"
    result.chmod(0o444)
    assert [row.status for row in eg.fit_many(photos, tmp_path, **few)] == ["skipped"] * 3
    before = result.read_bytes()
    rows = eg.fit_many(photos, tmp_path, overwrite=True, **few)
    assert [row.status for row in rows] == ["done", "failed", "done"]
    assert f"{result}: is read-only" in rows[1].error and result.read_bytes() == before
    assert not (tmp_path / ".lock").exists()


def test_what_is_changed_in_place_changes_no_later_load():
    photo, model = eg.sample("chelsea"), eg.EigenGS.load("natural")
    before = photo.copy(), [weights.copy() for weights in model.weights]
    color, encoded = model.gaussians.to_arrays()["color"], model.encode(photo).to_arrays()
    for array in (photo, model.mean_image, *model.weights):
        array[...] = 0
    model.gaussians.color *= 0
    again = eg.EigenGS.load("natural")
    np.testing.assert_array_equal(eg.sample("chelsea"), before[0])
    assert all(np.array_equal(a, b) for a, b in zip(again.weights, before[1], strict=True))
    np.testing.assert_array_equal(again.gaussians.to_arrays()["color"], color)
    check_equal(again.encode(eg.sample("chelsea")), encoded)


@contextmanager
def memory_of(limit):
    """Let this process use no more memory than a number of bytes."""
    resource = pytest.importorskip("resource", reason="Windows has no such limit")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


SMALL_PHOTO = np.full((8, 8, 3), 0.5, np.float32)
READERS = {
    "fit": lambda image: eg.fit(image, 10),
    "data": lambda image: eg.fit(image, 10, space="data"),
    "weight": lambda image: eg.fit(SMALL_PHOTO, 10, weight=image),
    "start": lambda image: eg.fit(image, start=eg.fit(SMALL_PHOTO, 4, iterations=0).gaussians),
    "family": lambda image: eg.Eigenbasis.from_images([image] * 3, (16, 16), 1),
    "encode": lambda image: eg.EigenGS.load("natural").encode(image),
    "save": lambda image: eg.save_image("never.exr", image),
    "blocks": lambda image: eg.fit_large(image),
}


class Recipe:
    """An array of another library, which computes its values only when they are asked for."""

    shape, dtype, ndim = (60_000, 60_000, 3), np.dtype(np.float32), 3

    def __array__(self, *arguments, **options):
        raise AssertionError("it is read")

    __getitem__ = __array__


@pytest.mark.parametrize("kind", ["broadcast", "recipe", "uint8"])
@pytest.mark.parametrize("reader", READERS)
def test_an_array_that_memory_cannot_hold_is_refused_unread(reader, kind, tmp_path):
    image = Recipe()
    if kind != "recipe":
        value = np.float32(0.5) if kind == "broadcast" else np.uint8(9)
        image = np.broadcast_to(value, Recipe.shape)
    with (
        memory_of(8 << 30),
        pytest.raises(ValueError, match=r"60000x60000 pixels.* memory|got Recipe") as told,
    ):
        READERS[reader](image)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("side", "told"), [(60_000, r"take about .* GB of memory"), (100_000, "sides must be from 1")]
)
def test_a_file_of_an_array_is_refused_by_its_header(tmp_path, side, told):
    file = tmp_path / "large.npy"
    head = {"descr": "|u1", "fortran_order": False, "shape": (side, side)}
    with file.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, head)
        stream.truncate(stream.tell() + side * side)  # without blocks on the disk
    with memory_of(8 << 30) if side < 65_536 else nullcontext():
        with pytest.raises(ValueError, match=rf"{file}: .*{told}"):
            eg.fit_large(file, tmp_path / "out.npz")
        assert_refused(run("fit", file, "-o", tmp_path / "o.npz", "--blocks", 1024), file)
    assert os.listdir(tmp_path) == ["large.npy"]
