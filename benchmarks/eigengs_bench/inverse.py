"""What recovers a texture from photos: texels, a pyramid of texels, Gaussians, coefficients.

Every method descends by Adam from grey; a step renders one camera by 4 samples a pixel. PSNRs are
of pictures by cameras that took no photo. The parameters of a pyramid are differences of texels to
the next coarser level (Weier et al. 2025, doi 10.1145/3730855), so coarse ones move many texels.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
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
STEPS = (120, 240)  # of the descents; each ends with small rates
CAMERAS, JUDGES, SEED = (3, 16), 4, 1 << 20
GREY = 0.2  # light of the start
LAST_RATE, MOMENTUM = 0.05, 0.5  # share to which rates fall by a cosine; of Adam, best for all
LATTICES = (16, 40, 100)  # Gaussians along a side: wide ones move much, as in a pyramid
CUTOFF = 2.5  # standard deviations: lookups sum fewer Gaussians, for the same PSNR
PHOTOS = {"poster": "chelsea", "ball": "astronaut"}  # the rates were chosen with "coffee"
NAMES = {"poster": "poster.bsdf.reflectance", "ball": "ball.bsdf.base_color"}


class Unknown(NamedTuple):
    """A texture; values to optimise, by their rates; the parameters of a scene that they make."""

    texture: dict[str, Any]
    start: dict[str, Any]
    rates: dict[str, float]
    shown: Callable[[Any], dict[str, Any]] = dict
    bound: Callable[[Any], None] = lambda values: None


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

    return Unknown(texels(mi, name).texture, start, dict.fromkeys(start, 0.004), shown)


def gaussians(mi: Any, name: str) -> Unknown:
    """Describe a texture by lattices of Gaussians."""
    from eigengs_dr.plugins import keep_in_bounds, texture_of

    found = eg.lattices((TEXELS, TEXELS), LATTICES, [GREY] * 3, space="linear")
    rates = {"mean": 0.2, "factor": 0.02, "color": 0.01, "background": 0.005}
    texture = texture_of(found, cutoff=CUTOFF)
    tensors = mi.traverse(mi.load_dict(texture))
    start = {f"{name}.{key}": mi.TensorXf(tensors[key]) for key in rates}
    named = dict(zip(start, rates.values(), strict=True))

    def bound(values: Any) -> None:
        keep_in_bounds(values, name, found)

    return Unknown(texture, start, named, bound=bound)


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
    return Unknown(texture, start, {"z": 0.3}, lambda v: {key: v["z"] * scale})


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
            for steps, method in product(STEPS, METHODS):
                job = {"scene": scene, "cameras": count, "method": method.__name__, "steps": steps}
                unknown = method(mi, NAMES[scene])
                yield job, partial(recover, mi, scene, count, unknown, image, steps)


def recover(mi: Any, kind: str, count: int, unknown: Unknown, image: Image, steps: int) -> Row:
    """Descend, and return seconds, without the first step, which compiles, and psnr_rgb."""
    photos = _photos(mi, scene_of(mi, kind, bitmap(mi, to_linear(image)), count), 0)
    scene = scene_of(mi, kind, unknown.texture, count)
    parameters, values = mi.traverse(scene), mi.ad.Adam(1.0, unknown.start, beta_1=MOMENTUM)
    started = 0.0
    for step in range(steps):
        camera = step % count
        rate = LAST_RATE + (1 - LAST_RATE) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        parameters.update(unknown.shown(values))
        values.set_learning_rate({key: rate * r for key, r in unknown.rates.items()})
        shown = mi.render(scene, parameters, sensor=camera, spp=SPP, seed=step)
        dr.backward(dr.mean(dr.square(shown - photos[camera]), axis=None))
        values.step()
        unknown.bound(values)
        if not step:
            dr.sync_thread()
            started = time.perf_counter()
    dr.sync_thread()
    seconds = time.perf_counter() - started
    parameters.update(unknown.shown(values))
    pairs = _photos(mi, scene, count), photos[count:]
    coded = (to_coded(np.maximum(np.concatenate(pictures), 0)) for pictures in pairs)
    return {"seconds": seconds, "psnr_rgb": eg.psnr(*coded)}


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
    """Lay out the PSNR and the seconds of each descent."""
    found = {
        tuple(row["job"][k] for k in ("scene", "cameras", "steps", "method")): row for row in rows
    }
    lines = []
    for kind, count, steps in dict.fromkeys(key[:3] for key in found):
        each = (found.get((kind, count, steps, method.__name__)) for method in METHODS)
        cells = (f"{r['psnr_rgb']:.1f} dB, {r['seconds']:.1f} s" if r else "" for r in each)
        lines.append((f"{kind}, {count} cameras", f"{steps}", *cells))
    columns = ("photos", "steps", *(method.__name__ for method in METHODS))
    return Section([table("psnr_rgb and seconds of a descent", columns, lines, name="methods")])
