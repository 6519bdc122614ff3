"""Record results of the package by public calls alone, and compare them with recorded ones.

Run it before and after a change that shall keep what users get. Fits are compared on one machine:
others round differently, and some hundred steps turn last bits into some tenths of a decibel. So on
a new machine, write the record at the commit before the change.

    python tools/record.py                 # all entries; the exit code is 1 if one differs
    python tools/record.py --only pack     # those whose names contain a word
    python tools/record.py --write         # what is found becomes what is expected

An entry prints one line:

- "equal bits": all figures and the bits of the results are as recorded. "equal" without bits, where
  none are promised, as of Mitsuba's sums in any order.
- "within": PSNRs at most 0.03 dB lower, losses at most 0.7 % higher, which is the same; bytes and
  numbers of Gaussians that a search found within 3 %; other numbers within 1e-4; texts equal. What
  moved follows.
- "DIFFERS", with what was recorded, and what was found.
- "skipped", with the package that is missing.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import io
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache, partial
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from PIL import Image
from tqdm import tqdm

import eigengs_dr as eg  # before Dr.Jit: it finds libLLVM

import drjit as dr  # isort: skip

EXPECTED = Path(__file__).with_suffix(".json")
"""The recorded figures."""

PACKAGES = (
    "eigengs-dr",
    "drjit",
    "mitsuba",
    "numpy",
    "scipy",
    "pillow",
    "OpenImageIO",
    "distributed",
)
"""Packages whose versions are recorded."""

PSNR, LOSS, SIZE, NUMBER = 0.03, 0.007, 0.03, 1e-4
"""Tolerances: decibels; shares of a loss, of bytes and found numbers, and of other numbers."""

BACKEND, VARIANT = "llvm", "llvm_ad_rgb"
"""What all entries run on."""

Figures = dict[str, Any]

ENTRIES: dict[str, Callable[[], Figures]] = {}
"""All entries by name: functions that return figures and, under "bits", a hash of the results."""


class Skipped(Exception):
    """What an entry needs is missing."""


def entry(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add a function to the entries, under a name."""

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        assert name not in ENTRIES, name
        ENTRIES[name] = function
        return function

    return add


# Inputs: small, and the same everywhere.


def photo(side: int = 64) -> np.ndarray:
    """A part of a photo, shape (side, side, 3)."""
    return eg.sample("coffee")[8 : 8 + 4 * side : 4, 100 : 100 + 4 * side : 4]


def light(width: int = 64, height: int = 32) -> np.ndarray:
    """Linear light of a sky with a lamp of 20, shape (height, width, 3)."""
    y, x = np.mgrid[:height, :width] + 0.5
    lamp = 20 * np.exp(-((x - 0.7 * width) ** 2 + (y - 0.3 * height) ** 2) / 8)
    waves = 0.4 + 0.2 * np.sin(2 * np.pi * x / width) * np.cos(y / 5)
    return np.stack([waves + lamp, waves + 0.8 * lamp, 1.2 * waves], axis=2).astype(np.float32)


def heights(side: int = 64) -> np.ndarray:
    """Waves around 0.5, shape (side, side)."""
    y, x = np.mgrid[:side, :side] / side
    return (0.5 + 0.3 * np.sin(9 * x + 4 * y * y) * np.cos(7 * y)).astype(np.float32)


def normals(side: int = 64) -> np.ndarray:
    """Codes of the normals of these waves, shape (side, side, 3)."""
    slope_y, slope_x = np.gradient(8 * heights(side))
    normal = np.stack([-slope_x, -slope_y, np.ones((side, side))], axis=2)
    coded = 0.5 + 0.5 * normal / np.linalg.norm(normal, axis=2, keepdims=True)
    return coded.astype(np.float32)


def material(side: int = 48) -> dict[str, np.ndarray]:
    """Three maps of one size."""
    return {"albedo": photo(side), "roughness": heights(side), "normal": normals(side)}


def family(count: int = 40, side: int = 32) -> np.ndarray:
    """Shifted parts of a photo, shape (count, side, side, 3)."""
    image = eg.sample("coffee")
    corners = np.random.default_rng(0).integers(0, 300, (count, 2))
    return np.stack([image[y : y + side, x : x + side] for y, x in corners])


@cache
def plain_set(space: str = "ycbcr", channels: int = 3, count: int = 120, size=(48, 32)) -> Any:
    """A set of random Gaussians that no fit has made."""
    rng = np.random.default_rng(5)
    factor = rng.uniform(0.15, 0.6, (count, 3)) * [1, 0.5, 1]
    color = rng.uniform(0.05, 0.4, (count, channels)) * ([1, 0.3, 0.3] if space == "ycbcr" else 1)
    background = np.full(channels, 0.1)
    mean = rng.uniform(0, size, (count, 2))
    return eg.Gaussians.from_arrays(
        mean, factor, color, background, size=size, space=space, backend=BACKEND
    )


@cache
def fitted() -> Any:
    """The fit that several entries start from."""
    return fit(photo(), 300, 100)


@cache
def fitted_material() -> Any:
    """The fit of maps that several entries start from."""
    return fit(material(), 200, 60)


@cache
def model() -> Any:
    """A small model of a family of images."""
    basis = eg.Eigenbasis.from_images(family(), (32, 32), (12, 6, 6), progress=False)
    return eg.EigenGS.fit(basis, 100, backend=BACKEND, progress=False)


ROOM = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/>
      <integer name="height" value="24"/><rfilter type="box"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  </sensor>
  <emitter type="constant"/>
  <shape type="rectangle"><bsdf type="diffuse"><texture name="reflectance" type="bitmap">
    <string name="filename" value="a.png"/></texture></bsdf></shape>
