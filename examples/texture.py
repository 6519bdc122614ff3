"""A texture: fit a photo, pave a floor with it in Mitsuba, and filter what lies far away."""

import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it names a libLLVM that works)
import drjit as dr
import mitsuba as mi

from eigengs_dr.plugins import pixel_angle, texture_of

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()  # Mitsuba now knows a texture named "gaussian_texture"

# Light adds up, sRGB codes do not: what shall be a reflectance is best fitted in linear light.
photo = eg.sample("coffee")[:, 100:500]
cups = eg.fit(photo, gaussians=4000, iterations=100, color="linear").gaussians

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
    # Of a saved set: {"type": "gaussian_texture", "filename": "cups.npz", "to_uv": tiles, ...}
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


# Far away, a pixel covers many pictures. One sample sees one point of them, which is noise; with
# the angle of a pixel, a lookup returns the mean over what the pixel covers: Gaussians smoothed by
# a Gaussian are Gaussians again.
points = mi.render(floor(prefilter=0.0), spp=1)
filtered = mi.render(floor(prefilter=pixel_angle(camera)), spp=1)
truth = mi.render(floor(prefilter=0.0), spp=128)

for name, image in (("points", points), ("filtered", filtered), ("truth", truth)):
    mi.util.write_bitmap(str(folder / f"floor_{name}.png"), image, write_async=False)


def error_of(image):
    """Root of the mean squared difference to what many samples give."""
    return dr.sqrt(dr.mean(dr.square(image - truth))).item()


error, error_filtered = error_of(points), error_of(filtered)
print(f"error of one sample a pixel: {error:.3f} at points, {error_filtered:.3f} prefiltered")
