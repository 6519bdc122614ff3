"""Three scenes of different kinds that use bitmaps, written as files."""

import numpy as np

import eigengs_dr as eg
from _helpers.poster import camera

CAMERA = """
  <sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="{origin}" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="24"/>
      <rfilter type="box"/></film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>"""

WALL = """<scene version="3.0.0">
  <default name="spp" value="4"/>
  <integrator type="direct"/>{cameras}
  <emitter type="constant"/>
  <texture type="bitmap" id="photo"><string name="filename" value="photo.png"/>
    <string name="wrap_mode" value="mirror"/></texture>
  <bsdf type="diffuse" id="paint"><ref id="photo" name="reflectance"/></bsdf>
  <shape type="rectangle"><ref id="paint"/></shape>
  <shape type="rectangle">
    <transform name="to_world"><scale value="0.4"/><translate z="0.1"/></transform>
    <bsdf type="twosided"><bsdf type="normalmap">
      <texture name="normalmap" type="bitmap"><string name="filename" value="normals.png"/>
        <boolean name="raw" value="true"/></texture>
      <bsdf type="principled">
        <texture name="base_color" type="bitmap"><string name="filename" value="photo.png"/>
          <transform name="to_uv"><scale x="2" y="2"/></transform></texture>
        <texture name="roughness" type="bitmap"><string name="filename" value="rough.png"/>
          <boolean name="raw" value="true"/></texture>
      </bsdf></bsdf></bsdf>
  </shape>
</scene>"""

SKY = """<scene version="3.0.0">
  <default name="spp" value="4"/>
  <integrator type="path"/>{cameras}
  <emitter type="envmap"><string name="filename" value="photo.png"/></emitter>
  <shape type="rectangle">
    <bsdf type="mask">
      <texture name="opacity" type="bitmap"><string name="filename" value="leaf.png"/></texture>
      <bsdf type="blendbsdf">
        <texture name="weight" type="bitmap"><string name="filename" value="leaf.png"/>
          <boolean name="raw" value="true"/></texture>
        <bsdf type="diffuse"/>
        <bsdf type="diffuse">
          <texture name="reflectance" type="bitmap"><string name="filename" value="photo.png"/>
          </texture></bsdf>
      </bsdf></bsdf>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><scale value="0.5"/><translate x="0.9" z="0.2"/></transform>
    <emitter type="area">
      <texture name="radiance" type="bitmap"><string name="filename" value="photo.png"/></texture>
    </emitter>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><translate z="-20" x="60"/></transform>
    <bsdf type="diffuse">
      <texture name="reflectance" type="bitmap"><string name="filename" value="hidden.png"/>
        </texture></bsdf>
  </shape>
</scene>"""


def save_images(folder):
    """The images of the scenes."""
    side = 32
    y, x = np.mgrid[:side, :side] / side
    eg.save_image(folder / "photo.png", eg.sample("coffee")[:192:6, :192:6])
    eg.save_image(folder / "poster.png", eg.sample("coffee")[:384:4, :384:4])
    eg.save_image(folder / "rough.png", 0.3 + 0.4 * np.sin(5 * x) ** 2)
    eg.save_image(folder / "leaf.png", (np.hypot(x - 0.5, y - 0.5) < 0.4).astype(float))
    eg.save_image(folder / "hidden.png", np.stack([x, y, x], axis=2))
    n = np.stack([0.3 * np.sin(9 * x), 0 * x, np.ones_like(x)], axis=2)
    eg.save_image(folder / "normals.png", 0.5 + 0.5 * n / np.linalg.norm(n, axis=2, keepdims=True))
    return folder


def wall(folder):
    """A wall with a photo, used twice, and maps nested in a normal map; two cameras."""
    cameras = CAMERA.format(origin="0,0,4") + CAMERA.format(origin="2,1,3")
    (folder / "wall.xml").write_text(WALL.format(cameras=cameras))
    return folder / "wall.xml"


def sky(folder):
    """An environment map, a cut-out leaf, a lamp, and an image that no camera sees."""
    (folder / "sky.xml").write_text(SKY.format(cameras=CAMERA.format(origin="0,0,4")))
    return folder / "sky.xml"