</scene>"""


@cache
def temporary() -> Any:
    """A folder that is deleted when the process ends."""
    return tempfile.TemporaryDirectory(prefix="record-")


@cache
def folder() -> Path:
    """The path of this folder, with the files that commands need."""
    path = Path(temporary().name)
    (path / "photos").mkdir()
    for target in ("a.png", "photos/a.png"):
        eg.save_image(path / target, photo())
    eg.save_image(path / "photos" / "b.png", photo(48))
    eg.save_image(path / "large.png", photo(96))
    eg.save_image(path / "rough.png", heights())
    (path / "photos" / "damaged.png").write_bytes(b"none")
    (path / "room.xml").write_text(ROOM, encoding="utf-8")
    plain_set("linear").save(path / "plain.npz")
    return path


def package(name: str) -> Any:
    """Import a package, or skip the entry."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise Skipped(f"{name} is missing") from error


# What is recorded of a result.


def bits(*results: Any) -> str:
    """Hash the bits of arrays, tensors and sets of Gaussians, 16 hexadecimal digits."""
    digest = blake2b(digest_size=8)
    for result in results:
        if isinstance(result, eg.Gaussians):
            arrays = result.to_arrays()
            values = [arrays[name] for name in ("mean", "factor", "color", "background")]
        else:
            values = [result]
        for value in values:
            array = np.ascontiguousarray(value)
            digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def of_pixels(*pictures: Any) -> dict[str, Any]:
    """Describe pictures, or other arrays: shapes, means, root mean squares, bits."""
    arrays = [np.asarray(picture) for picture in pictures]
    return {
        "shape": " ".join("x".join(map(str, array.shape)) for array in arrays),
        "mean": [float(array.mean(dtype=np.float64)) for array in arrays],
        "rms": [float(np.sqrt(np.square(array, dtype=np.float64).mean())) for array in arrays],
        "bits": bits(*arrays),
    }


def of_fit(result: Any, found: bool = False) -> dict[str, Any]:
    """Describe a fit; `found` says that a search chose the number of Gaussians."""
    return {
        "found" if found else "gaussians": len(result.gaussians),
        "space": str(result.gaussians.space),
        "stopped": result.stopped,
        "trace": " ".join(sorted(result.trace[-1])),
        "psnr_ycbcr": result.psnr_ycbcr,
        "psnr_rgb": result.psnr_rgb,
        "psnr": result.maps,
        "loss": result.loss,
        "bits": bits(result.gaussians),
    }


def fit(*arguments: Any, **options: Any) -> Any:
    """Fit without a bar, on the processor."""
    return eg.fit(*arguments, backend=BACKEND, progress=False, **options)


def keys_of(report: Any, name: str = "") -> set[str]:
    """Name the keys of a report; those of the elements of lists once."""
    if isinstance(report, dict):
        return {key for k, value in report.items() for key in keys_of(value, f"{name}.{k}")}
    if isinstance(report, list) and any(isinstance(value, dict) for value in report):
        return {key for value in report for key in keys_of(value, f"{name}[]")}
    return {name.lstrip(".")}


# Presets.


@entry("preset default")
def _() -> Figures:
    return of_fit(fitted())


@entry("preset gaussianimage")
def _() -> Figures:
    from eigengs_dr.paper.gaussianimage import GAUSSIANIMAGE

    return of_fit(fit(photo(), 300, 100, method=GAUSSIANIMAGE))


@entry("preset eigengs")
def _() -> Figures:
    from eigengs_dr.paper.eigengs import EIGENGS

    result = fit(photo(), iterations=60, start=model(), method=EIGENGS)
    return of_fit(result) | {"bits": bits(result.gaussians, result.mean_image, result.image)}


@entry("preset default, another seed and cutoff")
def _() -> Figures:
    return of_fit(fit(photo(), 300, 100, seed=7, method=replace(eg.DEFAULT, cutoff=2.5)))


@entry("preset default, no steps")
def _() -> Figures:
    return of_fit(fit(photo(), 300, 0))


# Starts.


@entry("start from a fit of the photo before")
def _() -> Figures:
    return of_fit(fit(np.roll(photo(), 2, axis=1), iterations=60, start=fitted()))


@entry("start from a file, at another size")
def _() -> Figures:
    path = folder() / "start.npz"
    fitted().save(path)
    return of_fit(fit(photo(96), iterations=40, start=path))


@entry("start from a model")
def _() -> Figures:
    return of_fit(fit(photo(96), iterations=20, start=eg.EigenGS.load("natural", BACKEND)))


# Spaces, and what pixels are.

SPACES = {
    "ycbcr": photo,
    "rgb": photo,
    "linear": photo,
    "normal": normals,
    "data": heights,
    "radiance": light,
    "log": light,
}


def fit_in(space: str) -> Figures:
    """Fit in a space, with 250 Gaussians and 60 steps."""
    encoding = "linear" if space in ("radiance", "log") else None
    return of_fit(fit(SPACES[space](), 250, 60, space=space, encoding=encoding))


for space in SPACES:
    entry(f"space {space}")(partial(fit_in, space))


@entry("pixels: light above 1 in the default space")
def _() -> Figures:
    return of_fit(fit(light(), 200, 40, encoding="linear"))


@entry("pixels: integers, grey")
def _() -> Figures:
    grey = np.rint(255 * photo()[..., 0]).astype(np.uint8)
    return of_fit(fit(grey, 200, 40))


@entry("pixels: data of large values")
def _() -> Figures:
    return of_fit(fit(4000 * heights(), 200, 40, space="data"))


# Levels and searches.


@entry("levels of named numbers")
def _() -> Figures:
    result = fit(photo(), [60, 120, 300], 90)
    psnrs = [eg.psnr(eg.picture_of(result.gaussians[:n]), photo()) for n in (60, 120, 300)]
    return of_fit(result) | {"psnr_levels": psnrs}


@entry("levels of one factor")
def _() -> Figures:
    counts = eg.level_counts(320, 3)
    return of_fit(fit(photo(), counts, 60, space="rgb")) | {"counts": counts}


@entry("search for a PSNR")
def _() -> Figures:
    return of_fit(fit(photo(), iterations=60, target_psnr=32), found=True)


@entry("search for a PSNR in YCbCr")
def _() -> Figures:
    goal = eg.Goal(36, space="ycbcr", max_gaussians=1000)
    return of_fit(fit(photo(), iterations=60, target_psnr=goal), found=True)


