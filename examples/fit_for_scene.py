"""No more Gaussians than a scene shows: the same poster, far away, at some distance, and close."""

import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it names a libLLVM that works)
import mitsuba as mi
import numpy as np

from eigengs_dr.cli.pictures import overlay
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.montage import join_pictures, text_line
from eigengs_dr.plugins import texture_of

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()

photo = eg.sample("coffee")[60:316, 180:436]
eg.save_image(folder / "budget_photo.png", photo)
BITMAP = {"type": "bitmap", "filename": str(folder / "budget_photo.png"), "wrap_mode": "clamp"}
SIDE = 128


def room(texture, distance):
    """Make a scene: a poster under a lamp, from the front; the image is in the texture."""
    # Rows of an image run down, v of a rectangle runs up.
    upright = mi.ScalarTransform4f().scale([1, -1, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 36,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, distance], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": SIDE,
                    "height": SIDE,
                    "rfilter": {"type": "box"},
                },
            },
            "lamp": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
            "poster": {
                "type": "rectangle",
                "to_world": upright,
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}},
            },
        }
    )


def photograph(texture, distance):
    """Render, with the same noise for every texture, and code the light as sRGB."""
    light = np.array(mi.render(room(texture, distance), spp=64, seed=1))
    return to_coded(light.clip(0, 1))


def strip(name, full, reduced, found):
    """Put a rendering with the bitmap, one with the Gaussians, and their outlines side by side."""
    pictures = {
        f"{name}: bitmap": full.repeat(2, axis=0).repeat(2, axis=1),
        f"{len(found.gaussians)} Gaussians": reduced.repeat(2, axis=0).repeat(2, axis=1),
        "outlines of them": overlay(found.gaussians, eg.picture_of(found.gaussians)),
    }
    cells = [join_pictures([text_line(text, 2 * SIDE), p], 0, 0) for text, p in pictures.items()]
    return join_pictures(cells, 1)


strips = []
for name, distance in (("far", 24), ("middle", 8), ("near", 3.2)):
    # Of a scene its cameras count, and where the texture is; here, that is a bitmap.
    found = eg.fit_for_scene(room(BITMAP, distance), "poster.bsdf.brdf_0.reflectance", photo)
    poster = texture_of(found.gaussians, wrap_mode="clamp")
    full, reduced = photograph(BITMAP, distance), photograph(poster, distance)
    texels = found.visibility.footprint.min() / 0.4  # a footprint is 0.4 of a pixel
    print(
        f"{name}: a pixel is {texels:.1f} texels, {len(found.gaussians)} Gaussians; "
        f"PSNR {found.psnr[0]:.1f} dB on the poster, {eg.psnr(full, reduced):.1f} dB rendered"
    )
    strips.append(strip(name, full, reduced, found))
eg.save_image(folder / "budget.png", join_pictures(strips, 0))
