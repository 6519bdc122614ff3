"""Recovery of textures from photos by texels, a pyramid of texels, Gaussians or coefficients.

A step renders one camera with a few samples per pixel. PSNRs are those of pictures by cameras that
took no photo, and of the maps of a material. The parameters of a pyramid are differences of texels
to the next coarser level (Weier et al. 2025, doi 10.1145/3730855), so coarse ones move many texels.
"""

import gc
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from matplotlib.figure import Figure

import eigengs_bench.report as fr
import eigengs_dr as eg
from eigengs_bench.clock import Image
from eigengs_bench.report import Section, Table, number, table
from eigengs_bench.rows import Job, Row, Task
from eigengs_dr.cli.scene import load_mitsuba
from eigengs_dr.eigenbasis.eigengs import SHIPPED
from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.image.resize import center_crop

SIDE, TEXELS, SPP, MANY = 128, 256, 4, 64  # pixels; texels; samples of a step, and of a photo
STEPS = (120, 240, 480)  # of the descents; each ends with small rates
NOISES, NOISY_STEPS, LONGER = (1, 16), 240, 360  # samples of other descents; steps, and of rivals
CAMERAS, MATERIAL_CAMERAS, JUDGES, SEED = (3, 16), (6, 8), 4, 1 << 20
GREY = 0.2  # light of the start
LAST_RATE, MOMENTUM = 0.05, 0.5  # share to which rates fall by a cosine; of Adam, best for all
PHOTOS = {  # what the maps show; the rates were chosen with "coffee"
    "poster": {"color": "chelsea"},
    "ball": {"color": "astronaut"},
    "material": {"albedo": "astronaut", "roughness": "chelsea"},
}
NAMES = {
    "poster": {"color": "poster.bsdf.reflectance"},
    "ball": {"color": "ball.bsdf.base_color"},
    "material": {"albedo": "ball.bsdf.base_color", "roughness": "ball.bsdf.roughness"},
}
SPACES = {"color": "linear", "albedo": "linear", "roughness": "data"}
Maps = Mapping[str, Image]


class Scene(NamedTuple):
    """What is to be recovered: maps of linear light or data, from photos of some cameras."""

    kind: str
    cameras: int
    maps: Maps
    photos: Sequence[Image]  # of the cameras, and of the judges
    seen: Image  # how much the photos depend on each texel
    spp: int


class Unknown(NamedTuple):
    """Textures, the values to optimise with their rates, and the parameters they set in a scene."""

    textures: dict[str, dict[str, Any]]
    start: dict[str, Any]
    rates: dict[str, float]
    parameters_of: Callable[[Any], dict[str, Any]] = dict


def texels(mi: Any, kind: str) -> Unknown:
    """Describe textures by texels."""
    textures = {name: bitmap(mi, grey(name)) for name in NAMES[kind]}
    start = {f"{key}.data": mi.TensorXf(grey(name)) for name, key in NAMES[kind].items()}
    return Unknown(textures, start, dict.fromkeys(start, 0.02))


def pyramid(mi: Any, kind: str) -> Unknown:
    """Describe texels by a level of them, added to the next coarser sum at twice its size."""
    sides, start = [TEXELS >> level for level in range(7)], {}
    for name in NAMES[kind]:
        channels = grey(name).shape[2]
        for side in sides:
            start[f"{name}{side}"] = mi.TensorXf(np.zeros((side, side, channels), np.float32))
        start[f"{name}{sides[-1]}"] += float(grey(name)[0, 0, 0])

    def parameters_of(values: Any) -> dict[str, Any]:
        result = {}
        for name, key in NAMES[kind].items():
            total = values[f"{name}{sides[-1]}"]
            for side in sides[-2::-1]:
                size = (side, side, total.shape[2])
                total = dr.resample(total, size, "linear", boundary="nearest")
                total = total + values[f"{name}{side}"]
            result[f"{key}.data"] = total
        return result

    return Unknown(texels(mi, kind).textures, start, dict.fromkeys(start, 0.004), parameters_of)