@entry("search out of reach")
def _() -> Figures:
    goal = eg.Goal(60, max_gaussians=200)
    return of_fit(fit(photo(48), iterations=40, target_psnr=goal))


@entry("search for goals of maps")
def _() -> Figures:
    maps = material()
    maps["roughness"] = eg.Map(maps["roughness"], goal=34)
    return of_fit(fit(maps, iterations=40, target_psnr=30), found=True)


# Maps and weights.


@entry("maps")
def _() -> Figures:
    return of_fit(fitted_material())


@entry("maps of named spaces and weights, in levels")
def _() -> Figures:
    maps = {"height": eg.Map(heights(48), "data", weight=3), "paint": eg.Map(photo(48), "rgb")}
    return of_fit(fit(maps, [80, 200], 60))


@entry("weight of pixels")
def _() -> Figures:
    image, weight = photo().copy(), np.ones((64, 64))
    weight[8:24, 8:24], weight[40:, 40:] = 10, 0
    image[50, 50] = np.nan
    return of_fit(fit(image, 250, 60, weight=weight))


@entry("weight of channels")
def _() -> Figures:
    weight = np.full((64, 64, 3), [4, 1, 0.5])
    return of_fit(fit(photo(), 250, 60, weight=weight))


@entry("weight of the pixels of maps")
def _() -> Figures:
    return of_fit(fit(material(), 150, 40, weight=0.1 + heights(48)))


# Losses.


def l1(wanted: Any, picture: Any) -> Any:
    """The mean absolute error."""
    return dr.mean(dr.abs(picture - type(picture)(np.atleast_3d(wanted))), axis=None)


def squares(wanted: Any, picture: Any) -> Any:
    """The mean squared error."""
    return dr.mean(dr.square(picture - type(picture)(np.atleast_3d(wanted))), axis=None)


@entry("loss with an image")
def _() -> Figures:
    def loss(picture: Any, step: Any) -> Any:
        return l1(photo(), picture) + 0.2 * (1 - eg.ssim(picture, type(picture)(photo())))

    return of_fit(fit(photo(), 250, 60, space="rgb", loss=loss))


@entry("loss without an image")
def _() -> Figures:
    loss = eg.Loss(lambda picture, step: squares(photo(48), picture), bounds=(0, 1))
    return of_fit(fit(loss=loss, size=(48, 48), gaussians=150, iterations=80, space="rgb"))


@entry("loss from a start, with an optimiser of its own")
def _() -> Figures:
    from drjit.llvm.ad import Float
    from drjit.opt import Adam

    gain = Adam(lr=0.02, params={"gain": Float(0.8)})

    def loss(picture: Any, step: Any) -> Any:
        return squares(photo(), gain["gain"] * picture)

    options = {"size": (64, 64), "start": fitted().gaussians, "iterations": 30}
    result = fit(loss=eg.Loss(loss, parameters=gain), **options)
    return of_fit(result) | {"loss_gain": float(gain["gain"][0])}


@entry("loss of maps")
def _() -> Figures:
    def loss(pictures: Any, step: Any) -> Any:
        return squares(photo(48), pictures["albedo"]) + squares(heights(48), pictures["rough"])

    spaces = {"albedo": "rgb", "rough": "data"}
    return of_fit(fit(loss=loss, size=(48, 48), gaussians=150, iterations=60, space=spaces))


@entry("loss to reach")
def _() -> Figures:
    loss = eg.Loss(lambda picture, step: squares(photo(48), picture), target=2e-3)
    return of_fit(fit(loss=loss, size=(48, 48), iterations=60, space="rgb"), found=True)


@entry("loss whose judge chooses the number")
def _() -> Figures:
    wanted = photo(48)

    def noisy(picture: Any, step: Any) -> Any:
        noise = np.random.default_rng(step).normal(0, 0.3, wanted.shape)
        return squares((wanted + noise).astype(np.float32), picture)

    loss = eg.Loss(noisy, judge=partial(squares, wanted))
    return of_fit(fit(loss=loss, size=(48, 48), iterations=60, space="rgb"), found=True)


# Many images, large images, other processes.


def of_rows(rows: Any) -> Figures:
    """Describe the rows of a run."""
    return {
        "status": " ".join(row.status for row in rows),
        "names": " ".join(row.name for row in rows),
        "psnr_rgb": [row.psnr_rgb for row in rows if row.psnr_rgb],
    }


@entry("many arrays")
def _() -> Figures:
    images = [photo(48), photo(48)[::-1], photo(32)]
    options = {"gaussians": 120, "iterations": 40}
    rows = eg.fit_many(images, backend=BACKEND, progress=False, **options)
    alone = [bits(fit(image, **options).gaussians) for image in images]
    sets = [row.result.gaussians for row in rows]
    same = [bits(g) for g in sets] == alone
    return of_rows(rows) | {"same as alone": str(same), "bits": bits(*sets)}


@entry("many files, one of them damaged, twice")
def _() -> Figures:
    output = folder() / "fits"
    options = {"gaussians": 100, "iterations": 20, "backend": BACKEND, "progress": False}
    rows = eg.fit_many(folder() / "photos", output, **options)
    again = eg.fit_many(folder() / "photos", output, **options)
    files = sorted(output.glob("*.npz"))
    return of_rows(rows) | {
        "again": " ".join(row.status for row in again),
        "bits": bits(*(eg.Gaussians.load(path, BACKEND) for path in files)),
    }


@entry("many files on a cluster")
def _() -> Figures:
    distributed = package("distributed")
    images = [folder() / "photos" / f"{name}.png" for name in "ab"]
    options = {"gaussians": 100, "iterations": 20, "backend": BACKEND, "progress": False}
    cluster = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.Client(**cluster) as client:
        rows = eg.fit_many(images, folder() / "cluster", client=client, **options)
    sets = [eg.Gaussians.load(row.output, BACKEND) for row in rows]
    return of_rows(rows) | {"bits": bits(*sets)}


