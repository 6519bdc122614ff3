"""Rows of many images: the figures of encoded sets, and a bound that is above some image."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import family, small_model


@pytest.fixture(scope="module")
def model():
    return small_model("llvm")


@pytest.mark.parametrize("options", [{}, {"colors": "projected", "target_psnr": 20}])
def test_rows_of_encoded_sets_have_the_psnrs_of_their_pictures(model, tmp_path, options):
    images = [*family(2, seed=3), family(1, 40, seed=4)[0][:30]]
    rows = model.encode_many(images, **options)
    kept = model.encode_many(images, tmp_path / "sets", **options)
    again = model.encode_many(images, tmp_path / "sets", **options)
    for place, image in enumerate(images):
        picture = eg.render(rows[place].result).numpy()
        for space in ("rgb", "ycbcr"):
            found = [vars(some[place])[f"psnr_{space}"] for some in (rows, kept, again)]
            assert found == [eg.psnr(picture, image, space)] * 3


def test_light_is_compared_as_srgb(model):
    [image] = family(1, seed=3)
    light = np.where(image > 0.04045, ((image + 0.055) / 1.055) ** 2.4, image / 12.92)
    [row] = model.encode_many([light], encoding="linear")
    assert row.psnr_rgb == pytest.approx(eg.psnr(eg.render(row.result).numpy(), image), abs=0.01)


def test_a_set_without_the_mean_is_no_picture(model):
    [row] = model.encode_many(family(1, seed=3), mean="dense")
    assert (row.status, row.psnr_rgb, row.psnr_ycbcr) == ("done", None, None)


def test_a_bound_above_an_image_leaves_it_one_gaussian_per_pixel():
    photo = eg.sample("chelsea")[100:106, 150:156]
    goal = eg.Goal(99, max_gaussians=100)
    [row] = eg.fit_many([photo], target_psnr=goal, iterations=2)
    assert (row.status, row.gaussians, row.stopped) == ("done", 36, "out of reach")