def coefficients(mi: Any, kind: str) -> Unknown:
    """Describe a texture by coefficients of the model "natural", in units of their deviations."""
    model = eg.EigenGS.load("natural")
    [(name, key)] = NAMES[kind].items()
    deviation = np.zeros((len(model.components), max(model.components)), np.float32)
    for row, values in zip(deviation, model.eigenvalues, strict=True):
        row[: len(values)] = values
    deviation = np.sqrt(deviation / (0.05 + deviation / deviation.max()))
    scale, texture = mi.TensorXf(deviation), {"type": "gaussian_texture"}
    start = {"z": dr.zeros(mi.TensorXf, deviation.shape)}
    texture["model"] = str(SHIPPED["natural"])

    def parameters_of(values: Any) -> dict[str, Any]:
        return {f"{key}.coefficients": values["z"] * scale}

    return Unknown({name: texture}, start, {"z": 0.3}, parameters_of)


def fit(mi: Any, scene: Scene, steps: int) -> Row:
    """Recover maps by `eg.fit` of a `photo_loss`; the second run counts, after compilation."""
    from eigengs_dr.plugins import photo_loss

    names = NAMES[scene.kind]
    spaces = {name: SPACES[name] for name in names}
    for _ in range(2):
        gc.collect()
        textures = {name: bitmap(mi, grey(name)) for name in names}
        loaded = scene_of(mi, scene.kind, textures, scene.cameras)
        cameras = range(scene.cameras)
        photos = scene.photos[: scene.cameras]
        loss = photo_loss(loaded, names, photos, sensors=cameras, spp=scene.spp)
        size = (TEXELS, TEXELS)
        result = eg.fit(loss=loss, size=size, space=spaces, iterations=steps, progress=False)
        dr.sync_thread()
    rendering = eg.render(result.gaussians).numpy()
    ends = np.cumsum([grey(name).shape[2] for name in names])[:-1]
    maps = dict(zip(names, np.split(rendering, ends, axis=2), strict=True))
    count = sum(array.size for array in result.gaussians.to_arrays().values())
    return {
        "seconds": result.seconds,
        "parameters": count,
        "gaussians": len(result.gaussians),
        **judge(mi, scene, {name: np.clip(picture, 0, 1) for name, picture in maps.items()}),
    }


UNKNOWNS = (texels, pyramid, coefficients)
FROZEN = "frozen"  # the pyramid with the rendering of `photo_loss`, which Dr.Jit replays
MOST_SLOW = 240  # steps of coefficients, which are slow, and of one map
COMPARED = ("pyramid", FROZEN, "fit")  # with other numbers of samples
TEXEL_WAYS = ("texels", "pyramid", FROZEN)


def run(task: Task) -> list[Row]:
    """Recover a poster, the colour of a ball and a material, with few and many cameras."""
    return task.measure("inverse", _jobs(task))


def _jobs(task: Task) -> Iterator[Job]:
    mi = load_mitsuba("cuda_ad_rgb" if task.backend == "cuda" else "llvm_ad_rgb", quiet=False)
    methods = [unknown.__name__ for unknown in UNKNOWNS] + [FROZEN, "fit"]
    for kind in PHOTOS:
        maps = maps_of(kind)
        for count in MATERIAL_CAMERAS if kind == "material" else CAMERAS:
            photos, seen = photos_of(mi, kind, maps, count), seen_in(mi, kind, maps, count)
            settings = [(steps, SPP) for steps in STEPS]
            settings += [(steps, spp) for spp in NOISES for steps in (NOISY_STEPS, LONGER)]
            for steps, spp in settings:
                for method in methods:
                    slow = method == coefficients.__name__
                    if slow and (len(maps) > 1 or steps > MOST_SLOW):
                        continue
                    if method not in COMPARED and spp != SPP:
                        continue
                    if method == "fit" and steps == LONGER:
                        continue
                    job = {"scene": kind, "cameras": count, "method": method, "steps": steps}
                    scene = Scene(kind, count, maps, photos, seen, spp)
                    yield {**job, "spp": spp}, partial(recover, mi, scene, method, steps)


def recover(mi: Any, scene: Scene, method: str, steps: int) -> Row:
    """Recover the maps of a scene by a method; return seconds, parameters and PSNRs."""
    gc.collect()  # Mitsuba traces the plugins of every scene that is still there
    if method == "fit":
        return fit(mi, scene, steps)
    name = pyramid.__name__ if method == FROZEN else method
    [unknown] = [describe(mi, scene.kind) for describe in UNKNOWNS if describe.__name__ == name]
    return descend(mi, scene, unknown, steps, method == FROZEN)


