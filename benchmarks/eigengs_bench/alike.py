"""Bitmaps and Gaussians that look alike in Mitsuba: what they take, as posters and as lights.

A poster of `TEXELS` x `TEXELS` texels fills the width of a film of half as many pixels. The
smallest bitmap and the smallest set of Gaussians are searched whose pictures reach 40 dB against
that of the poster, or 30 dB for a text: in 8 bits of sRGB, or of values for maps of one channel.
Pixels beside the poster do not count. The light is even, so that pictures have no noise.

A light stands beside the ``envmap`` of its bitmap, over a ball on a floor. Its set is a fit of
logarithms for a PSNR of 40 dB, at twice the size of the bitmap.
"""

from collections.abc import Callable, Iterator
from functools import partial
from math import sqrt
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from scipy.ndimage import zoom

import eigengs_dr as eg
from eigengs_bench.clock import Image, interleaved_apart
from eigengs_bench.rows import Job, Row
from eigengs_dr.cli.scene import load_mitsuba
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.resize import center_crop, resample

SPP, GOAL = 16, 40.0  # samples per pixel; dB

# ---------------------------------------------------------------------------------------------
#  Posters
# ---------------------------------------------------------------------------------------------

TEXELS, PIXELS, TEXT_GOAL = 1024, 512, 30.0  # sharp letters take too many Gaussians for 40 dB
FINE = 1.03  # ratio of the sides of two bitmaps at which a search ends
PHOTOS = ("astronaut", "chelsea", "coffee", "retina", "rocket")
MAPS = ("brick", "gravel")  # of one channel, from scikit-image
SCANS = ("bark", "onyx", "rustymetal")  # colours, in the folder "textures" of DATA
SLOT = "poster.bsdf.reflectance"
PANGRAMS = (
    "The quick brown fox jumps over the lazy dog. Sphinx of black quartz, judge my vow. "
    "Pack my box with five dozen liquor jugs. "
)


class Poster(NamedTuple):
    """The image of a poster, `TEXELS` x `TEXELS`; the space of its Gaussians; the PSNR in dB."""

    kind: str
    image: Image
    space: str
    goal: float


def posters(data: Path | None) -> Iterator[tuple[str, Callable[[], Poster]]]:
    """Yield the names of the posters and functions that load them: photos, materials, a text."""
    for name in PHOTOS:
        yield name, partial(_poster, "photo", partial(eg.sample, name), "linear")
    for name in MAPS:
        yield name, partial(_poster, "material", partial(eg.sample, name), "data")
    for name in SCANS if data else ():
        file = Path(data or "") / "textures" / name / "albedo.jpg"
        yield name, partial(_poster, "material", partial(eg.load_image, file), "linear")
    yield "text", lambda: Poster("text", letters(TEXELS), "data", TEXT_GOAL)


def _poster(kind: str, load: Callable[[], Image], space: str) -> Poster:
    """Load an image for a poster; of maps, the first channel."""
    image = center_crop(load(), TEXELS, TEXELS).clip(0, 1)
    return Poster(kind, image[..., :1] if space == "data" else image, space, GOAL)


