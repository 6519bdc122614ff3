"""Training: from a folder to a model, whatever the images and the settings."""

import warnings

import numpy as np
import pytest

from _helpers.photos import SMALL, random_fields
from _helpers.trainings import checkpoint_of, settings
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.eigenbasis.options import TrainOptions
from eigengs_dr.eigenbasis.training import train
from eigengs_dr.image.io import ImageError, load_image
from eigengs_dr.image.metrics import psnr
from eigengs_dr.raster.render import render

FIGURES = {
    "seconds",
    "pca_seconds",
    "shape_seconds",
    "weight_seconds",
    "components",
    "gaussians",
}

MEASURED = ("psnr_pca", "psnr_init", "psnr_solved")


def test_end_to_end(folder, output):
    stages = []
    trained = train(
        folder, output, settings(), progress=lambda stage, *counts: stages.append((stage, *counts))
    )
    figures = trained.figures
    assert {*FIGURES, *MEASURED} <= set(figures)
    assert (figures["images"], figures["components"], figures["gaussians"]) == (22, [6] * 3, 60)
    # Components that are as smooth as these are rendered well by 60 splats.
    assert figures["psnr_init"] == pytest.approx(figures["psnr_pca"], abs=0.5)
    assert figures["psnr_solved"] > figures["psnr_pca"] + 5
    assert 0 < figures["pca_seconds"] <= figures["seconds"]
    assert ("components", 22, 22) in stages
    assert [stage for stage, *_ in stages[-3:]] == ["weights", "measure", "measure"]
    assert all(0 <= done <= total for _, done, total in stages)
    assert not checkpoint_of(output).exists()


def test_the_file_encodes_as_what_was_trained(folder, output):
    trained = train(folder, output, settings())
    model = EigenGS.load(output)
    image = load_image(folder / "009.png")
    for colors in ("exact", "projected"):
        pictures = [render(m.encode(image, colors)).numpy() for m in (model, trained.model)]
        assert psnr(*pictures, "ycbcr") > 50


@pytest.mark.parametrize(
    "changed",
    [
        {"preset": "eigengs", "iterations": 3},
        {"frequency_aware": True},
        {"space": "rgb"},
        {"energy": 0.5},
        {"gaussians": 1024},
    ],
    ids=lambda changed: " ".join(changed),
)
def test_other_settings(folder, output, changed):
    figures = train(folder, output, settings(**changed)).figures
    assert figures["psnr_solved"] > figures["psnr_init"] > 15
    assert figures["frequency_aware"] == changed.get("frequency_aware", False)
    assert (figures["components"][0] < 6) == ("energy" in changed)
    EigenGS.load(output)


def test_a_model_that_cannot_be_written(folder, output, monkeypatch):
    def full(model, path):
        raise OSError("no space left")

    with monkeypatch.context() as patched:
        patched.setattr(EigenGS, "save", full)
        with pytest.raises(OSError, match="no space"):
            train(folder, output, settings())
    assert sorted(path.name for path in output.parent.iterdir()) == [
        "model.npz.checkpoint",
        "photos",
    ]
    assert train(folder, output, settings()).figures["resumed"]


def test_no_folder_to_write_into(folder, tmp_path):
    with pytest.raises(OSError, match="gone"):
        train(folder, tmp_path / "gone" / "model.npz", settings())


def test_unreadable_images_are_skipped(folder, output):
    for name in ("003.png", "009.png"):  # one to train on, one held out
        (folder / name).write_bytes(b"no picture")
    with pytest.warns(UserWarning) as notes:
        figures = train(folder, output, settings()).figures
    told = [str(note.message) for note in notes]
    assert "1 of 22 images were skipped: 003.png" in told[0]
    assert "1 of 2 images held out were skipped, as" in told[1]
    assert figures["images"] == 21
    assert figures["psnr_solved"] > 20


