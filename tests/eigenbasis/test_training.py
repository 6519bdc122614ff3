"""Training: from a folder to a model, whatever the images and the settings."""

import warnings

import numpy as np
import pytest

from _helpers.photos import SMALL, random_fields
from _helpers.trainings import checkpoint_of, settings
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.eigenbasis.options import TrainOptions
from eigengs_dr.eigenbasis.training import train
from eigengs_dr.image.io import ImageError


def test_end_to_end(folder, output):
    stages = []
    trained = train(
        folder, output, settings(), progress=lambda stage, *counts: stages.append((stage, *counts))
    )
    figures = trained.figures
    assert (figures["images"], figures["components"], figures["gaussians"]) == (22, [6] * 3, 60)
    # Components that are as smooth as these are rendered well by 60 splats.
    assert figures["psnr_init"] == pytest.approx(figures["psnr_pca"], abs=0.5)
    assert figures["psnr_solved"] > figures["psnr_pca"] + 5
    assert 0 < figures["pca_seconds"] <= figures["seconds"]
    assert ("components", 22, 22) in stages
    assert [stage for stage, *_ in stages[-3:]] == ["weights", "measure", "measure"]
    assert all(0 <= done <= total for _, done, total in stages)
    assert not checkpoint_of(output).exists()


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


def test_a_model_that_cannot_be_written(folder, output):
    """The work is kept."""
    output.mkdir()
    with pytest.raises(OSError, match=r"model\.npz"):
        train(folder, output, settings())
    assert {path.name for path in output.parent.iterdir()} == {
        "model.npz",
        "model.npz.checkpoint",
        "photos",
    }
    output.rmdir()
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


def test_images_of_other_sizes(folder, output):
    with pytest.warns(UserWarning, match="resized to 20x12"):
        figures = train(folder, output, settings(size=(20, 12))).figures
    assert figures["psnr_solved"] > figures["psnr_init"] > 15
    assert EigenGS.load(output).mean_image.shape == (3, 12, 20)


@pytest.mark.parametrize("count", [1, 4])
def test_fewer_splats_than_components(folder, output, count):
    assert train(folder, output, settings(gaussians=count)).figures["psnr_solved"] > 10


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"gaussians": 0}, "gaussians is 0"),
        ({"gaussians": 2.5}, "gaussians is 2.5"),
        ({"iterations": -1}, "iterations is -1"),
        ({"seed": -1}, "seed is -1"),
        ({"preset": "none"}, "preset 'none' is unknown; use one of default, eigengs"),
        ({"preset": "eigengs", "iterations": 0}, "iterations is 0"),
        ({"frequency_aware": "maybe"}, "is 'maybe'; use 'auto', True or False"),
        ({"space": "lab"}, "space 'lab' is unknown; use one of ycbcr, rgb"),
        ({"components": -1}, "components is -1"),
        ({"target_psnr": 20, "energy": 0.9}, "give one of them"),
        ({"target_psnr": np.nan}, "target_psnr is nan"),
    ],
    ids=str,
)
def test_wrong_settings_are_refused(changed, words):
    """Before an image is read."""
    with pytest.raises(ValueError, match=words):
        settings(**changed)


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
