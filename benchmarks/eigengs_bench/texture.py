"""How fast a texture of Gaussians is in Mitsuba: against a bitmap on the same ball."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import drjit as dr
import numpy as np

import eigengs_dr as eg
from eigengs_bench.clock import interleaved
from eigengs_bench.report import Section, table
from eigengs_bench.rows import Row, Task
from eigengs_dr.image.color import to_linear

SIDE, TEXELS, SPP = 512, 1024, 16  # of the picture, of the bitmap, and samples a pixel
COUNTS = (500, 5_000, 20_000)  # Gaussians of the textures
SETTLED = 5_000  # Gaussians of the texture that is also prefiltered and differentiated
CHANGED = (5_000, 50_000)  # Gaussians of the textures whose parameters change
STEPS, WARM_UP, ROUNDS = 100, 2, 9  # of the fits; rounds that compile, and that are measured


def run(task: Task, variant: str) -> list[Row]:
    """Time a material ball with each texture in turn, in one run; every figure is a median.

    `ratio_N` is rendering with N Gaussians over rendering with a bitmap, `ratio_prefiltered` with
    5,000 and the prefilter, `ratio_step` picture and gradient of all parameters by `prb`.
    `ratio_maps` is what colour, roughness and normal of one file add over what its colour adds.
    `change_N` and `change_filtered_N` take over N changed shapes, without and with prefilter.
    """
    job: Row = {"variant": variant, "at": time.time()}  # each call measures anew
    return task.measure("texture", [(job, partial(measure, variant, task.progress))])


def summarize(rows: Sequence[Row]) -> Section:
    """Lay out the figures of the last row, and what a user of the texture pays."""
    row = rows[-1]
    lines = [(k, f"{v:.4g}") for k, v in row.items() if isinstance(v, float)]
    costs = [(f"{n:,} Gaussians", f"{row[f'ratio_{n}']:.2f}") for n in COUNTS]
    costs.append((f"{SETTLED:,} Gaussians, prefilter", f"{row['ratio_prefiltered']:.2f}"))
    costs.append((f"a step of prb, {SETTLED:,} Gaussians", f"{row['ratio_step']:.2f}"))
    changes = [
        (what, *(f"{row[f'{name}_{n}_ms']:.1f} ms" for n in CHANGED))
        for what, name in (("points", "change"), ("prefilter", "change_filtered"))
    ]
    over = f"Time of a picture over that with a bitmap of {TEXELS:,} x {TEXELS:,} texels"
    after = "Time to take over a change of all shapes"
    columns = ("lookup", *(f"{n:,} Gaussians" for n in CHANGED))
    return Section(
        [
            table("Texture", ("figure", "value"), lines),
            table(over, ("texture", "over a bitmap"), costs, name="costs"),
            table(after, columns, changes, name="changes"),
        ]
    )


def measure(variant: str, progress: Callable[..., None] = lambda *_: None) -> Row:
    """Measure the figures of `run`."""
    import mitsuba as mi

    from eigengs_dr.plugins import pixel_angle, register_plugins, texture_of

    mi.set_variant(variant)
    register_plugins()
    picture, sets = eg.sample("coffee")[:400, 100:500], {}
    counts = sorted({*COUNTS, *CHANGED})
    for count in counts:
        sets[count] = eg.fit(picture, count, STEPS).gaussians
        progress("fits", len(sets), len(counts))
    coded = np.clip(eg.picture_of(sets[SETTLED], TEXELS, TEXELS), 0, 1)
    data = mi.TensorXf(to_linear(coded).astype(np.float32))
    plain = ball(mi, {"type": "bitmap", "data": data, "raw": True})
    scenes = {f"gaussians_{n}": ball(mi, texture_of(sets[n])) for n in COUNTS}
    angle = pixel_angle(plain.sensors()[0])
    filtered = ball(mi, texture_of(sets[SETTLED], prefilter=angle))
    settled = scenes[f"gaussians_{SETTLED}"]
    programs: dict[str, Callable[[], Any]] = {
        "bitmap": partial(mi.render, plain),
        **{name: partial(mi.render, scene) for name, scene in scenes.items()},
        "prefiltered": partial(mi.render, filtered),
        "step_bitmap": _step(mi, plain),
        "step_gaussians": _step(mi, settled),
    }
    # Nearly constant roughness and normals: paths are as long as with constants.
    normal = [0.5, 0.5, 1.0] + 0.1 * (picture - picture.mean()) * [1, 1, 0]
    images = {"albedo": picture, "roughness": 0.25 + 0.1 * picture[..., :1], "normal": normal}
    fitted = eg.fit(images, SETTLED, 0)
    with TemporaryDirectory() as folder:
        fitted.save(f"{folder}/maps.npz")
        for count in (0, 1, 3):
            scene = ball(mi, *_maps(f"{folder}/maps.npz", count))
            programs[f"maps_{count}"] = partial(mi.render, scene)
    for count in CHANGED:
        for name, given in (("change", 0.0), ("change_filtered", angle)):
            texture = mi.load_dict(texture_of(sets[count], prefilter=given))
            programs[f"{name}_{count}"] = partial(_change, mi, texture)
    timed = interleaved(programs, WARM_UP, ROUNDS, partial(progress, "texture"))
    return {
        **{f"{name}_ms": ms for name, ms in timed.items()},
        **{f"ratio_{n}": timed[f"gaussians_{n}"] / timed["bitmap"] for n in COUNTS},
        "ratio_prefiltered": timed["prefiltered"] / timed["bitmap"],
        "ratio_step": timed["step_gaussians"] / timed["step_bitmap"],
        "ratio_maps": (timed["maps_3"] - timed["maps_0"]) / (timed["maps_1"] - timed["maps_0"]),
    }


def _maps(path: str, count: int) -> list[Any]:
    """Return colour, roughness and normal of a coat, the first `count` as maps of a file."""
    file = {"type": "gaussian_texture", "filename": path}
    maps = [file | {"map": name} for name in ("albedo", "roughness", "normal")]
    flat = {"type": "srgb", "color": [0.5, 0.5, 1.0]}
    constants: list[Any] = [{"type": "rgb", "value": 0.5}, 0.3, flat]
    return [*maps[:count], *constants[count:]]


def ball(mi: Any, texture: dict[str, Any], roughness: Any = 0.3, normal: Any = None) -> Any:
    """Load a ball with a textured coat on a grey floor, under a lamp and the sky."""
    at = mi.ScalarTransform4f()
    camera = at.look_at([0, 1.2, 4.2], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE}
    sampler = {"type": "independent", "sample_count": SPP}
    sensor = {"type": "perspective", "fov": 32, "to_world": camera, "film": film}
    coat = {"type": "principled", "base_color": texture, "roughness": roughness}
    if normal:
        coat = {"type": "normalmap", "normalmap": normal, "bsdf": coat}
    floor = at.translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "sensor": {**sensor, "sampler": sampler},
        "ball": {"type": "sphere", "bsdf": coat},
        "floor": {"type": "rectangle", "to_world": floor},
        "lamp": {"type": "sphere", "center": [3, 4, 3], "emitter": light},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.4}},
    }
    return mi.load_dict(scene)


def _step(mi: Any, scene: Any) -> Callable[[], Any]:
    integrator = mi.load_dict({"type": "prb", "max_depth": 5})
    parameters = mi.traverse(scene)
    parameters.keep(r".*base_color\.(data|mean|factor|color|background)")

    def step() -> Any:
        for name, value in parameters:
            dr.enable_grad(value)
            parameters[name] = value
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, integrator=integrator), axis=None))
        return [dr.grad(value) for _, value in parameters]

    return step


def _change(mi: Any, texture: Any) -> Any:
    """Change all shapes by a millionth; equal values would be no change for Mitsuba."""
    parameters = mi.traverse(texture)
    factor = dr.detach(parameters["factor"])
    parameters["factor"] = factor * dr.opaque(mi.Float, 1 + 1e-6)
    parameters.update()
    return texture.table