@entry("blocks of an array")
def _() -> Figures:
    options = {"block": 48, "iterations": 40, "backend": BACKEND, "progress": False}
    result = eg.fit_large(photo(96), **options)
    return of_large(result)


@entry("blocks of a file")
def _() -> Figures:
    path = folder() / "large.tif"
    eg.save_image(path, photo(96), bits=16)
    options = {"block": 64, "gaussians": 300, "iterations": 30, "space": "linear"}
    result = eg.fit_large(path, folder() / "large.npz", backend=BACKEND, progress=False, **options)
    return of_large(result) | {"bits": bits(eg.Gaussians.load(folder() / "large.npz", BACKEND))}


def of_large(result: Any) -> Figures:
    """Describe a fit in blocks."""
    return {
        "gaussians": len(result.gaussians),
        "blocks": result.blocks,
        "psnr_ycbcr": result.psnr_ycbcr,
        "psnr_rgb": result.psnr_rgb,
        "bits": bits(result.gaussians),
    }


# Families of images.


@entry("basis of a family")
def _() -> Figures:
    basis = eg.Eigenbasis.from_images(family(), (32, 32), energy=0.9, progress=False)
    coded = basis.project(photo(32))
    picture = basis.reconstruct(coded)
    return of_pixels(picture) | {
        "components": [len(values) for values in basis.eigenvalues],
        "psnr_ycbcr": eg.psnr(picture, photo(32), "ycbcr"),
        "bits": bits(basis.mean, *basis.components, *coded),
    }


@entry("EigenGS fit")
def _() -> Figures:
    fitted_model = model()
    path = folder() / "model.npz"
    fitted_model.save(path)
    loaded = eg.EigenGS.load(path, BACKEND)
    return {
        "components": [len(values) for values in fitted_model.eigenvalues],
        "shapes": [list(planes.shape) for planes in loaded.weights],
        "bits": bits(loaded.gaussians, *loaded.weights),
    }


@entry("EigenGS fit with training")
def _() -> Figures:
    basis = eg.Eigenbasis.from_images(family(), (32, 32), (8, 4, 4), progress=False)
    options = {"iterations": 20, "backend": BACKEND, "progress": False}
    paper = eg.EigenGS.fit(basis, 100, preset="eigengs", frequency_aware=True, **options)
    return of_sets(photo(32), paper.encode(photo(32), "projected"))


def of_sets(image: Any, *sets: Any) -> Figures:
    """Describe sets that stand for one image."""
    return {
        "gaussians": [len(g) for g in sets],
        "psnr_ycbcr": [eg.psnr(eg.picture_of(g), image, "ycbcr") for g in sets],
        "bits": bits(*sets),
    }


@entry("EigenGS encode")
def _() -> Figures:
    natural = eg.EigenGS.load("natural", BACKEND)
    sets = [
        m.encode(photo(), colors) for m in (model(), natural) for colors in ("exact", "projected")
    ]
    return of_sets(photo(), *sets)


@entry("EigenGS project")
def _() -> Figures:
    codes = model().project(photo(32))
    fewer = model().project(photo(32), target_psnr=15)
    sets = [model().reconstruct(c, (40, 24)) for c in (codes, fewer)]
    figures = of_pixels(*(eg.render(g) for g in sets))
    return figures | {"numbers": [len(c) for c in fewer], "bits": bits(*codes, *fewer, *sets)}


@entry("EigenGS encode many")
def _() -> Figures:
    rows = model().encode_many(list(family(4)), progress=False)
    sets = [getattr(row.result, "gaussians", row.result) for row in rows]
    return {"status": " ".join(row.status for row in rows), "bits": bits(*sets)}


# Packed files.


def of_packed(name: str, gaussians: Any, *arguments: Any, **options: Any) -> Figures:
    """Pack a set, and describe the file."""
    path = folder() / f"{name}.egs"
    packed = eg.pack(gaussians, path, *arguments, **options)
    assert packed.bytes == path.stat().st_size
    return {
        "bytes": packed.bytes,
        "psnr": packed.psnr,
        "psnr_drop": f"{packed.psnr_drop:.1f} dB",
        "bits": bits(eg.Gaussians.load(path, BACKEND)),
    }


@entry("pack with the image")
def _() -> Figures:
    return of_packed("image", fitted(), photo())


@entry("pack without an image")
def _() -> Figures:
    return of_packed("set", plain_set("linear"), max_psnr_drop=0.2)


@entry("pack in sections")
def _() -> Figures:
    result = fit(photo(), [100, 300], 40)
    figures = of_packed("sections", result.gaussians, photo(), sections=[100, 200])
    first = eg.Gaussians.load(folder() / "sections.egs", BACKEND, sections=1)
    return figures | {"first": len(first)}


@entry("pack maps")
def _() -> Figures:
    return of_packed("maps", fit(material(32), 80, 20), material(32))


@entry("pack light")
def _() -> Figures:
    sky = fit(light(), 60, 20, space="log", encoding="linear")
    return of_packed("light", sky, light(), encoding="linear")


# Renderings and their derivatives.


@entry("render")
def _() -> Figures:
    g = plain_set()
    return of_pixels(eg.render(g), eg.render(g, cutoff=2), eg.render(g, 96, 64))


@entry("render smaller")
def _() -> Figures:
    g = plain_set()
    return of_pixels(eg.render(g, 17, 11), eg.render(g, 17, 11, filter=False))


@entry("render regions")
def _() -> Figures:
    g = plain_set()
    small = eg.render(g, 10, 8, region=(8, 4, 20, 16))
    return of_pixels(
        eg.render(g, region=(8, 4, 20, 16)), small, eg.render(g, 60, 48, region=(8, 4, 20, 16))
    )


@entry("render every space")
def _() -> Figures:
    sets = [plain_set(space, 1 if space == "data" else 3) for space in SPACES]
    return of_pixels(*(eg.render(g) for g in sets), *(eg.picture_of(g) for g in sets))


@entry("render maps")
def _() -> Figures:
    return of_pixels(*eg.picture_of(fitted_material().gaussians, 24, 24).values())


