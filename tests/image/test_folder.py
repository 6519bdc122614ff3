"""Streams of images in blocks; what is wrong is said once."""

import threading
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from _helpers.errors import refused
from _helpers.low_rank import planes
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.folder import (
    MAX_WAITING,
    MAX_WAITING_BYTES,
    image_files,
    list_images,
    read_ahead,
    read_blocks,
)
from eigengs_dr.image.io import ImageError, check_image, save_image
from eigengs_dr.image.pixels import check_size
from eigengs_dr.image.resize import center_crop
from eigengs_dr.image.space import to_planes

WIDTH, HEIGHT = SIZE = (6, 5)


def pictures(count, height=HEIGHT, width=WIDTH, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), np.uint8)


def write(folder, images):
    for i, image in enumerate(images):
        save_image(folder / f"{i:03}.png", image)
    return folder


def read(source, length=4, **options):
    return [block.copy() for block in read_blocks(source, SIZE, "ycbcr", length, **options)]


def decoders():
    return [thread for thread in threading.enumerate() if thread.name.startswith("decode")]


@pytest.mark.parametrize("space", ["rgb", "ycbcr"])
def test_planes_are_the_channels_row_by_row(space):
    image = check_image(pictures(1)[0])
    expected = image if space == "rgb" else rgb_to_ycbcr(image)
    result = to_planes(image, space)
    assert result.dtype == np.float32 and result.flags.c_contiguous
    np.testing.assert_allclose(result.reshape(3, HEIGHT, WIDTH), np.moveaxis(expected, 2, 0), 1e-6)


def test_light_in_files_is_encoded(tmp_path):
    [image] = pictures(1)
    save_image(tmp_path / "a.pfm", image / 255, encoding="srgb")
    save_image(tmp_path / "b.pfm", np.full((HEIGHT, WIDTH, 3), 5.0), encoding="linear")
    [found] = read(tmp_path, 2)
    [same] = read(image[None])
    assert len(found) == 2
    np.testing.assert_allclose(found[:1], same, atol=1e-4)


def test_a_source_may_overwrite_its_arrays():
    images = pictures(9)

    def reused():
        buffer = np.empty_like(images[:3])
        for part in np.split(images, 3):
            buffer[:] = part
            yield buffer

    np.testing.assert_array_equal(np.concatenate(read(reused(), length=2)), planes(images))


@given(count=st.integers(1, 12), length=st.integers(1, 15))
def test_blocks_cut_the_source_at_multiples_of_their_length(count, length):
    images = pictures(count)
    blocks = read(images, length=length)
    assert [len(b) for b in blocks] == [len(images[i::][:length]) for i in range(0, count, length)]
    np.testing.assert_array_equal(np.concatenate(blocks), planes(images))


def test_order_is_that_of_the_source_whatever_is_ready_first():
    second = threading.Event()

    def slow(number):
        if number == 0:
            assert second.wait(100)
        if number == 1:
            second.set()
        return number

    found = read_ahead(range(12), slow, lambda number: True, lambda number: 1)
    assert list(found) == list(range(12))