def room(mi, folder):
    """A dictionary: a mesh in a file, a bump map, and a bitmap inside a checkerboard."""
    mi.load_dict({"type": "cube"}).write_ply(str(folder / "cube.ply"))
    photo = {"type": "bitmap", "filename": str(folder / "photo.png")}
    rough = {"type": "bitmap", "filename": str(folder / "rough.png"), "raw": True}
    return {
        "type": "scene",
        "integrator": {"type": "direct"},
        "sensor": camera([0, 0, 4]),
        "lamp": {"type": "constant"},
        "cube": {
            "type": "ply",
            "filename": str(folder / "cube.ply"),
            "bsdf": {
                "type": "bumpmap",
                "arbitrary": rough,
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {
                        "type": "checkerboard",
                        "color0": photo,
                        "color1": {"type": "rgb", "value": 0.3},
                    },
                },
            },
        },
    }


def _camera(mi, place, target):
    to_world = mi.ScalarTransform4f().look_at(place, target, [0, 0, 1])
    film = {"type": "hdrfilm", "width": 48, "height": 36, "rfilter": {"type": "box"}}
    sampler = {"type": "independent", "sample_count": 64}
    lens = {"type": "perspective", "fov": 45, "to_world": to_world}
    return {**lens, "film": film, "sampler": sampler}


def _bitmap(folder, name, **properties):
    file = str(folder / f"{name}.png")
    return {"type": "bitmap", "filename": file, "wrap_mode": "clamp", **properties}


def cornell(mi, folder):
    """Mitsuba's own Cornell box with a photo on the wall."""
    scene = mi.cornell_box()
    scene["back"]["bsdf"] = {"type": "diffuse", "reflectance": _bitmap(folder, "photo")}
    scene["sensor"] = {**scene["sensor"], "sampler": {"type": "independent", "sample_count": 64}}
    scene["sensor"]["film"].update(width=48, height=48, rfilter={"type": "box"})
    return scene


def preview(mi, folder):
    """A ball of a material with three maps, on a checkerboard under a sky."""
    at = mi.ScalarTransform4f()
    data = {"raw": True, "to_uv": at.scale([2, 1, 1]), "wrap_mode": "repeat"}
    coat = {
        "type": "principled",
        "base_color": _bitmap(folder, "photo"),
        "roughness": _bitmap(folder, "rough", **data),
    }
    coat = {"type": "normalmap", "normalmap": _bitmap(folder, "normals", **data), "bsdf": coat}
    board = {"type": "checkerboard", "to_uv": at.scale([4, 4, 1])}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "camera": _camera(mi, [0, -5, 2], [0, 0, 1]),
        "sky": {"type": "envmap", "filename": str(folder / "photo.png")},
        "floor": {
            "type": "rectangle",
            "to_world": at.scale(3),
            "bsdf": {"type": "diffuse", "reflectance": board},
        },
        "ball": {"type": "sphere", "center": [0, 0, 1], "bsdf": coat},
    }


def indoors(mi, folder):
    """A room: a sky, a floor, a wall with relief, a leaf that is cut out, and a screen."""
    at = mi.ScalarTransform4f()
    upright = at.rotate([1, 0, 0], 90).scale([1, -1, 1])
    paint = {"type": "diffuse", "reflectance": _bitmap(folder, "poster")}
    relief = {"type": "bumpmap", "heights": _bitmap(folder, "rough", raw=True), "bsdf": paint}
    leaf = {"type": "mask", "opacity": _bitmap(folder, "leaf", raw=True)}
    light = 4 * np.array(mi.Bitmap(str(folder / "photo.png")), np.float32) / 255
    screen = {"type": "bitmap", "bitmap": mi.Bitmap(light), "wrap_mode": "clamp"}
    glossy = {"type": "roughplastic", "diffuse_reflectance": _bitmap(folder, "poster")}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "camera": _camera(mi, [0, -5, 1.6], [0, 0, 1.2]),
        "other": _camera(mi, [2, -4, 2], [0, 0, 1]),
        "sky": {"type": "envmap", "filename": str(folder / "photo.png")},
        "floor": {"type": "rectangle", "to_world": at.scale(3), "bsdf": glossy},
        "wall": {
            "type": "rectangle",
            "to_world": at.translate([0, 2, 1.6]) @ upright.scale(2),
            "bsdf": {"type": "twosided", "bsdf": relief},
        },
        "plant": {
            "type": "rectangle",
            "to_world": at.translate([-1, 0, 1]) @ upright.scale(0.8),
            "bsdf": {**leaf, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
        },
        "screen": {
            "type": "rectangle",
            "to_world": at.translate([1, 1.9, 1.6]) @ upright.scale(0.6),
            "emitter": {"type": "area", "radiance": screen},
        },
    }
