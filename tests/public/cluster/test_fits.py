"""Fits of a folder, of blocks and of families on two processes have the bits of one."""

import os

import numpy as np
import pytest
import tifffile
from PIL import Image

import eigengs_dr as eg
from _helpers import clusters
from _helpers.clusters import QUICK, files_of
from _helpers.command import run, succeeded
from _helpers.families import small_model
from _helpers.sets import check_equal


def test_a_folder(client, photos, output, expected, monkeypatch):
    """Names are those of the user: workers run in other folders. Dask holds bytes alone.

    Its threads must not use Dr.Jit beside a task.
    """
    monkeypatch.chdir(output.parent)
    held, seen = set(), []

    def note(done, total, row):
        held.update(*client.run(clusters.held_types).values())
        seen.append((done, total))

    rows = eg.fit_many("photos", "fits", client=client, progress=note, **QUICK)
    assert [row.name for row in rows] == sorted(path.stem for path in photos.iterdir())
    assert str(rows[0].input) == os.path.join("photos", "00.png")
    assert str(rows[0].output) == os.path.join("fits", "00.npz")
    assert seen == [(done, 12) for done in range(1, 13)] and held == {"bytes"}
    assert files_of(output) == expected
    assert sorted(path.name for path in output.iterdir()) == list(expected)
    again = eg.fit_many("photos", "fits", client=client, **QUICK)
    assert {row.status for row in again} == {"skipped"}
    assert [row.psnr_rgb for row in again] == [row.psnr_rgb for row in rows]


def test_a_start_results_and_warnings_travel(client, tmp_path):
    Image.fromarray(np.full((32, 32, 4), 128, np.uint8)).save(tmp_path / "a.png")
    images = [tmp_path / "a.png", np.full((32, 32, 3), 0.6, np.float32)]
    options = {"start": small_model("llvm"), "iterations": 2, "backend": "llvm"}
    with pytest.warns(UserWarning, match="transparent pixels"):
        here = eg.fit_many(images, **options)
    with pytest.warns(UserWarning, match="transparent pixels"):
        there = eg.fit_many(images, client=client, **options)
    for row, other in zip(there, here, strict=True):
        check_equal(row.result.gaussians, other.result.gaussians.to_arrays())


def test_encoded_images(client, photos, output):
    model = small_model("llvm")
    here = model.encode_many(photos)
    rows = model.encode_many(photos, client=client)
    model.encode_many(photos, output, client=client)
    for row, other in zip(rows, here, strict=True):
        assert row.psnr_rgb == other.psnr_rgb
        check_equal(row.result, other.result.to_arrays())
        check_equal(eg.Gaussians.load(output / f"{row.name}.npz"), other.result.to_arrays())


def test_blocks(client, tmp_path):
    picture = (255 * eg.sample("coffee")[:96, :160]).round().astype(np.uint8)
    tifffile.imwrite(tmp_path / "x.tif", picture, tile=(16, 16))
    options = {"iterations": 20, "block": 64, "backend": "llvm"}
    alone = eg.fit_large(tmp_path / "x.tif", **options)
    shared = eg.fit_large(tmp_path / "x.tif", tmp_path / "x.npz", client=client, **options)
    check_equal(shared.gaussians, alone.gaussians.to_arrays())
    assert not (tmp_path / "x.npz.checkpoint").exists()


@pytest.mark.parametrize("stored", [False, True])
def test_a_basis(client, tmp_path, stored):
    """Of three parts, which are merged."""
    weights = np.random.default_rng(0).normal(size=(4200, 3, 1, 1, 1))
    waves = np.random.default_rng(1).normal(size=(3, 5, 6, 3))
    images = list((0.5 + 0.02 * (weights * waves).sum(axis=1)).astype(np.float32))
    checkpoint = tmp_path if stored else None
    there = eg.Eigenbasis.from_images(images, (6, 5), 3, client=client, checkpoint=checkpoint)
    here = eg.Eigenbasis.from_images(images, (6, 5), 3)
    np.testing.assert_array_equal(there.mean, here.mean)
    for component, other in zip(there.components, here.components, strict=True):
        np.testing.assert_array_equal(component, other)
    with pytest.raises(ValueError, match="a cluster needs a list"):
        eg.Eigenbasis.from_images(iter(images), (6, 5), 3, client=client)


def test_a_command_that_trains(photos, tmp_path, monkeypatch):
    """With workers of its own, and names relative to its folder, where no worker runs."""
    monkeypatch.chdir(tmp_path)
    options = ("--size", "32x24", "--components", 3, "--gaussians", 20, "--quiet")
    succeeded(run("train", "photos", "-o", "here.npz", *options))
    succeeded(run("train", "photos", "-o", "there.npz", *options, "--cluster", "local:2"))
    assert (tmp_path / "there.npz").read_bytes() == (tmp_path / "here.npz").read_bytes()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["here.npz", "photos", "there.npz"]