@pytest.mark.parametrize(("size", "waiting"), [(1, MAX_WAITING), (MAX_WAITING_BYTES // 5, 5)])
def test_few_images_wait_in_memory(size, waiting):
    started = []
    found = read_ahead(range(2000), started.append, lambda number: True, lambda image: size)
    for taken, _ in zip(range(500), found, strict=False):
        assert len(started) <= taken + 1 + waiting
    found.close()
    assert waiting < len(started)


def test_progress_counts_every_image(tmp_path):
    files = image_files(write(tmp_path, pictures(5)))
    files[1].write_bytes(b"")
    for source, total in ((tmp_path, 5), ([files[0], pictures(4)], 5), (iter(files), None)):
        calls = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(source, length=2, progress=lambda *call: calls.append(call))  # noqa: B023
        assert calls == [(done, total, {}) for done in range(1, 6)]


def test_other_sizes_are_cropped_and_said_once():
    images = [*pictures(3), *pictures(2, 9, 20), *pictures(1, 2, 3)]
    with pytest.warns(UserWarning) as caught:
        blocks = read(images, length=2)
    assert [str(w.message) for w in caught] == [
        "3 of 6 images were centre-cropped and resized to 6x5"
    ]
    expected = [center_crop(check_image(image), WIDTH, HEIGHT) for image in images]
    np.testing.assert_array_equal(np.concatenate(blocks), planes(expected))


def test_files_that_cannot_be_read_are_named_and_skipped(tmp_path):
    images = pictures(9)
    files = image_files(write(tmp_path, images))
    files[0].write_bytes(b"")
    files[1].write_bytes(b"no image")
    files[4].write_bytes(files[4].read_bytes()[:60])
    files[7].unlink()  # vanished since it was listed
    with pytest.warns(UserWarning) as caught:
        blocks = read(files, length=2)
    (message,) = (str(w.message) for w in caught)
    assert message.startswith("4 of 9 images were skipped: 000.png (the file is empty (0 bytes)),")
    assert "001.png (not an image that Pillow knows)" in message and message.endswith(", ...")
    assert "\n" not in message and str(tmp_path) not in message
    # Blocks keep their place in the source: this is what makes work resumable.
    assert [len(block) for block in blocks] == [0, 2, 1, 1, 1]
    np.testing.assert_array_equal(np.concatenate(blocks), planes(images[[2, 3, 5, 6, 8]]))


def test_a_folder_is_listed_once(tmp_path):
    images = pictures(6)
    write(tmp_path, images[:5])
    blocks = read_blocks(tmp_path, SIZE, "rgb", 2)
    save_image(tmp_path / "100.png", images[5])
    assert sum(len(block) for block in blocks) == 5


@pytest.mark.parametrize("source", [[], np.zeros((0, 5, 6, 3)), iter([]), ()])
def test_nothing_at_all_is_an_error(source):
    with refused(ImageError, "holds no images"):
        read(source)


def test_folders_that_hold_no_images(tmp_path):
    (tmp_path / "notes.txt").write_bytes(b"")
    cases = {"": "holds no images", "notes.txt": "is a file", "nowhere": "No such file"}
    for name, complaint in cases.items():
        with refused(ImageError, complaint):
            read_blocks(tmp_path / name, SIZE, "rgb", 2)


@pytest.mark.parametrize(
    ("source", "complaint"),
    [
        (np.zeros((5, 6)), r"got shape \(5, 6\), expected \(n, H, W, 3\)"),
        ([None], "got NoneType"),
        ([[1, 2]], "got list"),
        ([pictures(2), np.zeros((2, 5, 6, 4))], "image 2 of the source: .* drop alpha"),
        (np.full((1, 5, 6, 3), 255.0), "image 0 of the source: .* divide by 255"),
        (np.full((1, 5, 6, 3), np.nan), "image 0 of the source: 30 of 30 pixels are not finite"),
    ],
)
def test_arrays_that_are_no_images(source, complaint):
    with refused(ImageError, complaint):
        read(source)
    assert not decoders()


@pytest.mark.parametrize("size", [(0, 4), (4, -1), 4, (4,), (4, 4, 3), (4.5, 4), "ab", None])
def test_bad_sizes(size):
    with refused(ValueError, "size is"):
        read_blocks(pictures(1), size, "rgb", 1)
    assert check_size(np.array([3, 2])) == (3, 2)


def test_no_thread_outlives_the_stream(tmp_path):
    write(tmp_path, pictures(30))
    blocks = read_blocks(tmp_path, SIZE, "rgb", 2)
    next(blocks)
    assert decoders()
    blocks.close()
    assert not decoders()


def test_image_files_are_sorted_and_only_images(tmp_path):
    for name in ("b.JPG", "a.png", "notes.txt", ".hidden.png", "c.tif"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    assert image_files(tmp_path) == [tmp_path / name for name in ("a.png", "b.JPG", "c.tif")]
    assert image_files(str(tmp_path)) == image_files(tmp_path)


def test_images_in_subfolders_are_taken_or_named(tmp_path):
    for name in ("b.png", "a/1/c.jpg", "a/notes.txt", ".hidden/d.png", "z/.e/f.png", "z/g.PNG"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "loop").symlink_to(tmp_path)
    with pytest.warns(UserWarning, match=r"left out, such as a.1.c\.jpg; .*recursive=True") as said:
        assert image_files(tmp_path) == [tmp_path / "b.png"]
    assert len(said) == 1
    found = [tmp_path / name for name in ("a/1/c.jpg", "b.png", "z/g.PNG")]
    assert image_files(tmp_path, recursive=True) == found
    assert list_images(f"file://{tmp_path}", recursive=True)[0] == f"file://{found[0]}"
    with pytest.raises(ImageError, match=r"recursive is for a folder; write \*\* into"):
        list_images(f"{tmp_path}/*.png", recursive=True)