def descend(mi: Any, scene: Scene, unknown: Unknown, steps: int, frozen: bool = False) -> Row:
    """Descend by Adam; the seconds leave out the first step, which compiles and records."""
    from eigengs_dr.plugins import photo_loss

    loaded = scene_of(mi, scene.kind, unknown.textures, scene.cameras)
    parameters, values = mi.traverse(loaded), mi.ad.Adam(1.0, unknown.start, beta_1=MOMENTUM)
    photos = [mi.TensorXf(photo) for photo in scene.photos[: scene.cameras]]
    names = NAMES[scene.kind]
    cameras = range(scene.cameras)
    loss = photo_loss(loaded, names, photos, sensors=cameras, spp=scene.spp) if frozen else None
    replayed = None if loss is None else loss.function

    def error(tensors: Mapping[str, Any], step: int) -> Any:
        if replayed:
            return replayed({name: tensors[f"{key}.data"] for name, key in names.items()}, step)
        parameters.update(tensors)
        camera = step % scene.cameras
        rendered = mi.render(loaded, parameters, sensor=camera, spp=scene.spp, seed=step)
        return dr.mean(dr.square(rendered - photos[camera]), axis=None)

    started = 0.0
    for step in range(steps):
        rate = LAST_RATE + (1 - LAST_RATE) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        values.set_learning_rate({key: rate * r for key, r in unknown.rates.items()})
        dr.backward(error(unknown.parameters_of(values), step))
        values.step()
        if not step:
            dr.sync_thread()
            started = time.perf_counter()
    dr.sync_thread()
    seconds = time.perf_counter() - started
    last = unknown.parameters_of(values)
    parameters.update(last)
    row = {"seconds": seconds, "parameters": sum(dr.width(v) for v in unknown.start.values())}
    row["psnr_rgb"] = _psnr(_photos(mi, loaded, scene.cameras), scene.photos[scene.cameras :])
    if len(scene.maps) > 1:
        maps = {n: last[f"{key}.data"].numpy() for n, key in NAMES[scene.kind].items()}
        row |= _judge_maps(scene, maps)
    return row


def judge(mi: Any, scene: Scene, maps: Maps) -> Row:
    """Return psnr_rgb of the cameras that took no photo, and the PSNRs of several maps."""
    loaded = scene_of(mi, scene.kind, _bitmaps(mi, maps), scene.cameras)
    views = _photos(mi, loaded, scene.cameras)
    row = {"psnr_rgb": _psnr(views, scene.photos[scene.cameras :])}
    return row | (_judge_maps(scene, maps) if len(scene.maps) > 1 else {})


def _judge_maps(scene: Scene, maps: Maps) -> Row:
    """Return the PSNRs of maps where they are seen, and of the best constant in place of each."""
    row = {}
    for name, true in scene.maps.items():
        mean = np.average(true.reshape(-1, true.shape[2]), axis=0, weights=scene.seen.ravel())
        constant = np.broadcast_to(mean, true.shape)
        for key, picture in ((name, maps[name]), (f"{name}_constant", constant)):
            pair = [np.clip(values, 0, 1) for values in (picture, true)]
            if SPACES[name] == "linear":
                pair = [to_coded(values) for values in pair]
            error = np.mean(np.square(pair[0] - pair[1]), axis=2)
            row[key] = float(-10 * np.log10(np.average(error, weights=scene.seen)))
    return row


def _psnr(pictures: Sequence[Image], photos: Sequence[Image]) -> float:
    coded = (to_coded(np.maximum(np.concatenate(p), 0)) for p in (pictures, photos))
    return eg.psnr(*coded)


def maps_of(kind: str) -> Maps:
    """Return the maps of a scene: photos in linear light, and the grey of one as roughness."""
    maps = {}
    for name, photo in PHOTOS[kind].items():
        codes = np.clip(center_crop(eg.sample(photo), TEXELS, TEXELS), 0, 1)
        rough = 0.1 + 0.8 * codes.mean(axis=2, keepdims=True)
        maps[name] = to_linear(codes) if SPACES[name] == "linear" else rough.astype(np.float32)
    return maps


def photos_of(mi: Any, kind: str, maps: Maps, count: int) -> list[Image]:
    """Render the photos of the cameras and of the judges."""
    return _photos(mi, scene_of(mi, kind, _bitmaps(mi, maps), count), 0)


