"""The images of an eigenbasis: sources of every kind, bad ones, and interruptions."""

import threading

import numpy as np
import pytest

from _helpers.errors import one_line
from _helpers.low_rank import SIZE, assert_same, family
from eigengs_dr.eigenbasis.basis import Eigenbasis
from eigengs_dr.image.folder import image_files
from eigengs_dr.image.io import check_image, save_image


def test_every_source_gives_the_same_bits(tmp_path, blocks_of):
    images = np.rint(family(30).clip(0, 1) * 255).astype(np.uint8)
    for i, image in enumerate(images):
        save_image(tmp_path / f"{i:03}.png", image)
    blocks_of(8)
    first = Eigenbasis.from_images(images, SIZE, 5)
    files = image_files(tmp_path)
    for source in (
        tmp_path,
        str(tmp_path),
        [str(file) for file in files],
        iter(files),
        np.stack([check_image(image) for image in images]),
        list(images),
        iter(np.split(images, 10)),
        [*files[:5], images[5:6], images[6], images[7:]],
    ):
        assert_same(Eigenbasis.from_images(source, SIZE, 5), first)


def test_interruption_leaves_no_thread(tmp_path):
    for i, image in enumerate(family(30)):
        save_image(tmp_path / f"{i}.png", image)

    def interrupt(done, total, row):
        assert (total, row) == (30, {})
        if done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Eigenbasis.from_images(tmp_path, SIZE, 2, progress=interrupt)
    assert not [t for t in threading.enumerate() if t.name.startswith("decode")]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"components": -1}, "components is -1; expected no negative"),
        ({"components": (1, 2)}, r"components is \(1, 2\); expected a number, or three"),
        ({"components": 1.5}, "components is 1.5; expected"),
        ({"energy": 0}, "energy is 0.0; expected a share"),
        ({"energy": float("nan")}, "energy is nan; expected a share"),
        ({"size": (0, 3)}, "size is 0x3"),
        ({"space": "linear"}, "'linear' is unknown; use one of"),
    ],
)
def test_bad_arguments_are_refused_before_an_image_is_read(options, complaint):
    def never():
        raise AssertionError
        yield

    with pytest.raises(ValueError, match=complaint) as error:
        Eigenbasis.from_images(never(), **{"size": SIZE, **options})
    one_line(error)
