"""Compose pictures of README.md and how-to pages: ``python tools/manual/pictures.py``.

``python tools/manual/pictures.py view number`` writes these alone. All of them show photos that
scikit-image ships. They take five minutes on two cores; "view" needs Chromium.
"""

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import eigengs_dr as eg  # isort: skip  (before Dr.Jit: it finds libLLVM)
import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

from eigengs_bench.subjects import bitmap, grey, load_scene
from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.image.resize import center_crop, resample
from eigengs_dr.image.sheet import text_line
from eigengs_dr.plugins import keep_in_bounds, photo_loss, texture_of
from eigengs_dr.viewer.pictures import overlay

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "scenes"))
import plane  # noqa: E402, isort: skip

IMAGES = ROOT / "docs" / "images"
WIDTH, GAP = 840, 6  # pixels: of a whole picture, and white between two
APART = ((0, GAP), (0, GAP), (0, 0))  # around a picture
LETTERS = 22  # pixels: they can be read where the picture is shown half as wide
ON_PHONES = 30  # pixels: 12 of a screen of 390, for the front page
MAX_BYTES = 60_000
CAMERAS, SLOT = 6, "poster.bsdf.reflectance"  # of the photos of a poster; what they recover
ERROR_GAIN = 4  # errors are shown as absolute differences of sRGB values, times this

Row = dict[str, np.ndarray]
"""Pictures side by side, by what is written above them."""


def main(names: list[str]) -> None:
    """Make each picture and write it."""
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    for name in names or PICTURES:
        write(name, PICTURES[name]())


def cat() -> np.ndarray:
    """Return the face of a cat, 240 x 240 pixels."""
    return eg.sample("chelsea")[20:260, 90:330]


def error(image: np.ndarray, photo: np.ndarray, gain: float = ERROR_GAIN) -> np.ndarray:
    """Return the absolute difference of two pictures, magnified."""
    return gain * abs(image - photo)


def levels() -> list[Row]:
    """Render the first 78, 312, 1,250 and 5,000 Gaussians of one set."""
    counts = eg.level_counts(5000, 4)
    gaussians = eg.fit(cat(), counts).gaussians
    return [{f"first {count:,}": eg.picture_of(gaussians[:count]) for count in counts}]


def numbers() -> list[Row]:
    """Fit three numbers of Gaussians; the second row has their errors."""
    fits = {count: eg.fit(cat(), count).image.clip(0, 1) for count in (300, 1200, 4800)}
    return [
        {f"{count:,} Gaussians": fit for count, fit in fits.items()},
        {f"error of {count:,} x {ERROR_GAIN}": error(fit, cat()) for count, fit in fits.items()},
    ]


