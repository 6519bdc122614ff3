"""
A scene without bitmaps
=======================

``eg.convert_scene`` replaces the bitmaps of a scene by as many Gaussians as its cameras resolve.
The command ``eigengs-dr convert scene.xml -o folder/`` does the same. This page needs Mitsuba:
``pip install '.[plugins]'``.
"""

import shutil
import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it finds libLLVM)
import mitsuba as mi
import numpy as np

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
images = folder / "convert"
images.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()

# %%
# The scene has a photo on the floor, another one on the wall, a ball with maps of roughness and
# normals, and an environment map.

y, x = np.mgrid[:128, :128] / 128
waves = np.sin(2 * np.pi * (5 * x + np.sin(2 * np.pi * y)))
normals = np.stack([0.4 * waves, 0.2 * np.roll(waves, 30, 0), np.ones_like(waves)], axis=2)
normals /= np.linalg.norm(normals, axis=2, keepdims=True)
for name, image in {
    "floor": eg.sample("coffee")[:384:2, 100:484:2],
    "cat": eg.sample("chelsea")[:300:2, 75:375:2],
    "roughness": 0.35 + 0.25 * waves,
    "normals": 0.5 + 0.5 * normals,
    "sky": np.linspace([0.5, 0.6, 0.8], [0.9, 0.8, 0.7], 16)[:, None].repeat(32, axis=1),
}.items():
    eg.save_image(images / f"{name}.png", image)


def bitmap(name, **properties):
    """Return the texture of an image."""
    return {"type": "bitmap", "filename": str(images / f"{name}.png"), **properties}


at = mi.ScalarTransform4f()
data = {"raw": True, "to_uv": at.scale([4, 2, 1])}
scene = {
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 5},
    "camera": {
        "type": "perspective",
        "fov": 42,
        "to_world": at.look_at([0, -6, 2.2], [0, 0, 1], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 96, "height": 72},
        "sampler": {"type": "independent", "sample_count": 32},
    },
    "sky": {"type": "envmap", "filename": str(images / "sky.png")},
    "floor": {
        "type": "rectangle",
        "to_world": at.scale(3),
        "bsdf": {"type": "diffuse", "reflectance": bitmap("floor")},
    },
    "wall": {
        "type": "rectangle",
        "to_world": at.translate([0, 2, 1.6]).rotate([1, 0, 0], 90).scale([1.6, -1.6, 1]),
        "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap("cat")}},
    },
    "ball": {
        "type": "sphere",
        "center": [0.9, -1.6, 0.8],
        "radius": 0.8,
        "bsdf": {
            "type": "normalmap",
            "normalmap": bitmap("normals", **data),
            "bsdf": {"type": "principled", "roughness": bitmap("roughness", **data)},
        },
    },
}

# %%
# The table says for each image what its bitmap costs, how many Gaussians replace it, what these
# cost, how many of them overlap at a point, and how the camera sees them. ``replace_all`` makes a
# scene whose textures are all differentiable; without it, a bitmap that takes less memory, or where
# more than 32 Gaussians overlap, stays.

shutil.rmtree(folder / "converted", ignore_errors=True)
result = eg.convert_scene(scene, folder / "converted", replace_all=True)
for t in result.textures:
    print(
        f"{t.file}: {t.width}x{t.height} texels, {t.bytes} bytes; "
        f"{t.gaussians} Gaussians, {t.gaussian_bytes} bytes, overlap {t.overlap:.0f}, "
        f"{t.psnr:.1f} dB"
    )
for name, reason in result.left:
    print(f"left alone: {name}: {reason}")
before, after = (sum(getattr(t, k) for t in result.textures) for k in ("bytes", "gaussian_bytes"))
print(f"{after / before:.2f} times the memory; {result.psnr[0]:.1f} dB between the renderings")

# %%
# Before, after, and 8 times their difference:

names = ("before", "after", "difference")
shown = [eg.load_image(folder / "converted" / f"{name}-1.png") for name in names]
eg.save_image(folder / "converted.png", np.concatenate(shown, axis=1))
