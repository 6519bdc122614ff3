"""What a light costs as Gaussians: beside the ``envmap`` of its bitmap, over a ball on a floor.

The set is a fit of logarithms for a PSNR of 40 dB, at twice the size of the bitmap.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import drjit as dr
import numpy as np
from scipy.ndimage import zoom

import eigengs_dr as eg
from eigengs_bench.clock import Image, interleaved_apart
from eigengs_bench.rows import Job, Row
from eigengs_dr.cli.scene import load_mitsuba
from eigengs_dr.image.color import to_coded

ROWS, PIXELS, SPP = 256, 128, 16  # of the bitmap, twice as wide; of the film; samples per pixel
GOAL, STEPS = 40.0, 100
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


def jobs(variant: str) -> Iterator[Job]:
    """Yield what measures each light."""
    for name in LIGHTS:
        yield {"variant": variant, "light": name}, partial(compare, variant, name)


def compare(variant: str, name: str) -> Row:
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
    before, after = (pictures(mi, scene_of(mi, emitter, PIXELS)) for emitter in (bitmap, sums))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "light.npz"
        gaussians.save(path)
        shown = partial(_picture, variant, PIXELS)
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
    return partial(mi.render, scene_of(mi, emitter, side))


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


def scene_of(mi: Any, emitter: dict[str, Any], side: int) -> Any:
    """Load a glossy ball on a grey floor under a light."""
    at, box = mi.ScalarTransform4f(), {"type": "box"}
    camera = at.look_at([0, 1.2, 4.2], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": box}
    film["pixel_format"] = "rgb"
    floor = at.translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3)
    sampler = {"type": "independent", "sample_count": SPP}
    sensor = {"type": "perspective", "fov": 32, "to_world": camera, "film": film}
    coat = {"type": "principled", "base_color": {"type": "rgb", "value": 0.6}, "roughness": 0.3}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "sensor": {**sensor, "sampler": sampler},
        "ball": {"type": "sphere", "bsdf": coat},
        "floor": {"type": "disk", "to_world": floor},
        "sky": emitter,
    }
    return mi.load_dict(scene)