def seams() -> list[Row]:
    """Fit blocks each for itself, and by `eigengs_dr.fit_large`, around the corner of four."""
    side, pixels = 128, 150  # of a block, and for each Gaussian
    photo = eg.sample("astronaut")
    alone, borders = np.empty_like(photo), photo.copy()
    for top, left in np.ndindex(4, 4):
        part = np.s_[side * top : side * (top + 1), side * left : side * (left + 1)]
        alone[part] = eg.fit(photo[part], side**2 // pixels, iterations=300).image
    for start in range(side, 512, side):
        borders[start - 1 : start + 1] = borders[:, start - 1 : start + 1] = 1
    count = photo[..., 0].size // pixels
    large = eg.picture_of(
        eg.fit_large(photo, gaussians=count, iterations=300, block=side).gaussians
    )
    near = np.s_[88:168, 216:296]
    return [
        {
            "blocks": borders,
            "photo": photo[near],
            "each alone": alone[near],
            "fit_large": large[near],
        }
    ]


def foveated() -> list[Row]:
    """Fit a photo, and fit it with a foveated loss, like that of the page, around the left eye."""
    photo = cat()
    y, x = np.indices(photo.shape[:2]) - np.array([110, 70])[:, None, None]
    fovea = np.exp(-(x**2 + y**2) / (2 * 45**2))[..., None].astype(np.float32)
    plain = eg.fit(photo, 600, space="rgb")
    tensor = type(eg.render(plain.gaussians))
    weight, wanted = tensor(fovea), tensor(photo)

    def loss(picture: dr.ArrayBase, step: int) -> dr.ArrayBase:
        error = picture - wanted
        blocks = dr.mean(dr.reshape(error, (30, 8, 30, 8, 3)), axis=(1, 3))
        near = dr.mean(weight * dr.square(error), axis=None)
        return near + 0.2 * dr.mean(dr.square(blocks), axis=None)

    sharp = eg.fit(photo, 600, space="rgb", loss=loss)
    weights = np.repeat(fovea, 3, 2)
    return [
        {"photo": photo, "weight": weights, "squared error": plain.image, "your loss": sharp.image}
    ]


def strokes() -> list[Row]:
    """Hide strokes of a photo, and fit it without them."""
    photo = cat()
    y, x = np.indices(photo.shape[:2])
    hidden = ((x + y) % 40 < 8) | ((x - y) % 40 < 8)
    weight = np.where(hidden, 0, 1).astype(np.float32)
    result = eg.fit(np.where(hidden[..., None], np.nan, photo), 1500, weight=weight)
    shown = np.where(hidden[..., None], 1, photo)
    return [{"photo": shown, "weight": np.repeat(weight[..., None], 3, 2), "fit": result.image}]


def cutoffs() -> list[Row]:
    """Render some Gaussians with three cutoffs, and magnify what each cuts off."""
    photo = cat()
    gaussians = eg.fit(photo, 40, method=replace(eg.DEFAULT, cutoff=8.0)).gaussians
    whole = eg.picture_of(gaussians)
    cut = {c: eg.picture_of(replace(gaussians, cutoff=float(c))) for c in (2, 3, 4)}
    return [
        {f"cutoff {c}": picture for c, picture in cut.items()},
        {f"cut off at {c}, x 10": error(picture, whole, 10) for c, picture in cut.items()},
    ]


def spaces() -> list[Row]:
    """Fit a photo with dark parts in three spaces of colours; the second row has their errors."""
    photo = eg.sample("astronaut")[:240, 100:340]
    fits = {s: eg.fit(photo, 600, space=s).image.clip(0, 1) for s in ("ycbcr", "rgb", "linear")}
    return [
        {f'space="{space}"': fit for space, fit in fits.items()},
        {f"error of {s} x {ERROR_GAIN}": error(fit, photo) for s, fit in fits.items()},
    ]


def many() -> list[Row]:
    """Fit eight photos in one call."""
    side = (WIDTH + GAP) // 4 - GAP
    names = ("astronaut", "brick", "chelsea", "coffee", "hubble", "motorcycle", "retina", "rocket")
    photos = [center_crop(eg.sample(name), side, side) for name in names]
    rows = eg.fit_many(photos, gaussians=2000, iterations=300)
    fits = [row.result.image for row in rows]
    return [dict(zip(names[k : k + 4], fits[k : k + 4], strict=True)) for k in (0, 4)]


def relight() -> list[Row]:
    """Relight a relief of bricks, a made-up object, beside its formula."""
    height = gaussian_filter(center_crop(eg.sample("brick"), 240, 240)[..., 0], 2) * 40
    dy, dx = np.gradient(height)
    normal = np.stack([-dx, dy, np.ones_like(dx)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = np.array([0.75, 0.5, 0.4])

    def photo(light: np.ndarray) -> np.ndarray:
        half = light + np.array([0, 0, 1])
        shine = np.maximum(normal @ (half / np.linalg.norm(half)), 0) ** 30
        shaded = np.maximum(normal @ light, 0)[..., None] * albedo + 0.2 * shine[..., None]
        return to_coded(np.clip(shaded, 0, 1).astype(np.float32))

    z, turn = np.linspace(0.98, 0.3, 40), np.arange(40) * 2.4
    ring = np.sqrt(1 - z**2)
    lights = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)
    photos = np.stack([photo(light) for light in lights])
    model = eg.Relightable.fit(photos, lights, encoding="srgb")
    unseen = {"left": (-0.8, 0, 0.6), "above": (0, 0.6, 0.8), "right": (0.8, 0, 0.6)}
    return [
        {f"light {name}": photo(np.array(light)) for name, light in unseen.items()},
        {f"{name}, model": eg.picture_of(model.relight(d)) for name, d in unseen.items()},
    ]


def family() -> list[np.ndarray]:
    """Return 400 views of a cat, shifted and magnified, 64 x 64 pixels each."""
    photo, random, views = eg.sample("chelsea"), np.random.default_rng(0), []
    for _ in range(400):
        side = random.integers(160, 240)
        top, left = random.integers(0, 300 - side), random.integers(60, 330 - side)
        view = np.ascontiguousarray(photo[top : top + side, left : left + side])
        views.append(resample(view, 64, 64))
    return views


def components() -> list[Row]:
    """Encode a new view of a family with three numbers of components."""
    new, *known = family()
    row = {"new image": new}
    for count in (10, 40, 160):
        basis = eg.Eigenbasis.from_images(known, size=(64, 64), components=count)
        model = eg.EigenGS.fit(basis, gaussians=2000)
        row[f"{count} components"] = eg.picture_of(model.encode(new, colors="projected"))
    return [row]


def split() -> list[Row]:
    """Encode a new view of a family by a model with a split, and render both sides."""
    new, *known = family()
    basis = eg.Eigenbasis.from_images(known, size=(64, 64), components=150)
    model = eg.EigenGS.fit(basis, gaussians=2000, frequency_aware=True)
    gaussians = model.encode(new)
    low, high = gaussians[: model.low], gaussians[model.low :]
    grey = replace(high, background=type(high.background)(0.5, 0.5, 0.5))
    return [
        {
            "new image": new,
            f"{len(low)} low": eg.picture_of(low),
            f"{len(high):,} high": eg.picture_of(grey),
            "all of them": eg.picture_of(gaussians),
        }
    ]


def aliasing() -> list[Row]:
    """Render the floor of scenes/plane.py: a bitmap, Gaussians at points, and the prefilter."""
    plane.write_sets()
    kinds = {"bitmap": {"bitmap": True}, "Gaussians": {}, "prefilter": {"prefilter": True}}
    scenes = {kind: plane.load("floor", 410, **settings) for kind, settings in kinds.items()}
    row = {kind: plane.image_of(scene, 1, 0) for kind, scene in scenes.items()}
    row["1,024 samples"] = plane.image_of(scenes["Gaussians"], 1024, 1)
    return [{kind: to_coded(picture)[84:289, 102:307] for kind, picture in row.items()}]


def descent() -> list[Row]:
    """Descend from the Gaussians of one photo until a wall looks like a rendering of another."""
    start, other = (
        eg.fit(center_crop(eg.sample(name), 192, 192), 2000, 300, space="linear").gaussians
        for name in ("coffee", "chelsea")
    )
    goal = mi.render(wall_of(other), spp=64)
    scene = wall_of(start)
    rates = {f"{SLOT}.mean": 0.5, f"{SLOT}.factor": 0.01, f"{SLOT}.color": 0.03}
    parameters = mi.traverse(scene)
    adam = mi.ad.Adam(lr=0.01, params={name: parameters[name] for name in rates})
    adam.set_learning_rate(rates)
    row = {"start": mi.render(scene, spp=64)}
    for step in range(1, 81):
        parameters.update(adam)
        picture = mi.render(scene, parameters, spp=8, seed=step)
        dr.backward(dr.mean(dr.square(picture - goal), axis=None))
        adam.step()
        parameters.update(adam)
        keep_in_bounds(parameters, SLOT, start)
        adam.update({name: parameters[name] for name in rates})
        if step in (20, 80):
            row[f"{step} steps"] = mi.render(scene, spp=64)
    row["goal"] = goal
    return [{label: to_coded(picture.numpy()) for label, picture in row.items()}]


def wall_of(gaussians: eg.Gaussians) -> "mi.Scene":
    """Return a poster with Gaussians, seen from the side."""
    return load_scene(mi, "poster", {"color": texture_of(gaussians)}, 3)


def overview() -> list[Row]:
    """Show a photo and its Gaussians, a view that no photo of a scene shows, and three lights."""
    photo = eg.sample("coffee")[:400, 120:520]
    few = eg.fit(photo, 1500).gaussians
    known, unknown = (
        load_scene(mi, "poster", {"color": bitmap(mi, texels)}, CAMERAS)
        for texels in (np.float32(to_linear(photo)), grey("poster", "color"))
    )
    for scene in (known, unknown):
        parameters = mi.traverse(scene)
        parameters["camera00.film.size"] = [256, 256]  # the one film of all cameras
        parameters.update()
    photos = [mi.render(known, sensor=k, spp=64, seed=k).numpy() for k in range(CAMERAS)]
    loss = photo_loss(unknown, SLOT, photos, sensors=range(CAMERAS))
    found = eg.fit(loss=loss, size=(256, 256), iterations=480, space="linear").gaussians
    recovered = load_scene(mi, "poster", {"color": texture_of(found, wrap_mode="clamp")}, CAMERAS)
    view = mi.ScalarTransform4f().look_at([1.9, 0.5, 3.1], [0.05, -0.12, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "pixel_format": "rgb", "width": 300, "height": 300}
    side = mi.load_dict({"type": "perspective", "fov": 40, "to_world": view, "film": film})
    truth, ours = (
        to_coded(mi.render(scene, sensor=side, spp=512).numpy()) for scene in (known, recovered)
    )
    print(f"recovered from {CAMERAS} photos: psnr_rgb {eg.psnr(truth.clip(0, 1), ours):.1f} dB")
    return [
        {
            "photo": photo,
            "Gaussians": overlay(few, eg.picture_of(few, width=800)),
            "unseen view": truth,
            "recovered": ours,
        },
        {f"light {name.split(',')[0]}": picture for name, picture in relight()[1].items()},
    ]


def browser() -> list[Row]:
    """Take a picture of the page of `eigengs_dr.view` in Chromium, near an eye of the cat."""
    from playwright.sync_api import sync_playwright

    photo = cat()
    page = eg.view(eg.fit(photo, 3000), photo, title="A cat")
    program = shutil.which("chromium")
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with TemporaryDirectory() as folder, sync_playwright() as driver:
        path = Path(folder) / "cat.html"
        page.save(path)
        window = driver.chromium.launch(executable_path=program, args=flags)
        tab = window.new_page(viewport={"width": WIDTH, "height": 420}, color_scheme="light")
        tab.goto(path.as_uri())
        tab.wait_for_timeout(3000)
        tab.check("#compare")
        tab.check("#outlines")
        tab.mouse.move(180, 190)
        for _ in range(2):
            tab.mouse.wheel(0, -300)
            tab.wait_for_timeout(300)
        tab.wait_for_timeout(2000)
        shot = np.asarray(Image.open(BytesIO(tab.screenshot())).convert("RGB"))
        window.close()
    return [{"": shot / 255}]


def write(name: str, rows: list[Row]) -> None:
    """Write rows of pictures as one, as well as fits in `MAX_BYTES`."""
    lines, letters = [], ON_PHONES if name == "teaser" else LETTERS
    for row in rows:
        width = (WIDTH + GAP) // len(row) - GAP
        cells = [
            labelled(label, cell_of(picture, width), letters) for label, picture in row.items()
        ]
        line = np.concatenate([np.pad(cell, APART, constant_values=255) for cell in cells], axis=1)
        margin = WIDTH + GAP - line.shape[1]
        lines.append(np.pad(line, ((0, 0), (0, margin), (0, 0)), constant_values=255))
    picture = Image.fromarray(np.concatenate(lines)[:-GAP, :-GAP])
    path = IMAGES / ("teaser.jpg" if name == "teaser" else f"how-to-{name}.jpg")
    for quality in range(85, 0, -5):
        picture.save(path, quality=quality, optimize=True)
        if path.stat().st_size <= MAX_BYTES:
            break


def labelled(label: str, cell: np.ndarray, letters: int) -> np.ndarray:
    """Write what a picture is above it."""
    if not label:
        return cell
    return np.concatenate([np.uint8(255 * text_line(label, cell.shape[1], letters)), cell])


def cell_of(picture: np.ndarray, width: int) -> np.ndarray:
    """Bring a picture to the width of a cell; pixels that are magnified stay squares."""
    codes = Image.fromarray(np.uint8(255 * picture.clip(0, 1) + 0.5))
    is_magnified = codes.width < width
    resampling = Image.Resampling.NEAREST if is_magnified else Image.Resampling.LANCZOS
    size = (width, round(codes.height * width / codes.width))
    return np.asarray(codes.resize(size, resampling))


PICTURES: dict[str, Callable[[], list[Row]]] = {
    "levels": levels,
    "number": numbers,
    "blocks": seams,
    "own-loss": foveated,
    "weights": strokes,
    "cutoff": cutoffs,
    "color": spaces,
    "many": many,
    "components": components,
    "split": split,
    "relight": relight,
    "prefilter": aliasing,
    "differentiate": descent,
    "view": browser,
    "teaser": overview,
}

if __name__ == "__main__":
    main(sys.argv[1:])
