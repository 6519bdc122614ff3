"""
A texture in a scene
====================

Fit a photo, cover a floor with it in Mitsuba, and filter the distant part in closed form. This page
needs Mitsuba: ``pip install '.[plugins]'``.
"""

import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it finds libLLVM)
import drjit as dr
import mitsuba as mi

from eigengs_dr.plugins import pixel_angle, texture_of

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()  # Mitsuba now knows the texture "gaussian_texture"

# %%
# A reflectance adds up in linear light, not in sRGB codes. So fit it with ``space="linear"``.

photo = eg.sample("coffee")[:, 100:500]
cups = eg.fit(photo, gaussians=4000, iterations=100, space="linear").gaussians

# %%
# The floor repeats the picture 40 x 40 times. ``texture_of`` writes the set as a dictionary for
# ``mi.load_dict``. A saved set is
# ``{"type": "gaussian_texture", "filename": "cups.npz", "to_uv": ...}``.

camera = mi.load_dict(
    {
        "type": "perspective",
        "fov": 45,
        "to_world": mi.ScalarTransform4f().look_at([0, 0.6, 0], [0, 0.35, -1], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 320, "height": 200, "rfilter": {"type": "box"}},
    }
)


def floor(prefilter):
    """Make a scene: a floor of 40 x 40 pictures in the sun."""
    tiles = mi.ScalarTransform4f().scale([40, 40, 1])
    texture = texture_of(cups, to_uv=tiles, wrap_mode="repeat", prefilter=prefilter)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": camera,
            "sun": {"type": "directional", "direction": [0.3, -1, -0.5], "irradiance": 3.0},
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(20),
                "bsdf": {"type": "diffuse", "reflectance": texture},
            },
        }
    )


def write(name, image):
    """Write a rendering as a PNG file."""
    mi.util.write_bitmap(str(folder / f"{name}.png"), image, write_async=False)


# %%
# A distant pixel covers many pictures. One sample sees one point of them, which is noise. With the
# angle of a pixel, one sample sees their mean: a Gaussian blurred by a Gaussian is a Gaussian.
#
# The first picture has one sample per pixel at points, the second one prefiltered sample per pixel,
# and the third 128 samples per pixel at points.

points = mi.render(floor(prefilter=0.0), spp=1)
write("floor_points", points)
filtered = mi.render(floor(prefilter=pixel_angle(camera)), spp=1)
write("floor_filtered", filtered)
truth = mi.render(floor(prefilter=0.0), spp=128)
write("floor_truth", truth)

# %%
# The error is the root of the mean squared difference from the picture with 128 samples.


def error_of(image):
    """Compare a rendering with the one of many samples."""
    return dr.sqrt(dr.mean(dr.square(image - truth))).item()


error, error_filtered = error_of(points), error_of(filtered)
print(f"error of one sample per pixel: {error:.3f} at points, {error_filtered:.3f} prefiltered")