def seen_in(mi: Any, kind: str, maps: Maps, count: int) -> Image:
    """Return the derivative of the mean of the photos by the colour of each texel."""
    scene = scene_of(mi, kind, _bitmaps(mi, maps), count)
    parameters, key = mi.traverse(scene), f"{next(iter(NAMES[kind].values()))}.data"
    dr.enable_grad(parameters[key])
    parameters.update()
    for camera in range(count):
        dr.backward(dr.mean(mi.render(scene, parameters, sensor=camera, spp=SPP), axis=None))
    return np.maximum(dr.grad(parameters[key]).numpy().sum(axis=2), 0)


def grey(name: str) -> Image:
    """Return the texels of a map before the first step."""
    channels, value = (3, GREY) if SPACES[name] == "linear" else (1, 0.5)
    return np.full((TEXELS, TEXELS, channels), value, np.float32)


def bitmap(mi: Any, values: Image) -> dict[str, Any]:
    """Return a texture of texels in linear light or data, shape (H, W, C)."""
    data = mi.TensorXf(np.ascontiguousarray(values, np.float32))
    return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}


def _bitmaps(mi: Any, maps: Maps) -> dict[str, dict[str, Any]]:
    return {name: bitmap(mi, values) for name, values in maps.items()}


def scene_of(mi: Any, kind: str, textures: Mapping[str, dict[str, Any]], count: int) -> Any:
    """Load a poster or a ball on a floor, under a lamp and the sky; judges are between cameras."""
    at, box = mi.ScalarTransform4f(), {"type": "box"}
    film = {"type": "hdrfilm", "pixel_format": "rgb", "width": SIDE, "height": SIDE, "rfilter": box}
    scene = {"type": "scene", "integrator": {"type": "prb", "max_depth": 3}}
    places = [*np.arange(0.5, count) / count, *np.arange(0.75, JUDGES) / JUDGES]
    for camera_number, share in enumerate(places):
        angle = 1.4 * (share - 0.5) if kind == "poster" else 2 * math.pi * share
        place = [3.7 * math.sin(angle), 0.9 * math.sin(16 * share), 3.7 * math.cos(angle)]
        view = at.look_at(place, [0, 0, 0], [0, 1, 0])
        camera = {"type": "perspective", "film": film, "fov": 36, "to_world": view}
        scene[f"camera{camera_number:02}"] = camera
    light = {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}
    lamp = at.look_at([1.5, 3, 3], [0, 0, 0], [0, 1, 0]).scale(0.7)
    floor = at.translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(5)
    scene["floor"] = {"type": "rectangle", "to_world": floor}
    scene["lamp"] = {"type": "rectangle", "to_world": lamp, "emitter": light}
    scene["sky"] = {"type": "constant", "radiance": 0.5}
    if kind == "poster":
        paint = {"type": "diffuse", "reflectance": textures["color"]}
        scene[kind] = {"type": "rectangle", "to_world": at.scale([1, -1, 1]), "bsdf": paint}
    else:
        coat = {"type": "principled", "roughness": 0.4}
        for name, texture in textures.items():
            coat["roughness" if name == "roughness" else "base_color"] = texture
        scene["ball"] = {"type": "sphere", "to_world": at.rotate([1, 0, 0], 90), "bsdf": coat}
    return mi.load_dict(scene)


def _photos(mi: Any, scene: Any, first: int) -> list[Image]:
    """Render all cameras from the first one on, with few and the same random numbers."""
    cameras = range(first, len(scene.sensors()))
    with dr.suspend_grad():
        return [mi.render(scene, sensor=k, spp=MANY, seed=SEED).numpy() for k in cameras]


# ---------------------------------------------------------------------------------------------
#  Tables and a chart
# ---------------------------------------------------------------------------------------------

METHODS = {"texels": fr.GREY, "pyramid": fr.RED, "fit": fr.BLUE}
METHODS |= {"coefficients": fr.GREEN, FROZEN: fr.PINK}
MARKERS = dict(zip(METHODS, "vsoDP", strict=True))


