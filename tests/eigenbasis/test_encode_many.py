"""Many images encoded by one model, as `encode` encodes one."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import family, small_model
from _helpers.sets import check_equal
from eigengs_dr.image.io import save_image


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
    images = [*family(3, seed=3), family(1, 40, seed=4)[0][:30]]
    rows = model.encode_many(images, **options)
    assert [row.status for row in rows] == ["done"] * 4
    for row, image in zip(rows, images, strict=True):
        alone, found = model.encode(image, **options), row.result
        assert (found.width, found.height) == (alone.width, alone.height)
        check_equal(found, alone.to_arrays())
        assert row.gaussians == len(alone) and row.seconds > 0


def test_light_is_encoded_as_srgb(backend, tmp_path):
    model = small_model(backend)
    image = family(1, seed=3)[0]
    save_image(tmp_path / "a.pfm", image, encoding="srgb")
    [row] = model.encode_many([tmp_path / "a.pfm"])
    [alone] = model.encode_many([image])
    a, b = (r.result.to_arrays()["color"] for r in (row, alone))
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_sets_of_a_model_of_other_weights_are_no_results(backend, tmp_path):
    model = small_model(backend)
    save_image(tmp_path / "a.png", family(1, seed=3)[0])
    model.encode_many(tmp_path, tmp_path / "sets", colors="projected")
    other = replace(model, weights=tuple(w * 2 for w in model.weights))
    with pytest.raises(ValueError, match="holds results with model "):
        other.encode_many(tmp_path, tmp_path / "sets", colors="projected")


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


def test_options_are_checked_first(backend, tmp_path):
    model = small_model(backend)
    with pytest.raises(ValueError, match="colors 'best' is unknown"):
        model.encode_many(tmp_path, colors="best")
    with pytest.raises(ValueError, match="target_psnr chooses components"):
        model.encode_many(tmp_path, target_psnr=30)
