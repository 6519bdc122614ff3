"""Scenes of Mitsuba whose textures are to be recovered, with their photos.

Most stand on a floor, under a lamp and the sky. "painting" and "wall" are those of the scene by
Weier et al. 2025 (doi 10.1145/3730855), under a sky of ours; its folder is DATA. `SUBJECTS`, at the
end, lists all.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

import eigengs_dr as eg
from eigengs_bench.alike import letters
from eigengs_bench.clock import Image
from eigengs_dr.image.color import to_linear
from eigengs_dr.image.resize import center_crop, resample

JUDGES, MANY, SEED = 4, 64, 1 << 20  # cameras without photos; samples and seed of photos
SPP = 4  # samples of a pixel of a step
SEEN_SPP = 16  # samples of the derivative that says what the photos show
GREY = {"roughness": (0.5,), "normal": (0.5, 0.5, 1.0)}  # texels before the first step; colours:
COLOR = (0.2, 0.2, 0.2)
SPACES = {"color": "linear", "albedo": "linear", "roughness": "data", "normal": "normal"}
Maps = Mapping[str, Image]
Textures = Mapping[str, Any]


class Subject(NamedTuple):
    """Maps that are looked for: the image of each, and the name of its bitmap in the scene."""

    images: Mapping[str, str]
    keys: Mapping[str, str]
    cameras: tuple[int, ...]
    shapes: Callable[[Any, Textures, Path | None], dict[str, Any]]  # of Mitsuba, textures and DATA
    runs: Mapping[int, Sequence[int]] = {SPP: (240,)}  # steps of fits, by samples of a step
    texels: int = 256
    side: int = 128  # pixels of a photo
    arc: float = 2 * math.pi  # from the first to the last camera
    depth: int = 3  # vertices of a path of light
    noise: float = 0.0  # standard deviation of the values of a photo


class Scene(NamedTuple):
    """What is to be recovered: maps of linear light or data, from photos of some cameras."""

    kind: str
    cameras: int
    maps: Maps
    photos: Sequence[Image]  # of the cameras, and of the judges
    seen: Image  # how much the photos depend on each texel
    data: Path | None
    spp: int = SPP  # of a step
    seed: int = 0  # of renderings and of fits

    @property
    def subject(self) -> Subject:
        """Return what the scene has in common with those of other cameras."""
        return SUBJECTS[self.kind]

    def load(self, mi: Any, maps: Maps | None = None) -> Any:
        """Load the scene of Mitsuba with maps, by default those of the start."""
        maps = maps or {name: grey(self.kind, name) for name in self.maps}
        return load_scene(mi, self.kind, _bitmaps(mi, maps), self.cameras, self.data)


@cache
def scene_of(mi: Any, kind: str, cameras: int, data: Path | None) -> Scene:
    """Make a scene with the photos of its cameras and judges, once."""
    maps = _maps(kind, data)
    loaded = load_scene(mi, kind, _bitmaps(mi, maps), cameras, data)
    photos, seen = photos_of(mi, loaded), _seen(mi, loaded, kind, cameras)
    draw, noise = np.random.default_rng(SEED), SUBJECTS[kind].noise
    for photo in photos[:cameras]:
        photo += np.float32(noise * draw.standard_normal(photo.shape))
    return Scene(kind, cameras, maps, photos, seen, data)


def grey(kind: str, name: str) -> Image:
    """Return the texels of a map before the first step."""
    side = SUBJECTS[kind].texels
    return np.tile(np.array(GREY.get(name, COLOR), np.float32), (side, side, 1))


def photos_of(mi: Any, scene: Any, first: int = 0) -> list[Image]:
    """Render all cameras from the first one on, with few and the same random numbers."""
    cameras = range(first, len(scene.sensors()))
    with dr.suspend_grad():
        return [mi.render(scene, sensor=k, spp=MANY, seed=SEED).numpy() for k in cameras]


def _maps(kind: str, data: Path | None) -> Maps:
    """Return the maps of a scene: images as linear light or data, and the grey of one as roughness.

    The images of a folder fill the square of texels, as the scene has stretched them.
    """
    subject, maps = SUBJECTS[kind], {}
    size = (subject.texels, subject.texels)
    for name, image in subject.images.items():
        if data and "/" in image:
            codes = resample(eg.load_image(data / image), *size)
        elif image == "letters":
            codes = np.tile(letters(size[0]), 3)
        else:
            codes = center_crop(eg.sample(image), *size)
        codes = np.clip(codes, 0, 1)
        if name == "roughness":
            codes = 0.1 + 0.8 * codes.mean(axis=2, keepdims=True)
        maps[name] = np.float32(to_linear(codes) if SPACES[name] == "linear" else codes)
    return maps


def _seen(mi: Any, scene: Any, kind: str, count: int) -> Image:
    """Return the derivative of the mean of the photos by the first map, for each texel."""
    parameters, key = mi.traverse(scene), f"{next(iter(SUBJECTS[kind].keys.values()))}.data"
    dr.enable_grad(parameters[key])
    parameters.update()
    for camera in range(count):
        dr.backward(dr.mean(mi.render(scene, parameters, sensor=camera, spp=SEEN_SPP), axis=None))
    return np.maximum(dr.grad(parameters[key]).numpy().sum(axis=2), 0)


def bitmap(mi: Any, values: Image) -> dict[str, Any]:
    """Return a texture of texels in linear light or data, shape (H, W, C)."""
    data = mi.TensorXf(np.ascontiguousarray(values, np.float32))
    return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}


def _bitmaps(mi: Any, maps: Maps) -> dict[str, Any]:
    return {name: bitmap(mi, values) for name, values in maps.items()}


def load_scene(mi: Any, kind: str, textures: Textures, count: int, data: Path | None = None) -> Any:
    """Load a scene with textures in place of its maps, `count` cameras, and the judges."""
    subject, box = SUBJECTS[kind], {"type": "box"}
    side, path = subject.side, {"type": "prb", "max_depth": subject.depth}
    film = {"type": "hdrfilm", "pixel_format": "rgb", "width": side, "height": side, "rfilter": box}
    scene: dict[str, Any] = {"type": "scene", "integrator": path}
    cameras = _around(mi, subject.arc, count) if subject.arc else _before_the_painting(mi)
    for number, (fov, view) in enumerate(cameras):
        camera = {"type": "perspective", "film": film, "fov": fov, "fov_axis": "x"}
        scene[f"camera{number:02}"] = camera | {"near_clip": 1e-3, "to_world": view}
    return mi.load_dict(scene | subject.shapes(mi, textures, data))


# ---------------------------------------------------------------------------------------------
#  A poster, a ball or a crate
# ---------------------------------------------------------------------------------------------


def _around(mi: Any, arc: float, count: int) -> list[tuple[float, Any]]:
    """Return cameras on an arc around the middle; judges are between those of photos."""
    views, shares = [], [*np.arange(0.5, count) / count, *np.arange(0.75, JUDGES) / JUDGES]
    for share in shares:
        angle = arc * (share - 0.5 if arc < math.pi else share)
        place = [3.7 * math.sin(angle), 0.9 * math.sin(16 * share), 3.7 * math.cos(angle)]
        views.append((36.0, mi.ScalarTransform4f().look_at(place, [0, 0, 0], [0, 1, 0])))
    return views


def _stage(mi: Any) -> dict[str, Any]:
    """Return a floor, a lamp and the sky."""
    at = mi.ScalarTransform4f()
    light = {"type": "area", "radiance": {"type": "rgb", "value": 20.0}}
    lamp = at.look_at([1.5, 3, 3], [0, 0, 0], [0, 1, 0]).scale(0.7)
    floor = at.translate([0, -1.3, 0]).rotate([1, 0, 0], -90).scale(5)
    return {
        "floor": {"type": "rectangle", "to_world": floor},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": light},
        "sky": {"type": "constant", "radiance": 0.5},
    }


def _poster(mi: Any, textures: Textures, data: Path | None) -> dict[str, Any]:
    paint = {"type": "diffuse", "reflectance": textures["color"]}
    turned = mi.ScalarTransform4f().scale([1, -1, 1])
    return _stage(mi) | {"poster": {"type": "rectangle", "to_world": turned, "bsdf": paint}}


def _poster_in_a_room(mi: Any, textures: Textures, data: Path | None) -> dict[str, Any]:
    """Return a poster between white walls, which hide the sky and reflect the light of the lamp."""
    around = mi.ScalarTransform4f().translate([0, 3, 0]).scale(4.5)
    white = {"type": "diffuse", "reflectance": 0.8}
    room = {"type": "cube", "flip_normals": True, "to_world": around, "bsdf": white}
    return _poster(mi, textures, data) | {"room": room}


def _ball(mi: Any, textures: Textures, data: Path | None) -> dict[str, Any]:
    coat: dict[str, Any] = {"type": "principled", "roughness": 0.4}
    for name, texture in textures.items():
        coat["roughness" if name == "roughness" else "base_color"] = texture
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return _stage(mi) | {"ball": {"type": "sphere", "to_world": upright, "bsdf": coat}}


def _tiled_ball(mi: Any, textures: Textures, data: Path | None) -> dict[str, Any]:
    """Return a ball around which its texture goes twice."""
    twice = {"wrap_mode": "repeat", "to_uv": mi.ScalarTransform4f().scale([2, 1, 1])}
    return _ball(mi, {name: texture | twice for name, texture in textures.items()}, data)


def _crate(mi: Any, textures: Textures, data: Path | None) -> dict[str, Any]:
    """Return a box whose sides have parts of the texture of unequal sizes, with seams between."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    columns, rows = (0, 0.2, 0.55, 1), (0, 0.35, 1)  # of the parts
    places, texels = np.zeros((3, 2, 4, 3)), np.zeros((3, 2, 4, 2))
    for axis, end in np.ndindex(3, 2):
        turn = corners[:: 2 * end - 1]  # counter-clockwise from outside
        places[axis, end, :, axis] = 1.6 * end - 0.8
        places[axis, end][:, [axis - 2, axis - 1]] = 1.6 * turn - 0.8
        texels[axis, end, :, 0] = np.take(columns, axis + turn[:, 0])
        texels[axis, end, :, 1] = np.take(rows, end + turn[:, 1])
    faces = 4 * np.arange(6)[:, None, None] + [[0, 1, 2], [0, 2, 3]]
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": textures["color"]})
    crate = mi.Mesh("crate", 24, 12, props=properties, has_vertex_texcoords=True)
    buffers = mi.traverse(crate)
    buffers["vertex_positions"], buffers["vertex_texcoords"] = places.ravel(), texels.ravel()
    buffers["faces"] = faces.ravel()
    buffers.update()
    return _stage(mi) | {"crate": crate}


