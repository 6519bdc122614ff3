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
  <emitter type="projector">
    <texture name="irradiance" type="bitmap"><string name="filename" value="photo.png"/></texture>
  </emitter>
</scene>"""


def save_images(folder):
    """The images of the scenes."""
    side = 32
    y, x = np.mgrid[:side, :side] / side
    eg.save_image(folder / "photo.png", eg.sample("coffee")[:192:6, :192:6])
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
    """An environment map, a cut-out leaf, a lamp, a projector, and an image that nobody sees."""
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


def cornell(mi, folder):
    """Mitsuba's own Cornell box with a photo on the wall."""
    photo = {"type": "bitmap", "filename": str(folder / "photo.png"), "wrap_mode": "clamp"}
    scene = mi.cornell_box()
    scene["back"]["bsdf"] = {"type": "diffuse", "reflectance": photo}
    scene["sensor"] = {**scene["sensor"], "sampler": {"type": "independent", "sample_count": 64}}
    scene["sensor"]["film"].update(width=48, height=48, rfilter={"type": "box"})
    return scene