@entry("render lists, parts and joined sets")
def _() -> Figures:
    g = plain_set("rgb")
    joined = eg.concatenate([g[:50], g[80:]]).scaled(64, 64).bounded()
    listed = eg.render(g, lists=eg.tile_lists(g, margin=2.0))
    return of_pixels(eg.render(joined), listed)


@entry("render a saved set in double precision")
def _() -> Figures:
    path = folder() / "saved.npz"
    plain_set("linear").save(path)
    return of_pixels(eg.render(eg.Gaussians.load(path, BACKEND, dtype=np.float64)))


def of_gradients(gaussians: Any, picture: Callable[[Any], Any]) -> Figures:
    """Describe the derivatives of the mean square of a picture of a set."""
    tensors = eg.to_tensors(gaussians)
    for tensor in tensors.values():
        dr.enable_grad(tensor)
    dr.backward(dr.mean(dr.square(picture(eg.from_tensors(tensors, gaussians))), axis=None))
    return of_pixels(*(dr.grad(tensors[name]) for name in sorted(tensors)))


@entry("gradients")
def _() -> Figures:
    return of_gradients(plain_set(), eg.render)


@entry("gradients of a smaller region")
def _() -> Figures:
    view = partial(eg.render, width=9, height=7, region=(8, 4, 30, 20))
    return of_gradients(plain_set("linear"), view)


@entry("gradients of SSIM")
def _() -> Figures:
    other = eg.render(plain_set("rgb", count=60))
    return of_gradients(plain_set("rgb"), lambda g: 1 - eg.ssim(eg.render(g), other))


@entry("metrics")
def _() -> Figures:
    a, b = photo(), np.clip(photo() + 0.05 * (heights() - 0.5)[..., None], 0, 1)
    large = [np.kron(image, np.ones((3, 3, 1), np.float32)) for image in (a, b)]
    return {
        "psnr": [eg.psnr(a, b), eg.psnr(a, b, "ycbcr"), eg.psnr(a, b, weight=heights())],
        "ssim": [float(eg.ssim(a, b)), float(eg.ssim(a, b, heights())), eg.ms_ssim(*large)],
    }


@entry("page of view")
def _() -> Figures:
    path = folder() / "page.html"
    eg.view(fitted(), photo(), levels=[100, 300], title="A photo").save(path)
    text = path.read_text(encoding="utf-8")
    return {"title": str("A photo" in text), "network": str("http://" in text.split("<body")[1])}


# Mitsuba.


@cache
def mitsuba() -> Any:
    """Mitsuba with its variant set and the plugins registered."""
    mi = package("mitsuba")
    mi.set_variant(VARIANT)
    eg.register_plugins()
    return mi


def points(side: int = 24) -> Any:
    """Where slanted rays meet a square of uv."""
    mi = mitsuba()
    at = mi.ScalarTransform4f().rotate([0, 1, 0], 55).rotate([0, 0, 1], 20)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "to_world": at}})
    y, x = (np.mgrid[:side, :side].reshape(2, -1) + 0.5) / side - 0.5
    origin = mi.Point3f(mi.Float(x.astype(np.float32)), mi.Float(y.astype(np.float32)), 3)
    return scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))


def looked_up(gaussians: Any, **properties: Any) -> Any:
    """What a texture of a set shows at these points."""
    from eigengs_dr.plugins import texture_of

    return np.array(mitsuba().load_dict(texture_of(gaussians, **properties)).eval(points()))


@entry("lookup at points")
def _() -> Figures:
    mi = mitsuba()
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 30).scale([3, 2, 1])
    sets = [looked_up(plain_set(s), wrap_mode="mirror", to_uv=turned) for s in ("linear", "ycbcr")]
    clamped = looked_up(plain_set("log"), wrap_mode="clamp", to_uv=turned)
    return of_pixels(*sets, clamped, looked_up(plain_set("rgb"), raw=True, cutoff=2.0))


@entry("lookup with a prefilter")
def _() -> Figures:
    angles = [looked_up(plain_set("linear"), prefilter=angle) for angle in (0.003, 0.03, 0.3)]
    return of_pixels(*angles, looked_up(plain_set("ycbcr"), prefilter=0.05, wrap_mode="clamp"))


@entry("lookup in a file: a map, the first Gaussians, a slope, a model")
def _() -> Figures:
    mi, path = mitsuba(), folder() / "material.npz"
    fitted_material().save(path)
    model().save(folder() / "texture-model.npz")
    exact = {"type": "gaussian_texture", "memory": "exact"}
    source = {**exact, "filename": str(path)}
    rough = mi.load_dict({**source, "map": "roughness"})
    albedo = mi.load_dict({**source, "map": "albedo", "first": 100})
    mean = mi.load_dict({**exact, "model": str(folder() / "texture-model.npz")})
    si = points()
    values = rough.eval_1(si), rough.eval_1_grad(si), albedo.eval(si), mean.eval(si)
    return of_pixels(*map(np.array, values))


def of_texture_gradients(prefilter: float) -> Figures:
    """Describe the derivatives of the mean square of lookups, with no bits: sums in any order."""
    from eigengs_dr.plugins import texture_of

    mi = mitsuba()
    texture = mi.load_dict(texture_of(plain_set("linear"), prefilter=prefilter))
    parameters = mi.traverse(texture)
    names = ("mean", "factor", "color", "background")
    for name in names:
        dr.enable_grad(parameters[name])
    parameters.update()
    dr.backward(dr.mean(dr.square(texture.eval(points())), axis=None))
    figures = of_pixels(*(dr.grad(parameters[name]) for name in names))
    return {"rms": figures["rms"]}


@entry("gradients of lookups")
def _() -> Figures:
    return of_texture_gradients(0.0)


@entry("gradients of lookups with a prefilter")
def _() -> Figures:
    return of_texture_gradients(0.05)


def directions(count: int = 400) -> Any:
    """A surface interaction that sees the sky in even directions."""
    mi = mitsuba()
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    sample = np.random.default_rng(1).random((2, count), np.float32)
    si.wi = mi.warp.square_to_uniform_sphere(mi.Point2f(mi.Float(sample[0]), mi.Float(sample[1])))
    return si