def test_nothing_but_unreadable_images(folder, output):
    for path in folder.iterdir():
        path.write_bytes(b"no picture")
    with pytest.raises(ImageError, match="none of 22 images"):
        train(folder, output, settings())
    assert list(output.parent.iterdir()) == [folder]


def test_too_few_images_to_hold_one_out(tmp_path, output):
    folder = random_fields(tmp_path / "few", 9)
    figures = train(folder, output, settings()).figures
    assert figures["images"] == 9
    assert not {*MEASURED} & set(figures)


def test_images_of_other_sizes(folder, output):
    with pytest.warns(UserWarning, match="resized to 20x12"):
        figures = train(folder, output, settings(size=(20, 12))).figures
    assert figures["psnr_solved"] > figures["psnr_init"] > 15
    assert EigenGS.load(output).mean_image.shape == (3, 12, 20)


@pytest.mark.parametrize(
    ("count", "channels", "preset"),
    [(12, 1, "default"), (12, 1, "eigengs"), (1, 3, "default")],
    ids=["grey", "grey eigengs", "single"],
)
def test_channels_in_which_nothing_varies(tmp_path, output, count, channels, preset):
    folder = random_fields(tmp_path / "flat", count, channels=channels)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a single image has no components, as is said
        train(folder, output, settings(preset=preset, iterations=3))
    assert EigenGS.load(output).components[1:] == (0, 0)


@pytest.mark.parametrize("count", [1, 4])
def test_fewer_splats_than_components(folder, output, count):
    assert train(folder, output, settings(gaussians=count)).figures["psnr_solved"] > 10


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"gaussians": 1025}, "gaussians is 1025; a basis of 32x32 takes 1 to 1024"),
        ({"gaussians": 0}, "gaussians is 0"),
        ({"iterations": -1}, "iterations is -1"),
        ({"seed": -1}, "seed is -1"),
        ({"preset": "none"}, "preset 'none'"),
        ({"preset": "eigengs", "iterations": 0}, "iterations is 0"),
        ({"frequency_aware": "maybe"}, "frequency_aware is 'maybe'"),
        ({"space": "lab"}, "space 'lab' is unknown; use one of ycbcr, rgb"),
        ({"size": (0, 1)}, "size is 0x1"),
        ({"components": -1}, "components is -1"),
        ({"components": (3, 4)}, "expected a number, or three"),
        ({"energy": 1.5}, "energy is 1.5"),
    ],
    ids=str,
)
def test_wrong_settings_leave_nothing(folder, output, changed, words):
    with pytest.raises(ValueError, match=words):
        train(folder, output, settings(**changed))
    assert list(output.parent.iterdir()) == [folder]


def test_wrong_numbers_are_refused_before_an_image_is_read(tmp_path, output):
    with pytest.raises(ValueError, match="gaussians is 1025"):
        train(tmp_path / "gone", output, settings(gaussians=1025))


def test_train_to_a_target(trained, tmp_path):
    folder, full = trained
    target = float(full.model.held_out[8]) - 1e-6
    result = train(folder / "photos", tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=target))
    counts = result.basis.truncation_curve().counts[-1]
    assert counts.tolist() == full.basis.truncation_curve().counts[8].tolist()
    np.testing.assert_allclose(result.model.held_out, full.model.held_out[:9], atol=1e-6)
    assert result.figures["psnr_pca"] == pytest.approx(target, abs=1e-3)
    assert result.figures["components"] == counts.tolist()


def test_train_without_images_for_a_target(tmp_path):
    photos = random_fields(tmp_path / "few", 5)
    with pytest.raises(ValueError, match="images that are held out"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        train(photos, tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=20))
    assert [path.name for path in tmp_path.iterdir()] == ["few"]
    with pytest.raises(ValueError, match="give one of them"):
        train(photos, tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=20, energy=0.9))
    with pytest.raises(ValueError, match="target_psnr is nan"):
        train(tmp_path / "gone", tmp_path / "m.npz", TrainOptions(**SMALL, target_psnr=np.nan))
