"""What recovers a texture from photos: texels, a pyramid of texels, Gaussians, coefficients.

Every method descends by Adam from grey; a step renders one camera by 4 samples a pixel. PSNRs are
of pictures by cameras that took no photo. The parameters of a pyramid are differences of texels to
the next coarser level (Weier et al. 2025, doi 10.1145/3730855), so coarse ones move many texels.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

import eigengs_dr as eg
from eigengs_bench.clock import Image
from eigengs_bench.report import Section, table
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.eigenbasis.eigengs import SHIPPED
from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.image.resize import center_crop

SIDE, TEXELS, SPP, MANY = 128, 256, 4, 64  # pixels; texels; samples of a step, and of a photo
STEPS, EVERY = 240, 24  # of a descent, and between two measurements
CAMERAS, JUDGES, SEED = (3, 16), 4, 1 << 20
GREY, LAST_RATE = 0.2, 0.05  # light of the start; the rates fall by a cosine to this share
LATTICES = (8, 16, 32, 64, 90)  # Gaussians along a side: wide ones move much, as in a pyramid
PHOTOS = {"poster": "chelsea", "ball": "astronaut"}  # the rates were chosen with "coffee"
NAMES = {"poster": "poster.bsdf.reflectance", "ball": "ball.bsdf.base_color"}


class Unknown(NamedTuple):
    """A texture; values to optimise, by their rates; the parameters of a scene that they make."""

    texture: dict[str, Any]
    start: dict[str, Any]
    rates: dict[str, float]
    shown: Callable[[Any], dict[str, Any]] = dict
    bound: Callable[[Any], None] = lambda values: None
    betas: tuple[float, float] = (0.9, 0.999)


def texels(mi: Any, name: str) -> Unknown:
    """Describe a texture by texels."""
    texture = bitmap(mi, np.full((TEXELS, TEXELS, 3), GREY, np.float32))
    key = f"{name}.data"
    return Unknown(texture, {key: mi.TensorXf(texture["data"])}, {key: 0.02})


def pyramid(mi: Any, name: str) -> Unknown:
    """Describe texels by a level of them, added to the next coarser sum at twice its size."""
    sides = [TEXELS >> level for level in range(7)]
    start = {str(side): mi.TensorXf(np.zeros((side, side, 3), np.float32)) for side in sides}
    start[str(sides[-1])] += GREY

    def shown(values: Any) -> dict[str, Any]:
        total = values[str(sides[-1])]
        for side in sides[-2::-1]:
            larger = dr.resample(total, (side, side, 3), "linear", boundary="nearest")
            total = larger + values[str(side)]
        return {f"{name}.data": total}

    return Unknown(texels(mi, name).texture, start, dict.fromkeys(start, 0.006), shown)


def gaussians(mi: Any, name: str) -> Unknown:
    """Describe a texture by lattices of Gaussians."""
    from eigengs_dr.plugins import keep_in_bounds, texture_of

    places = [(np.indices((n, n)).reshape(2, -1).T + 0.5) * TEXELS / n for n in LATTICES]
    narrow = np.concatenate([np.full(n * n, n / (0.65 * TEXELS)) for n in LATTICES])
    factor = np.stack([narrow, 0 * narrow, narrow], axis=1)
    size, grey = (TEXELS, TEXELS), [GREY] * 3
    mean, color = np.concatenate(places), np.zeros((len(narrow), 3))
    found = eg.Gaussians.from_arrays(mean, factor, color, grey, size=size, space="linear")
    rates = {"mean": 0.2, "factor": 0.02, "color": 0.01, "background": 0.005}
    tensors = mi.traverse(mi.load_dict(texture_of(found)))
    start = {f"{name}.{key}": mi.TensorXf(tensors[key]) for key in rates}
    named = dict(zip(start, rates.values(), strict=True))

    def bound(values: Any) -> None:
        keep_in_bounds(values, name, found)

    return Unknown(texture_of(found), start, named, bound=bound, betas=(0.9, 0.99))


def coefficients(mi: Any, name: str) -> Unknown:
    """Describe a texture by coefficients of the model "natural", in units of their deviations."""
    model = eg.EigenGS.load("natural")
    deviation = np.zeros((len(model.components), max(model.components)), np.float32)
    for row, values in zip(deviation, model.eigenvalues, strict=True):
        row[: len(values)] = values
    deviation = np.sqrt(deviation / (0.05 + deviation / deviation.max()))
    scale, texture = mi.TensorXf(deviation), {"type": "gaussian_texture"}
    start = {"z": dr.zeros(mi.TensorXf, deviation.shape)}
    texture["model"] = str(SHIPPED["natural"])
    key = f"{name}.coefficients"
    return Unknown(texture, start, {"z": 0.3}, lambda v: {key: v["z"] * scale}, betas=(0.5, 0.999))


METHODS = (texels, pyramid, gaussians, coefficients)


def run(task: Task) -> list[Row]:
    """Recover a poster and the colour of a ball by every method, with few and many cameras."""
    return task.measure("inverse", _jobs(task))


def _jobs(task: Task) -> Iterator[Job]:
    import mitsuba as mi

    from eigengs_dr.plugins import register_plugins

    mi.set_variant("cuda_ad_rgb" if task.backend == "cuda" else "llvm_ad_rgb")
    register_plugins()
    for scene, photo in PHOTOS.items():
        image = np.clip(center_crop(eg.sample(photo), TEXELS, TEXELS), 0, 1)
        for count in CAMERAS:
            for method in METHODS:
                job = {"scene": scene, "cameras": count, "method": method.__name__, "steps": STEPS}
                yield job, partial(recover, mi, scene, count, method(mi, NAMES[scene]), image)


def recover(mi: Any, kind: str, count: int, unknown: Unknown, image: Image) -> Row:
    """Descend, and return seconds, without the first step, which compiles, and psnr_rgb."""
    photos = _photos(mi, scene_of(mi, kind, bitmap(mi, to_linear(image)), count), 0)
    scene = scene_of(mi, kind, unknown.texture, count)
    parameters, (beta_1, beta_2) = mi.traverse(scene), unknown.betas
    values = mi.ad.Adam(1.0, unknown.start, beta_1=beta_1, beta_2=beta_2)
    seconds, decibels, spent = [], [], 0.0
    for step in range(STEPS):
        started, camera = time.perf_counter(), step % count
        rate = LAST_RATE + (1 - LAST_RATE) * (0.5 + 0.5 * math.cos(math.pi * step / STEPS))
        parameters.update(unknown.shown(values))
        values.set_learning_rate({key: rate * r for key, r in unknown.rates.items()})
        shown = mi.render(scene, parameters, sensor=camera, spp=SPP, seed=step)
        dr.backward(dr.mean(dr.square(shown - photos[camera]), axis=None))
        values.step()
        unknown.bound(values)
        dr.sync_thread()
        spent += time.perf_counter() - started if step else 0
        if (step + 1) % EVERY == 0:
            parameters.update(unknown.shown(values))
            pairs = _photos(mi, scene, count), photos[count:]
            coded = (to_coded(np.maximum(np.concatenate(pictures), 0)) for pictures in pairs)
            seconds.append(spent)
            decibels.append(eg.psnr(*coded))
    return {"seconds": seconds, "psnr_rgb": decibels}


def bitmap(mi: Any, light: Image) -> dict[str, Any]:
    """Return a texture of texels in linear light, shape (H, W, 3)."""
    data = mi.TensorXf(np.ascontiguousarray(light))
    return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}


def scene_of(mi: Any, kind: str, texture: dict[str, Any], count: int) -> Any:
    """Load a poster or a ball over a floor, under a lamp and the sky; judges look from between."""
    at, box = mi.ScalarTransform4f(), {"type": "box"}
    film = {"type": "hdrfilm", "pixel_format": "rgb", "width": SIDE, "height": SIDE, "rfilter": box}
    scene = {"type": "scene", "integrator": {"type": "prb", "max_depth": 3}}
    places = [*np.arange(0.5, count) / count, *np.arange(0.75, JUDGES) / JUDGES]
    for number, share in enumerate(places):
        angle = 2 * math.pi * share if kind == "ball" else 1.4 * (share - 0.5)
        place = [3.7 * math.sin(angle), 0.9 * math.sin(16 * share), 3.7 * math.cos(angle)]
        view = at.look_at(place, [0, 0, 0], [0, 1, 0])
        camera = {"type": "perspective", "film": film, "fov": 36, "to_world": view}
        scene[f"camera{number:02}"] = camera
    light = {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}
    lamp = at.look_at([1.5, 3, 3], [0, 0, 0], [0, 1, 0]).scale(0.7)
    floor = at.translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(5)
    scene["floor"] = {"type": "rectangle", "to_world": floor}
    scene["lamp"] = {"type": "rectangle", "to_world": lamp, "emitter": light}
    scene["sky"] = {"type": "constant", "radiance": 0.5}
    if kind == "ball":
        coat = {"type": "principled", "base_color": texture, "roughness": 0.4}
        scene[kind] = {"type": "sphere", "to_world": at.rotate([1, 0, 0], 90), "bsdf": coat}
    else:
        paint = {"type": "diffuse", "reflectance": texture}
        scene[kind] = {"type": "rectangle", "to_world": at.scale([1, -1, 1]), "bsdf": paint}
    return mi.load_dict(scene)


def _photos(mi: Any, scene: Any, first: int) -> list[Image]:
    """Render all cameras from the first one on, with few and the same random numbers."""
    cameras = range(first, len(scene.sensors()))
    with dr.suspend_grad():
        return [mi.render(scene, sensor=k, spp=MANY, seed=SEED).numpy() for k in cameras]


def summarize(rows: Sequence[Row]) -> Section:
    """Lay out the PSNRs after all steps, and after the seconds of the fastest method."""
    lines = []
    for (kind, count), group in groupby(rows, lambda r: (r["job"]["scene"], r["job"]["cameras"])):
        found = list(group)
        least = min(row["seconds"][-1] for row in found)
        timed = [np.interp(least, row["seconds"], row["psnr_rgb"]) for row in found]
        pairs = zip((row["psnr_rgb"][-1] for row in found), timed, strict=True)
        cells = (f"{last:.1f} / {then:.1f}" for last, then in pairs)
        lines.append((f"{kind}, {count} cameras", f"{least:.0f} s", *cells))
    steps = rows[0]["job"]["steps"]
    caption = f"psnr_rgb in dB after {steps} steps / after the seconds of the fastest method"
    columns = ("photos", "seconds", *(method.__name__ for method in METHODS))
    return Section([table(caption, columns, lines, name="methods")])