@entry("environment")
def _() -> Figures:
    from eigengs_dr.plugins import environment_of

    mi, sky, si = mitsuba(), plain_set("radiance", size=(64, 32)), directions()
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 70)
    plain = mi.load_dict(environment_of(sky, scale=0.5, to_world=turned))
    wide = mi.load_dict(environment_of(sky, prefilter=0.2))
    return of_pixels(*(np.array(emitter.eval(si)) for emitter in (plain, wide)))


@entry("environment, sampled and baked")
def _() -> Figures:
    from eigengs_dr.plugins import bake_environment, environment_of

    mi, sky = mitsuba(), plain_set("radiance", size=(64, 32))
    scene = mi.load_dict({"type": "scene", "sky": environment_of(sky)})
    baked = mi.load_dict({"type": "scene", "sky": bake_environment(sky)})
    sample = np.random.default_rng(2).random((2, 400), np.float32)
    at, where = dr.zeros(mi.SurfaceInteraction3f, 400), mi.Point2f(*map(mi.Float, sample))
    found, weight = scene.environment().sample_direction(at, where)
    seen = baked.environment().eval(directions())
    return of_pixels(np.array(found.d), np.array(found.pdf), np.array(weight), np.array(seen))


def wall(texture: Any, side: int = 24, depth: int = 2) -> Any:
    """A wall under even light, seen by three cameras, one sample per pixel."""
    mi, cameras = mitsuba(), {}
    film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}}
    for number, x in enumerate((-1, 0, 1)):
        view = mi.ScalarTransform4f().look_at([x, 0, 2.6], [0, 0, 0], [0, 1, 0])
        sampler = {"type": "independent", "sample_count": 1}
        camera = {"type": "perspective", "to_world": view, "film": film, "sampler": sampler}
        cameras[f"camera{number}"] = camera
    bsdf = {"type": "diffuse", "reflectance": texture}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": depth},
            "sky": {"type": "constant"},
            "wall": {"type": "rectangle", "bsdf": bsdf},
            **cameras,
        }
    )


def bitmap(pixels: Any) -> dict[str, Any]:
    """A bitmap of linear light."""
    data = mitsuba().TensorXf(np.ascontiguousarray(pixels, np.float32))
    return {"type": "bitmap", "data": data, "raw": True}


PAINT = "wall.bsdf.reflectance"


@entry("scene that follows its camera, rendered and differentiated")
def _() -> Figures:
    from eigengs_dr.plugins import follow, gaussians_of, keep_in_bounds, pixel_angle, texture_of

    mi, g = mitsuba(), plain_set("linear")
    scene = wall(texture_of(g, prefilter=True))
    follow(scene, scene.sensors()[1])
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters[f"{PAINT}.color"])
    parameters.update()
    image = mi.render(scene, parameters, sensor=1, seed=3)
    dr.backward(dr.mean(dr.square(image), axis=None))
    gradient = np.array(dr.grad(parameters[f"{PAINT}.color"]))
    parameters[f"{PAINT}.mean"] = parameters[f"{PAINT}.mean"] * 1.5
    keep_in_bounds(parameters, PAINT, g)
    figures = of_pixels(image, gradient, *gaussians_of(parameters, PAINT, g).to_arrays().values())
    return {"rms": figures["rms"], "angle": pixel_angle(scene.sensors()[1])}


@entry("resident bytes")
def _() -> Figures:
    from eigengs_dr.plugins import environment_of, resident_bytes, texture_of

    made = texture_of(plain_set("linear")), texture_of(plain_set("linear"), prefilter=0.05)
    sky = environment_of(plain_set("radiance", size=(64, 32)))
    return {"bytes": [resident_bytes(mitsuba().load_dict(plugin)) for plugin in (*made, sky)]}


@entry("fit for a scene")
def _() -> Figures:
    scene = wall(bitmap(photo(32)))
    options = {"target_psnr": 32, "iterations": 60, "wrap_mode": "clamp"}
    found = eg.fit_for_scene(scene, PAINT, photo(96), **options)
    return {"found": len(found.gaussians), "psnr": list(found.psnr), "bits": bits(found.gaussians)}


@entry("loss of photos")
def _() -> Figures:
    from eigengs_dr.plugins import photo_loss

    mi, truth = mitsuba(), photo(32) ** 2.2
    seen = wall(bitmap(truth))
    photos = [mi.render(seen, sensor=k, spp=64, seed=7).numpy() for k in range(3)]
    loss = photo_loss(wall(bitmap(np.full((32, 32, 3), 0.5))), PAINT, photos)
    result = fit(loss=loss, size=(32, 32), gaussians=100, iterations=90)
    return {
        "gaussians": len(result.gaussians),
        "space": str(result.gaussians.space),
        "psnr_rough": round(eg.psnr(eg.render(result).numpy(), truth)),
    }


@entry("convert a scene")
def _() -> Figures:
    mitsuba()
    options = {"target_psnr": 30, "iterations": 30, "replace_all": True, "progress": False}
    result = eg.convert_scene(folder() / "room.xml", folder() / "room", **options)
    return {
        "files": " ".join(sorted(path.name for path in result.scene.parent.iterdir())),
        "texels": [(row.width, row.height, row.channels) for row in result.textures],
        "found": [row.gaussians for row in result.textures],
        "psnr": [row.psnr for row in result.textures],
        "psnr_rendered": list(result.psnr),
        "left": " ".join(why for _, why in result.left),
    }


# Files of images.


def write_by_pillow(path: Path, mode: str = "RGB") -> None:
    """Write 8 bits by Pillow."""
    Image.fromarray(np.rint(255 * photo(32)).astype(np.uint8)).convert(mode).save(path)


def write_by_package(path: Path, image: Any = photo, **options: Any) -> None:
    """Write by `save_image`."""
    eg.save_image(path, image(32), **options)