# ---------------------------------------------------------------------------------------------
#  A painting on a wall
# ---------------------------------------------------------------------------------------------

CLOSE, FAR = np.array([-0.027309, -0.036109, 0.127638]), np.array([0.346642, 0.056158, 0.629])
BETWEEN = ((0.2, 0.02, 0.01), (0.4, -0.05, 0.03), (0.65, 0.08, -0.04), (0.9, -0.2, 0.02))


def _before_the_painting(mi: Any) -> list[tuple[float, Any]]:
    """Return the two cameras of the scene, and judges between them and aside, looking alike."""
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 179.9999640278213)
    turned = turned.rotate([0, 1, 0], -26.783982358463458).rotate([1, 0, 0], -175.24798285619)
    ahead, views = np.array(turned.matrix)[:3, 2], []
    for place in (CLOSE, FAR):
        views.append(mi.ScalarTransform4f().translate(place.tolist()) @ turned)
    for share, right, up in BETWEEN:
        place = CLOSE + (FAR - CLOSE) * share
        target = place - ahead * place[2] / min(ahead[2], -1e-6)
        place += np.array([right, up, 0])
        look_at = mi.ScalarTransform4f().look_at(place.tolist(), target.tolist(), [0, 1, 0])
        views.append(look_at)
    return [(39.597755, view) for view in views]


