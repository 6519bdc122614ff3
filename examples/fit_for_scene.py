"""
As many Gaussians as a camera resolves
======================================

The same poster hangs far away, at a middle distance, and close. ``eg.fit_for_scene`` finds the
number of Gaussians that each camera needs. This page needs Mitsuba: ``pip install '.[plugins]'``.
"""

import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it finds libLLVM)
import mitsuba as mi
import numpy as np

from eigengs_dr.plugins import texture_of

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()

photo = eg.sample("coffee")[60:316, 180:436]
photo = photo.reshape(128, 2, 128, 2, 3).mean(axis=(1, 3))  # half the size
eg.save_image(folder / "budget_photo.png", photo)

# %%
# The scene is a poster under even light. Its texture is a bitmap at first.

BITMAP = {"type": "bitmap", "filename": str(folder / "budget_photo.png"), "wrap_mode": "clamp"}
SIDE = 64


def room(texture, distance):
    """Make a scene: a poster, seen from the front."""
    # Rows of an image run down, v of a rectangle runs up.
    upright = mi.ScalarTransform4f().scale([1, -1, 1])
    camera = mi.ScalarTransform4f().look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {"type": "perspective", "fov": 36, "to_world": camera, "film": film},
            "lamp": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
            "poster": {
                "type": "rectangle",
                "to_world": upright,
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}},
            },
        }
    )


def photograph(texture, distance):
    """Render with the same noise for every texture; return sRGB in [0, 1]."""
    light = mi.Bitmap(mi.render(room(texture, distance), spp=64, seed=1))
    coded = light.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=True)
    return np.array(coded).clip(0, 1)


# %%
# The search needs the scene, the place of the texture, and the image. The camera decides how many
# Gaussians are enough for 40 dB. Left is the poster with the bitmap, right with the Gaussians.

rows = []
for name, distance in (("far", 24), ("middle", 10), ("near", 3.2)):
    found = eg.fit_for_scene(room(BITMAP, distance), "poster.bsdf.brdf_0.reflectance", photo)
    poster = texture_of(found.gaussians, wrap_mode="clamp")
    full, reduced = photograph(BITMAP, distance), photograph(poster, distance)
    texels = found.visibility.footprint.min() / 0.4  # a footprint is 0.4 of a pixel
    print(
        f"{name}: a pixel is {texels:.1f} texels, {len(found.gaussians)} Gaussians; "
        f"PSNR {found.psnr[0]:.1f} dB on the poster, {eg.psnr(full, reduced):.1f} dB rendered"
    )
    rows.append(np.concatenate([full, reduced], axis=1))
eg.save_image(folder / "budget.png", np.concatenate(rows))