def write_text(path: Path) -> None:
    """Write grey levels up to 1023 as numbers."""
    levels = np.rint(1023 * heights(32)).astype(int)
    path.write_text(f"P2 32 32 1023\n{' '.join(map(str, levels.ravel()))}", encoding="ascii")


FILES = {
    "png of 8 bits": write_by_pillow,
    "png with alpha": partial(write_by_pillow, mode="RGBA"),
    "png of a palette": partial(write_by_pillow, mode="P"),
    "png of 16 bits": partial(write_by_package, bits=16),
    "png of 16 bits, grey": partial(write_by_package, image=heights, bits=16),
    "jpg": write_by_pillow,
    "jpg of CMYK": partial(write_by_pillow, mode="CMYK"),
    "webp": write_by_pillow,
    "avif": write_by_pillow,
    "gif": write_by_pillow,
    "bmp": write_by_pillow,
    "tga": write_by_pillow,
    "jp2": write_by_pillow,
    "tif of 8 bits": write_by_pillow,
    "tif of 16 bits": partial(write_by_package, bits=16),
    "tif of floats": partial(write_by_package, bits=32),
    "exr": write_by_package,
    "exr of 16 bits": partial(write_by_package, bits=16),
    "hdr": write_by_package,
    "pfm": write_by_package,
    "ppm": write_by_pillow,
    "pgm": partial(write_by_pillow, mode="L"),
    "pgm of text": write_text,
}
"""Kinds of files, which begin with their suffixes, and what writes them."""


def read(kind: str) -> Figures:
    """Write a kind of file, read it, and describe its pixels."""
    path = folder() / f"{kind.replace(' ', '-')}.{kind.split()[0]}"
    try:
        FILES[kind](path)
    except (OSError, KeyError) as error:
        raise Skipped(f"this Pillow writes none: {error}") from error
    return of_pixels(eg.load_image(path), eg.load_image(path, keep_grey=True))


for kind in FILES:
    entry(f"read {kind}")(partial(read, kind))


@entry("read a file that is none")
def _() -> Figures:
    try:
        eg.load_image(folder() / "photos" / "damaged.png")
    except eg.ImageError as error:
        return {
            "lines": len(str(error).splitlines()),
            "names the file": str("damaged" in str(error)),
        }
    return {"lines": 0}


# Commands.


def command(line: str, report: str = "") -> tuple[Figures, Any]:
    """Run a command in the folder: its exit code and the keys of its report, and the report.

    It runs in this process, which saves the second in which each program starts. A report is a
    file, or "-", what the command prints; without one, the text that it prints is returned.
    """
    (script,) = entry_points(group="console_scripts", name="eigengs-dr")
    out, err, code = io.StringIO(), io.StringIO(), 0
    patch = mock.patch.object(sys, "argv", ["eigengs-dr", *line.split()])
    here = os.getcwd()
    os.chdir(folder())
    try:
        with redirect_stdout(out), redirect_stderr(err), patch:
            script.load()()
    except SystemExit as end:
        code = end.code or 0
    finally:
        os.chdir(here)
    figures = {"exit code": code, "lines of errors": len(err.getvalue().splitlines())}
    if not report:
        return figures, out.getvalue()
    text = out.getvalue() if report == "-" else (folder() / report).read_text(encoding="utf-8")
    found = json.loads(text)
    return figures | {"report": " ".join(sorted(keys_of(found)))}, found


@entry("command --help")
def _() -> Figures:
    figures, text = command("--help")
    table = text.split("Commands:")[1].splitlines()
    return figures | {"commands": " ".join(line.split()[0] for line in table if line.split())}


@entry("command doctor")
def _() -> Figures:
    figures, report = command("doctor --json", "-")
    return figures | {"report": " ".join(sorted(report))}


@entry("command fit")
def _() -> Figures:
    figures, report = command(
        "fit a.png -o fit.npz --gaussians 200 --iterations 30 --space rgb --seed 3"
        " --backend llvm --preview fit.png --report fit.json --quiet",
        "fit.json",
    )
    g = eg.Gaussians.load(folder() / "fit.npz", BACKEND)
    preview = eg.load_image(folder() / "fit.png")
    return figures | {
        "psnr_rgb": report["psnr_rgb"],
        "preview": str(preview.shape),
        "bits": bits(g),
    }


@entry("command fit, from a basis")
def _() -> Figures:
    return command(
        "fit large.png -o instant.npz --basis natural --iterations 0 --report i.json", "i.json"
    )[0]


@entry("command fit, a folder with a damaged file")
def _() -> Figures:
    figures, _ = command(
        "fit photos -o folder --gaussians 100 --iterations 10 --report folder.json", "folder.json"
    )
    return figures | {"files": " ".join(sorted(p.name for p in (folder() / "folder").iterdir()))}


@entry("command fit, out of reach")
def _() -> Figures:
    return command(
        "fit a.png -o far.npz --target-psnr 60 --max-gaussians 100 --iterations 10"
        " --report far.json",
        "far.json",
    )[0]


@entry("command fit, maps in levels")
def _() -> Figures:
    return command(
        "fit --map albedo=a.png --map height:data=rough.png -o maps.npz --levels 50,150"
        " --iterations 20 --report maps.json",
        "maps.json",
    )[0]


@entry("command fit, blocks")
def _() -> Figures:
    line = "fit a.png -o blocks.npz --blocks 48 --iterations 10 --report blocks.json"
    return command(line, "blocks.json")[0]


@entry("command info")
def _() -> Figures:
    figures, report = command("info plain.npz --json --texture", "-")
    model_figures, _ = command("info natural --json", "-")
    numbers = {key: value for key, value in report.items() if "bytes" in key}
    return figures | {"bytes": numbers, "model": model_figures}


@entry("command pack")
def _() -> Figures:
    line = "pack plain.npz -o plain.egs --max-psnr-drop 0.3 --report pack.json"
    figures, _ = command(line, "pack.json")
    return figures | {"bytes": (folder() / "plain.egs").stat().st_size}


