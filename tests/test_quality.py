"""A guard on quality: the PSNR of small fits, on llvm, may not fall."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import family, small_model
from _helpers.photos import coffee

SLACK = 0.2
"""Decibels by which a PSNR may lie below the recorded value."""

COUNT = {"gaussians": 300, "iterations": 60}
NATURAL = {"init": "eigen", "basis": "natural"}

FITS = {
    "default": ("coffee", COUNT, 0, 0),
    "detail": ("face", COUNT, 0, 0),
    "rgb": ("face", {**COUNT, "color": "rgb"}, 0, 0),
    "linear": ("face", {**COUNT, "color": "linear"}, 0, 0),
    "start": ("face", {**COUNT, "iterations": 0}, 0, 0),
    "grid": ("face", {**COUNT, "iterations": 0, "init": "grid"}, 0, 0),
    "gaussianimage": ("face", {**COUNT, "iterations": 300, "preset": "gaussianimage"}, 0, 0),
    "basis": ("astronaut", {**NATURAL, "iterations": 0}, 0, 0),
    "basis, 20 steps": ("astronaut", {**NATURAL, "iterations": 20}, 0, 0),
}
"""Image, options of `fit`, and the recorded psnr_rgb and psnr_ycbcr."""


def photo(name):
    """Crops of 64x64 pixels; for the 5,000 Gaussians of the basis 128x128 pixels."""
    if name == "coffee":
        return coffee(64)
    image = eg.sample("astronaut")
    return image[80:144, 200:264] if name == "face" else image[60:188, 160:288]


def check(image, found, psnr_rgb, psnr_ycbcr):
    assert eg.psnr(image, found, space="rgb") > psnr_rgb - SLACK
    assert eg.psnr(image, found, space="ycbcr") > psnr_ycbcr - SLACK


@pytest.mark.parametrize("name", FITS)
def test_fit(name):
    crop, options, *recorded = FITS[name]
    image = photo(crop)
    check(image, eg.fit(image, **options, backend="llvm").image, *recorded)


def test_search():
    """The target is reached, and by few Gaussians."""
    image = photo("face")
    found = eg.fit(image, target_psnr=32, iterations=60, backend="llvm")
    assert found.stopped == "met"
    assert eg.psnr(image, found.image, space="ycbcr") >= 32
    assert len(found.gaussians) <= 1.05 * 0


def test_levels():
    image = photo("face")
    gaussians = eg.fit_levels(image, 300, 2, iterations=60, backend="llvm").gaussians
    check(image, eg.picture_of(gaussians[:75]), 0, 0)
    check(image, eg.picture_of(gaussians), 0, 0)


@pytest.mark.parametrize(("colors", "recorded"), [("exact", 0), ("projected", 0)])
def test_encode(colors, recorded):
    model, images = small_model("llvm"), family(8, seed=1)
    shown = [eg.render(model.encode(image, colors)).numpy() for image in images]
    reached = np.mean([eg.psnr(i, s, "ycbcr") for i, s in zip(images, shown, strict=True)])
    assert reached > recorded - SLACK


def test_pack(tmp_path):
    """As small a file, and as good a picture."""
    image = photo("face")
    gaussians = eg.fit(image, **COUNT, backend="llvm").gaussians
    packed = eg.pack(gaussians, tmp_path / "x.egs", image)
    check(image, eg.picture_of(eg.Gaussians.load(tmp_path / "x.egs", "llvm")), 0, 0)
    assert packed.bytes <= 1.03 * 0