PAINTING = {"color": "textures/Claude_Lorrain_008.jpg"}
PLANE = "textures/plane_divided_DefaultMaterial_"
WALL = {"albedo": f"{PLANE}BaseColor.jpg", "normal": f"{PLANE}Normal.jpg", "roughness": "chelsea"}


def _hung(mi: Any, textures: Textures, data: Path | None) -> dict[str, Any]:
    """Return the painting and the wall; one of them has the textures, the other its own."""
    assert data is not None

    def known(name: str, power: float = 1.0) -> dict[str, Any]:
        codes = np.clip(resample(eg.load_image(data / name), 512, 512), 0, 1)
        return bitmap(mi, codes**power)

    plaster = {
        "type": "principled",
        "base_color": textures.get("albedo") or known(WALL["albedo"], 2.2),
        "roughness": textures.get("roughness", 0.5),
        "specular": 0.5,
    }
    picture = {
        "type": "principled",
        "base_color": textures.get("color") or known(PAINTING["color"], 2.2),
        "roughness": 0.4,
        "specular": 0.5,
    }
    normals = textures.get("normal") or known(WALL["normal"])
    relief = {"type": "normalmap", "normalmap": normals, "b": {"type": "twosided", "b": plaster}}
    plane, canvas = (str(data / "meshes" / f"{name}.ply") for name in ("Plane", "Painting"))
    turned = mi.ScalarTransform4f([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    return {
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(_windows()), "to_world": turned},
        "wall": {"type": "ply", "filename": plane, "face_normals": True, "bsdf": relief},
        "painting": {"type": "ply", "filename": canvas, "bsdf": {"type": "twosided", "b": picture}},
    }


def _windows() -> Image:
    """Return an environment like that of a room: a bright ceiling and three windows."""
    y, x = (np.mgrid[:64, :128].astype(np.float64) + 0.5) / np.reshape([64, 128], (2, 1, 1))
    sky = np.stack([base + 0.3 * np.cos(np.pi * y) for base in (0.5, 0.55, 0.7)], axis=2)
    sky = np.maximum(sky, 0.1)
    for column, strength in ((0.2, 14), (0.55, 9), (0.85, 12)):
        window = np.exp(-((x - column) ** 2 / 0.002 + (y - 0.35) ** 2 / 0.01))
        sky += strength * window[..., None] * [1, 0.95, 0.85]
    return sky.astype(np.float32)


# ---------------------------------------------------------------------------------------------
#  All scenes
# ---------------------------------------------------------------------------------------------

FULLY = {SPP: (60, 90, 120, 240, 480), 1: (240,), 16: (240,), 64: (60,)}
PHOTOS = {"albedo": "astronaut", "roughness": "chelsea"}
POSTER = {"color": "poster.bsdf.reflectance"}
BALL = {"albedo": "ball.bsdf.base_color", "roughness": "ball.bsdf.roughness"}
PAINT = {"color": BALL["albedo"]}
CANVAS = {"color": "painting.bsdf.brdf_0.base_color"}
PLASTER = {
    "albedo": "wall.bsdf.nested_bsdf.brdf_0.base_color",
    "normal": "wall.bsdf.normalmap",
    "roughness": "wall.bsdf.nested_bsdf.brdf_0.roughness",
}
HUNG: Mapping[str, Any] = {"runs": {16: (128,)}, "texels": 1024, "side": 256, "arc": 0.0}
SUBJECTS = {
    "poster": Subject({"color": "chelsea"}, POSTER, (3, 16), _poster, FULLY, arc=1.4),
    "ball": Subject({"color": "astronaut"}, PAINT, (2, 3, 16), _ball, FULLY),
    "material": Subject(PHOTOS, BALL, (6, 8), _ball, FULLY),
    "text": Subject({"color": "letters"}, POSTER, (8,), _poster, texels=512, side=256, arc=1.4),
    "tiled": Subject({"color": "motorcycle"}, PAINT, (8,), _tiled_ball),
    "room": Subject({"color": "retina"}, POSTER, (8,), _poster_in_a_room, arc=1.4, depth=6),
    "crate": Subject({"color": "astronaut"}, {"color": "crate.bsdf.reflectance"}, (8,), _crate),
    "noisy": Subject({"color": "rocket"}, POSTER, (8,), _poster, arc=1.4, noise=0.03),
    "painting": Subject(PAINTING, CANVAS, (2,), _hung, **HUNG),
    "wall": Subject(WALL, PLASTER, (2,), _hung, **HUNG),
}
