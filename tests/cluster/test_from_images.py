"""The eigenbasis on two processes."""

import pytest

from _helpers.low_rank import SIZE, assert_same, family
from eigengs_dr.eigenbasis import training
from eigengs_dr.eigenbasis.options import TrainOptions
from eigengs_dr.eigenbasis.pca import stream
from eigengs_dr.eigenbasis.pca.basis import Eigenbasis
from eigengs_dr.image.io import save_image


@pytest.fixture
def images(monkeypatch):
    """Images for four shards; workers take the sizes from the tasks."""
    monkeypatch.setattr(stream, "SHARD", 16)
    return family(60)


@pytest.mark.parametrize("stored", [False, True])
def test_the_bits_of_one_process(client, images, tmp_path, stored):
    checkpoint = tmp_path if stored else None
    found = Eigenbasis.from_images(images, SIZE, 8, client=client, checkpoint=checkpoint)
    assert_same(found, Eigenbasis.from_images(images, SIZE, 8))


def test_iterators_are_refused(client, images):
    with pytest.raises(ValueError, match="a cluster needs a list"):
        Eigenbasis.from_images(iter(images), SIZE, 8, client=client)


def test_training(client, tmp_path, images, monkeypatch):
    """Names are relative to the folder of the client, where no worker runs."""
    (tmp_path / "photos").mkdir()
    for i, image in enumerate(images):
        save_image(tmp_path / "photos" / f"{i:03d}.png", image)
    settings = TrainOptions(size=SIZE, components=6, gaussians=40)
    stages = []

    def progress(stage, done, total):
        stages.append((stage, done, total))

    monkeypatch.chdir(tmp_path)
    far = training.train("photos", "a.npz", settings, progress=progress, client=client)
    here = training.train(tmp_path / "photos", tmp_path / "b.npz", settings)
    assert_same(far.basis, here.basis)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert ("components", 54, 54) in stages
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz", "photos"]