@entry("command render")
def _() -> Figures:
    figures, _ = command("render plain.npz -o large.png --scale 2 --bits 16")
    region, _ = command("render plain.npz -o part.exr --region 8,4,20,16 --size 10 --first 60")
    pictures = [eg.load_image(folder() / name) for name in ("large.png", "part.exr")]
    return figures | {"region": region} | of_pixels(*pictures)


@entry("command view")
def _() -> Figures:
    figures, _ = command("view plain.npz -o plain.html --levels 2")
    return figures | {"page": str((folder() / "plain.html").exists())}


@entry("command train")
def _() -> Figures:
    path = folder() / "family"
    path.mkdir(exist_ok=True)
    for number, image in enumerate(family(12)):
        eg.save_image(path / f"{number:02d}.png", image)
    figures, _ = command(
        "train family -o trained.npz --size 32x32 --components 6 --gaussians 60 --report t.json",
        "t.json",
    )
    trained = eg.EigenGS.load(folder() / "trained.npz", BACKEND)
    return figures | {"bits": bits(trained.gaussians, *trained.weights)}


@entry("command scene")
def _() -> Figures:
    package("mitsuba")
    scene = ROOM.replace('type="bitmap"', 'type="gaussian_texture"').replace("a.png", "plain.npz")
    (folder() / "set.xml").write_text(scene, encoding="utf-8")
    figures, _ = command(f"scene set.xml -o set.exr --spp 16 --variant {VARIANT}")
    pixels = of_pixels(eg.load_image(folder() / "set.exr"))
    return figures | {"shape": pixels["shape"], "rms": pixels["rms"]}


@entry("command convert")
def _() -> Figures:
    package("mitsuba")
    return command(
        "convert room.xml -o new --target-psnr 20 --iterations 20 --replace-all"
        f" --report new.json --variant {VARIANT}",
        "new.json",
    )[0]


@entry("commands that are refused")
def _() -> Figures:
    lines = ("fit none.png", "fit a.png --gaussians x", "render none.npz -o x.png", "paint")
    return {line: command(line)[0] for line in lines}


# The comparison.


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """Give every number and text of nested figures a name of its own, without nan: not measured."""
    items: Any = ()
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    elif isinstance(value, (float, np.floating)):
        return {} if math.isnan(value) else {name: float(f"{value:.7g}")}
    else:
        return {name: int(value) if isinstance(value, np.integer) else value}
    return {k: v for key, item in items for k, v in flat(item, f"{name} {key}".strip()).items()}


def tolerated(name: str, old: Any, new: Any) -> bool:
    """Whether a figure is within the tolerance of its kind, which the name begins with."""
    if isinstance(old, str) or isinstance(new, str) or old is None or new is None:
        return bool(old == new)
    if name.startswith("psnr"):
        return bool(new >= old - PSNR)
    if name.startswith("loss"):
        return bool(new <= old * (1 + LOSS))
    share = SIZE if name.startswith(("bytes", "found")) else NUMBER
    return bool(abs(new - old) <= share * abs(old))


def verdict(old: dict[str, Any] | None, new: dict[str, Any]) -> str:
    """Compare the figures of an entry with those recorded."""
    if old is None:
        return "DIFFERS nothing -> a new entry"
    if old == new:
        return "equal bits" if "bits" in new else "equal"
    moved = {
        name: f"{name} {old.get(name, 'nothing')} -> {new.get(name, 'nothing')}"
        for name in {**old, **new}
        if old.get(name) != new.get(name) and name != "bits"
    }
    wrong = [
        text for name, text in moved.items() if not tolerated(name, old.get(name), new.get(name))
    ]
    if wrong:
        return "DIFFERS " + "; ".join(wrong)
    return "within " + ("; ".join(moved.values()) or "all figures, other bits")


def measure(name: str) -> Figures:
    """Run an entry."""
    gc.collect()  # Mitsuba traces the textures of every scene that is alive
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return flat(ENTRIES[name]())


def machine() -> dict[str, Any]:
    """Describe the machine, on which bits depend."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if sys.platform == "linux" else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor()
    return {"processor": processor, "cores": os.cpu_count(), "system": platform.system()}


def versions() -> dict[str, str]:
    """Find the versions of what computes, and libLLVM."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    _, doctor = command("doctor --json", "-")
    return found | {"libLLVM": doctor["libllvm_path"]}


def commit() -> str:
    """Name the commit of the code, if git knows it."""
    words = ["git", "rev-parse", "HEAD"]
    done = subprocess.run(words, cwd=EXPECTED.parent, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def main(words: Sequence[str] | None = None) -> int:
    """Run entries, print a line for each, and return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", metavar="NAME", help="a part of the names of entries")
    parser.add_argument("--write", action="store_true", help="record what is found")
    options = parser.parse_args(words)
    recorded = json.loads(EXPECTED.read_text(encoding="utf-8")) if EXPECTED.exists() else {}
    expected = recorded.get("entries", {})
    names = [name for name in ENTRIES if options.only in name]
    if not names:
        parser.error(f"no entry has {options.only!r} in its name")
    found, failed = {}, 0
    if not options.write and recorded.get("machine") != machine():
        print(f"recorded on another machine, where fits end otherwise: {recorded.get('machine')}")
    for name in tqdm(names, disable=None, leave=False):
        try:
            figures = measure(name)
        except Skipped as reason:
            line = f"skipped: {reason}"
        except Exception as error:  # of one entry; the others still run
            line = f"DIFFERS raised {type(error).__name__}: {error}"
        else:
            found[name] = figures
            line = "recorded" if options.write else verdict(expected.get(name), figures)
        failed += line.startswith("DIFFERS")
        tqdm.write(f"{name}: {line}")
        sys.stdout.flush()
    if options.write:
        kept = {name: (expected | found)[name] for name in ENTRIES if name in expected | found}
        text = json.dumps(
            {"machine": machine(), "versions": versions(), "commit": commit(), "entries": kept},
            indent=1,
        )
        EXPECTED.write_text(text + "\n", encoding="utf-8")
    print(f"{len(names)} entries, {failed} differ; {sum(os.times()[:4]):.0f} CPU seconds")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