def summarize(rows: Sequence[Row]) -> Section:
    """Lay out the gain of each descent at equal seconds, and draw PSNR over seconds."""
    curves: dict[tuple, dict[str, dict[int, Row]]] = {}
    for row in rows:
        job = row["job"]
        case = job["scene"], job["cameras"], job["spp"]
        curves.setdefault(case, {}).setdefault(job["method"], {})[job["steps"]] = row
    pairs = [methods for methods in curves.values() if {"pyramid", "fit"} <= methods.keys()]
    gains = [decibels for methods in pairs for decibels in gain(methods)]
    ends = {"behind": -min(gains), "ahead": max(gains)} if gains else {}
    figures = {name: f"{number(value)} dB" for name, value in ends.items()}
    return Section([_gains(curves)], {"inverse": _chart(curves)}, figures)


SLOWER = 1.05  # seconds of a rival, relative to those of a fit


def gain(methods: Mapping[str, Mapping[int, Row]]) -> list[float]:
    """Return the decibels of each fit above the best texels of about equal seconds.

    Between two descents of a method, its PSNR is linear in the logarithm of the seconds; beyond
    them it is that of the nearest.
    """
    rivals = [
        sorted((row["seconds"], row["psnr_rgb"]) for row in methods[m].values())
        for m in TEXEL_WAYS
        if m in methods
    ]
    curves = [tuple(zip(*rows, strict=True)) for rows in rivals]
    gains = []
    for _, row in sorted(methods["fit"].items()):
        time = math.log(SLOWER * row["seconds"])
        best = max(float(np.interp(time, np.log(seconds), psnr)) for seconds, psnr in curves)
        gains.append(row["psnr_rgb"] - best)
    return gains


def _gains(curves: Mapping[tuple, Mapping[str, Mapping[int, Row]]]) -> Table:
    """Lay out the gains of a scene and its cameras: a column per descent."""
    cells: dict[tuple[str, int], dict[tuple[int, int], str]] = {}
    for (scene, cameras, spp), methods in curves.items():
        if "fit" in methods:
            gains = zip(sorted(methods["fit"]), gain(methods), strict=True)
            line = cells.setdefault((scene, cameras), {})
            line.update({(steps, spp): f"{decibels:+.1f}" for steps, decibels in gains})
    descents = sorted({d for line in cells.values() for d in line}, key=lambda d: (d[1] != SPP, d))
    lines = [
        (f"{scene}, {cameras} cameras", *(line.get(descent, "") for descent in descents))
        for (scene, cameras), line in cells.items()
    ]
    pairs = [methods for methods in curves.values() if {"pyramid", "fit"} <= methods.keys()]
    fits, pyramids = ([next(iter(m[name].values())) for m in pairs] for name in ("fit", "pyramid"))
    count = ", ".join(sorted({f"{row['gaussians']:,}" for row in fits}))
    shares = {
        f"{fit['parameters'] / other['parameters']:.2f}"
        for fit, other in zip(fits, pyramids, strict=True)
    }
    columns = ("photos", *(f"{steps} steps, {spp} spp" for steps, spp in descents))
    caption = (
        f"psnr_rgb of fit in dB over the best of texels and pyramids at equal seconds; {count} "
        f"Gaussians have {' or '.join(sorted(shares))} of the parameters of a pyramid"
    )
    return table(caption, columns, lines, name="gains")


def _chart(curves: Mapping[tuple, Mapping[str, Mapping[int, Row]]]) -> Figure:
    """Draw PSNR over seconds, a panel for each scene and number of cameras."""
    cases = [case for case in curves if case[2] == SPP]
    lines = max(1, math.ceil(len(cases) / 2))
    figure = fr.new_figure(8, 1 + 2.1 * lines, "Textures recovered from photos")
    axes = np.ravel(figure.subplots(lines, 2, squeeze=False))
    for axis, case in zip(axes, cases, strict=False):
        for method, color in METHODS.items():
            rows = sorted(curves[case].get(method, {}).values(), key=lambda row: row["seconds"])
            points = np.array([(row["seconds"], row["psnr_rgb"]) for row in rows]).reshape(-1, 2).T
            axis.plot(*points, color=color, marker=MARKERS[method], ms=5, label=method)
        axis.set_title(f"{case[0]}, {case[1]} cameras", fontsize=9)
        fr.label_axes(axis, "seconds", "PSNR in RGB / dB", legend=False)
    fr.legend_below(figure, axes[0], len(METHODS))
    return figure