def letters(side: int) -> Image:
    """Draw black letters on white, shape (side, side, 1), in lines of a 32nd of the side."""
    from PIL import Image as pillow
    from PIL import ImageDraw, ImageFont

    page, font = pillow.new("L", (side, side), 255), ImageFont.load_default(side // 32)
    words = PANGRAMS * 12
    for line in range(20):
        place = side // 16, side // 16 + line * side // 23
        ImageDraw.Draw(page).text(place, words[64 * line : 64 * line + 64], 0, font)
    return np.asarray(page, np.float32)[..., None] / np.float32(255)


def jobs_of_posters(variant: str, data: Path | None) -> Iterator[Job]:
    """Yield the measurement of each poster."""
    for name, load in posters(data):
        yield {"variant": variant, "poster": name}, partial(compare_poster, variant, load)


def compare_poster(variant: str, load: Callable[[], Poster]) -> Row:
    """Find the smallest bitmap and the fewest Gaussians that look like a poster.

    Returns
    -------
    dict
        `kind`; `side` of the bitmap in texels, and `gaussians`; `psnr_bitmap` and `psnr` of their
        pictures; `bitmap_bytes` and `bytes` that they hold in memory between renderings,
        `filtered_bytes` with a prefilter, `small_bytes` with `memory="small"`; `ratio` and
        `ratio_small`, of the bytes of Gaussians over those of the bitmap of 8 bits.
    """
    mi = load_mitsuba(variant, quiet=False)
    from eigengs_dr.plugins import resident_bytes

    poster = load()
    goal = picture(mi, bitmap(mi, poster.image))
    inside = 1.0 * (picture(mi, {"type": "rgb", "value": 0.5})[..., 0] < 0.75)

    def psnr(texture: dict[str, Any]) -> float:
        rendering = picture(mi, texture)
        if poster.space == "data":
            return eg.psnr(rendering, goal, "data", weight=inside)
        return eg.psnr(to_coded(rendering), to_coded(goal), "rgb", weight=inside)

    side = _smallest_side(lambda n: psnr(bitmap(mi, resample(poster.image, n, n))) >= poster.goal)
    small = bitmap(mi, resample(poster.image, side, side))
    row: Row = {"kind": poster.kind, "side": side, "psnr_bitmap": psnr(small)}
    small = bitmap(mi, resample(poster.image, side, side))
    row["bitmap_bytes"] = resident_bytes(mi.load_dict(small))
    scene, target_psnr = hung(mi, bitmap(mi, poster.image)), poster.goal
    with TemporaryDirectory() as folder:
        file = {"type": "gaussian_texture", "filename": f"{folder}/poster.npz"}
        while row.get("psnr", 0.0) < poster.goal:  # of few Gaussians, many searches find as many
            fit = eg.fit_for_scene(scene, SLOT, poster.image, target_psnr, poster.space)
            fit.gaussians.save(file["filename"])
            row |= {"gaussians": len(fit.gaussians), "psnr": psnr(file)}
            target_psnr += poster.goal - row["psnr"] + 0.05
        row["bytes"] = resident_bytes(mi.load_dict(file))
        row["filtered_bytes"] = resident_bytes(mi.load_dict(file | {"prefilter": 1e-3}))
        row["small_bytes"] = resident_bytes(mi.load_dict(file | {"memory": "small"}))
    ratios = {"ratio": "bytes", "ratio_small": "small_bytes"}
    return row | {name: row[held] / row["bitmap_bytes"] for name, held in ratios.items()}


def _smallest_side(suffices: Callable[[int], bool]) -> int:
    """Return the smallest side in texels with which a bitmap suffices."""
    few, enough = 16, TEXELS
    while enough > max(FINE * few, few + 1):
        side = round(sqrt(few * enough))
        few, enough = (few, side) if suffices(side) else (side, enough)
    return enough


def bitmap(mi: Any, image: Image) -> dict[str, Any]:
    """Return an image as an 8-bit bitmap: sRGB, or values of one channel."""
    codes = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return {"type": "bitmap", "bitmap": mi.Bitmap(codes), "raw": image.shape[2] == 1}


def hung(mi: Any, texture: dict[str, Any]) -> Any:
    """Load the poster, which lies on the ground, and a camera above one side.

    Under a sky of 1 a diffuse poster shows its texture, without noise.
    """
    at = mi.ScalarTransform4f().look_at([0, -2.75, 2.35], [0, -0.12, 0], [0, 0, 1])
    even = {"sampler": {"type": "stratified", "sample_count": SPP}}
    scene = {
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
        "sensor": camera(mi, PIXELS, SPP, 42, at) | even,
        "poster": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
    }
    return mi.load_dict(scene)


def picture(mi: Any, texture: dict[str, Any]) -> Image:
    """Render the poster with a texture; linear, shape (H, W, 3)."""
    return np.clip(np.array(mi.render(hung(mi, texture), spp=SPP, seed=0)), 0, 1)


# ---------------------------------------------------------------------------------------------
#  Lights
# ---------------------------------------------------------------------------------------------

ROWS, SIDE, STEPS = 256, 128, 100  # of the bitmap, twice as wide; of the film; of the fit
SEEDS, LOOKUPS = 32, 1 << 18  # renderings of each light; directions that are even over the sphere
WARM_UP, ROUNDS = 2, 9
EXPOSURE = 0.3  # mean of a picture before it is coded


def clouds(rows: int) -> Image:
    """Draw clouds in a sky over a ground, with a sun of light 5,000, shape (rows, 2 rows, 3)."""
    theta, phi = _angles(rows)
    up = 1 / (1 + np.exp(20 * (theta - np.pi / 2)))
    haze = np.exp(-np.square((theta - np.pi / 2) / 0.3))[..., None]
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    waves = np.random.default_rng(0).normal(size=(40, 3)) * np.linspace(2, 16, 40)[:, None]
    cover = sum(np.sin(a * x + b * y + c * z + k) / (2 + k) for k, (a, b, c) in enumerate(waves))
    white = 1 / (1 + np.exp(-6 * (cover - 0.3)))[..., None]
    sky = (np.array([0.12, 0.25, 0.5]) + haze * [0.3, 0.2, 0.1]) * (1 - white) + 0.7 * white
    light = up[..., None] * sky + (1 - up)[..., None] * [0.25, 0.2, 0.15]
    away = np.square(theta - 0.9) + np.square((phi - 2) * np.sin(0.9))
    return np.float32(light + 5000 * np.exp(-away / (2 * 0.03**2))[..., None] * [1, 0.9, 0.8])


def room(rows: int) -> Image:
    """Draw dark walls with four windows of light 8 to 20, and a lamp of 60 above."""
    theta, phi = _angles(rows)
    light = (0.05 + 0.25 * np.sin(theta) ** 2)[..., None] * [1, 0.85, 0.7]
    for k in range(4):
        x, y = abs(phi - 1 - 1.3 * k) / 0.3, abs(theta - 1.4) / 0.4
        light[(np.maximum(x, y) < 1) & (np.minimum(x, y) > 0.1)] = np.array([8, 10, 13]) * (
            1 + 0.17 * k
        )
    light[theta < 0.25] = [60, 50, 36]
    return np.float32(light)


def _angles(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles of texels to the zenith, and around it."""
    theta, phi = np.mgrid[:rows, : 2 * rows] * np.pi / rows
    return theta + np.pi / (2 * rows), phi + np.pi / (2 * rows)


LIGHTS = {"clouds": clouds, "room": room}


def jobs_of_lights(variant: str) -> Iterator[Job]:
    """Yield what measures each light."""
    for name in LIGHTS:
        yield {"variant": variant, "light": name}, partial(compare_light, variant, name)


def compare_light(variant: str, name: str) -> Row:
    """Compare a light as Gaussians with its bitmap.

    Returns
    -------
    dict
        `gaussians`; `lookups`, the PSNR of lookups in 8-bit sRGB, and `images`, that of pictures of
        the ball without their noise; `mean`, the largest difference of a channel's mean over the
        sphere, as a part of it; `variance`, of a pixel at equal samples, and `ratio`, the time of a
        picture, both over those of the bitmap; `bytes` and `bitmap_bytes` that are held.
    """
    mi = load_mitsuba(variant, quiet=False)
    from eigengs_dr.plugins import environment_of, resident_bytes

    light = LIGHTS[name](ROWS)
    bitmap = {"type": "envmap", "bitmap": mi.Bitmap(light)}
    held = resident_bytes(mi.load_dict(bitmap))
    finer = zoom(light, (2, 2, 1), order=1, mode="nearest", grid_mode=True)
    fitted = eg.fit(finer, target_psnr=GOAL, iterations=STEPS, space="log", encoding="linear")
    gaussians = fitted.gaussians.scaled(2 * ROWS, ROWS)
    sums = environment_of(gaussians)
    true, seen = (lookups(mi, emitter) for emitter in (bitmap, sums))
    before, after = (pictures(mi, lit(mi, emitter, SIDE)) for emitter in (bitmap, sums))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "light.npz"
        gaussians.save(path)
        shown = partial(_picture, variant, SIDE)
        makers = {"bitmap": partial(shown, light), "gaussians": partial(shown, path)}
        timed = interleaved_apart(makers, WARM_UP, ROUNDS)
        file = {"type": "gaussian_environment", "filename": str(path)}
        bytes_held = resident_bytes(mi.load_dict(file))
    variances = [np.var(shown, axis=0, ddof=1).mean() for shown in (before, after)]
    return {
        "gaussians": len(gaussians),
        "lookups": eg.psnr(to_coded(seen), to_coded(true), "rgb"),
        "images": psnr_without_noise(after, before),
        "mean": float(abs(seen.mean(axis=(0, 1)) / true.mean(axis=(0, 1)) - 1).max()),
        "variance": float(variances[1] / variances[0]),
        **{f"{key}_ms": ms for key, ms in timed.items()},
        "ratio": timed["gaussians"] / timed["bitmap"],
        "bytes": bytes_held,
        "bitmap_bytes": held,
    }


def _picture(variant: str, side: int, light: Image | Path) -> Callable[[], Any]:
    """Return what renders the ball under a light: a bitmap, or the file of a set."""
    mi = load_mitsuba(variant, quiet=False)
    emitter = {"type": "gaussian_environment", "filename": str(light)}
    if not isinstance(light, Path):
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(light)}
    return partial(mi.render, lit(mi, emitter, side))


def lookups(mi: Any, emitter: dict[str, Any]) -> Image:
    """Return the light from directions that are even over the sphere, shape (1, LOOKUPS, 3)."""
    k = np.arange(LOOKUPS) + 0.5
    height, around = 1 - 2 * k / LOOKUPS, np.pi * (3 - np.sqrt(5)) * k  # a Fibonacci spiral
    beside = np.sqrt(1 - np.square(height))
    d = [beside * np.cos(around), height, beside * np.sin(around)]
    si = dr.zeros(mi.SurfaceInteraction3f, LOOKUPS)
    si.wi = -mi.Vector3f(*(mi.Float(np.float32(axis)) for axis in d))
    return np.array(mi.load_dict(emitter).eval(si)).T[None]


def pictures(mi: Any, scene: Any) -> Image:
    """Render a scene by other random numbers again and again, shape (SEEDS, H, W, 3)."""
    return np.stack([mi.render(scene, seed=seed).numpy() for seed in range(SEEDS)])


def psnr_without_noise(found: Image, true: Image) -> float:
    """Return a PSNR in dB in sRGB of pictures whose first axis are independent renderings.

    The product of the differences of two halves has the square of their mean as its mean.
    """
    scale = EXPOSURE / true.mean()
    halves = (slice(0, None, 2), slice(1, None, 2))
    coded = [
        [to_coded((scale * shown[half].mean(axis=0)).clip(0, 1)) for half in halves]
        for shown in (found, true)
    ]
    error = np.mean((coded[0][0] - coded[1][0]) * (coded[0][1] - coded[1][1]))
    return float(-10 * np.log10(max(error, 1e-10)))


def lit(mi: Any, emitter: dict[str, Any], side: int) -> Any:
    """Load a glossy ball on a grey floor under a light."""
    grey, sensor = {"type": "rgb", "value": 0.6}, camera(mi, side, SPP)
    return mi.load_dict(ball(mi, grey, sensor, {"sky": emitter}))


# ---------------------------------------------------------------------------------------------
#  A ball and its camera
# ---------------------------------------------------------------------------------------------


def camera(
    mi: Any, side: int, samples: int, fov: float = 32, to_world: Any = None
) -> dict[str, Any]:
    """Describe a camera with a square film, by default the one that sees the ball."""
    if to_world is None:
        to_world = mi.ScalarTransform4f().look_at([0, 1.2, 4.2], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}}
    film["pixel_format"] = "rgb"
    sampler = {"type": "independent", "sample_count": samples}
    kind = {"type": "perspective", "fov": fov, "to_world": to_world}
    return kind | {"film": film, "sampler": sampler}


def ball(
    mi: Any, texture: dict[str, Any], sensor: dict[str, Any], emitters: dict[str, Any]
) -> dict[str, Any]:
    """Describe a ball with a textured coat on a grey floor, under emitters."""
    coat = {"type": "principled", "base_color": texture, "roughness": 0.3}
    floor = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "sensor": sensor,
        "ball": {"type": "sphere", "bsdf": coat},
        "floor": {"type": "rectangle", "to_world": floor},
        **emitters,
    }
