"""`load` gives what a file holds; the class of another kind refuses it in one line."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import smooth_pixels
from _helpers.errors import file_refused

LIGHTS = np.array([(1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1)], float)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file of each kind, by the class that reads it."""
    folder = tmp_path_factory.mktemp("kinds")
    image = smooth_pixels(24, 24)
    family = np.stack([image, image[::-1], image[:, ::-1]])
    basis = eg.Eigenbasis.from_images(family, size=(24, 24), components=2, progress=False)
    photos = [image * brightness for brightness in (0.4, 0.5, 0.6, 0.7)]
    saved = {
        eg.Gaussians: eg.fit(image, 20, iterations=2, progress=False).gaussians,
        eg.Eigenbasis: basis,
        eg.EigenGS: eg.EigenGS.fit(basis, 20, progress=False),
        eg.Relightable: eg.Relightable.fit(photos, LIGHTS, gaussians=20, iterations=2),
    }
    for kind, one in saved.items():
        one.save(folder / f"{kind.__name__}.npz")
    eg.pack(saved[eg.Gaussians], folder / "Gaussians.egs", max_psnr_drop=3)
    eg.pack(saved[eg.Relightable], folder / "Relightable.egs", max_psnr_drop=3)
    return folder


def test_each_kind_comes_back(files):
    for path in files.iterdir():
        assert type(eg.load(path)).__name__ == path.stem, path
    assert isinstance(eg.load("natural"), eg.EigenGS)


@pytest.mark.parametrize("kind", [eg.Gaussians, eg.Eigenbasis, eg.EigenGS, eg.Relightable])
def test_other_kinds_are_refused_by_what_they_hold(files, kind):
    for path in files.glob("*.npz"):
        if path.stem != kind.__name__:
            with file_refused(path, "format is 'eigengs_dr."):
                kind.load(path)


def test_other_files_are_refused(tmp_path):
    np.savez(tmp_path / "x.npz", format=np.array("something.else"))
    with file_refused(tmp_path / "x.npz", "format is 'something.else', expected one of"):
        eg.load(tmp_path / "x.npz")
    with pytest.raises(OSError, match="missing"):
        eg.load(tmp_path / "missing.npz")
