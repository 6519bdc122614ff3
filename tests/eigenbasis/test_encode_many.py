"""Many images encoded by one model, as `encode` encodes one."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import family, small_model, splits
from eigengs_dr.eigenbasis import encode_many
from eigengs_dr.eigenbasis.encoder import Encoder
from eigengs_dr.image.io import save_image
from eigengs_dr.image.pixels import EncodedImage


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"mean": "dense"},
        {"colors": "projected"},
        {"colors": "projected", "mean": "dense"},
        {"colors": "projected", "target_psnr": 20},
    ],
)
def test_colours_are_those_of_encode(backend, options):
    model = small_model(backend)
    images = [*family(17, seed=3), family(1, 40, seed=4)[0][:30]]
    rows = model.encode_many(images, **options)
    assert [row.status for row in rows] == ["done"] * 18
    for row, image in zip(rows, images, strict=True):
        alone, together = model.encode(image, **options), row.result
        assert (together.width, together.height) == (alone.width, alone.height)
        a, b = alone.to_arrays(), together.to_arrays()
        for key in a:
            np.testing.assert_allclose(b[key], a[key], atol=2e-5, err_msg=key)
        assert row.gaussians == len(alone) and row.psnr_rgb is None and row.seconds > 0


def test_light_is_encoded_as_srgb(backend, tmp_path):
    model = small_model(backend)
    image = family(1, seed=3)[0]
    save_image(tmp_path / "a.pfm", image, encoding="srgb")
    [row] = model.encode_many([tmp_path / "a.pfm"])
    [alone] = model.encode_many([image])
    a, b = (r.result.to_arrays()["color"] for r in (row, alone))
    np.testing.assert_allclose(a, b, atol=1e-4)


@splits
def test_a_split_model(backend, split):
    model = small_model(backend, split)
    images = list(family(6, seed=3))
    for row, image in zip(model.encode_many(images), images, strict=True):
        expected = model.encode(image).to_arrays()["color"]
        np.testing.assert_allclose(row.result.to_arrays()["color"], expected, atol=2e-5)


def test_files_a_bad_one_and_resuming(backend, tmp_path):
    model = small_model(backend)
    for number, image in enumerate(family(3, seed=3)):
        save_image(tmp_path / f"{number}.png", image)
    (tmp_path / "1.png").write_text("no image")
    seen = []
    rows = model.encode_many(tmp_path, tmp_path / "sets", progress=lambda *row: seen.append(row))
    assert [row.status for row in rows] == ["done", "failed", "done"]
    assert [(done, total, row.name) for done, total, row in seen] == [
        (number + 1, 3, row.name) for number, row in enumerate(rows)
    ]
    assert len(seen[2][2].result) == rows[2].gaussians and rows[2].result is None
    assert len(eg.Gaussians.load(tmp_path / "sets" / "2.npz")) == rows[2].gaussians
    again = model.encode_many(tmp_path, tmp_path / "sets")
    assert [row.status for row in again] == ["skipped", "failed", "skipped"]


def test_one_failure_does_not_fail_its_group(backend, monkeypatch):
    model = small_model(backend)
    resized = Encoder.resized

    def no_memory_for_white(self, pixels):
        if pixels.mean() == 1:
            raise MemoryError
        return resized(self, pixels)

    monkeypatch.setattr(Encoder, "resized", no_memory_for_white)
    image = family(1, seed=3)[0]
    rows = model.encode_many([image, np.ones_like(image), image])
    assert [row.status for row in rows] == ["done", "failed", "done"]
    assert rows[1].error == "000001: MemoryError"


def test_groups_are_bounded():
    small, large = (EncodedImage(np.zeros((n, n, 3), np.float32), "srgb") for n in (10, 2000))
    assert encode_many._may_join([small] * 31, small)
    assert not encode_many._may_join([small] * 32, small)
    assert not encode_many._may_join([large], large)


def test_options_are_checked_first(backend, tmp_path):
    model = small_model(backend)
    with pytest.raises(ValueError, match="colors 'best' is unknown"):
        model.encode_many(tmp_path, colors="best")
    with pytest.raises(ValueError, match="target_psnr chooses components"):
        model.encode_many(tmp_path, target_psnr=30)
