"""Find a texture through the renderer: from one rendering of a poster, back to the poster."""

import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it names a libLLVM that works)
import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.plugins import gaussians_of, keep_in_bounds, texture_of

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()


def room(texture):
    """Make a scene: a poster on a wall, seen from the right, under a lamp."""
    # The first row of a picture lies at v = 0, which is the lower edge of a rectangle.
    upright = mi.ScalarTransform4f().translate([0, 1, 0]).scale([1, -1, 1])
    reflectance = {**texture, "to_uv": upright, "wrap_mode": "clamp"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 42,
                "to_world": mi.ScalarTransform4f().look_at([1.2, 0.3, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 160, "height": 160},
            },
            "lamp": {"type": "point", "position": [0, 2, 2], "intensity": 15.0},
            "poster": {
                "type": "rectangle",
                "bsdf": {"type": "diffuse", "reflectance": reflectance},
            },
        }
    )


# All that we are given is a rendering. It is made here, with a poster that is a plain bitmap.
photo = eg.sample("astronaut")[:160, 144:304]
eg.save_image(folder / "poster.png", photo)
target = mi.render(room({"type": "bitmap", "filename": str(folder / "poster.png")}), spp=64)

# What we begin with: a grid of Gaussians without colour, on a grey ground.
grey = np.full_like(photo, 0.5)
start = eg.fit(grey, gaussians=1600, init="grid", iterations=0, color="linear").gaussians
scene = room(texture_of(start))

# The parameters of the texture, and about how far one step moves them: in units of light, in
# pixels, and in 1 / pixels.
parameters = mi.traverse(scene)
name = "poster.bsdf.reflectance"
rates = {f"{name}.color": 0.03, f"{name}.mean": 0.1, f"{name}.factor": 0.005}
optimizer = mi.ad.Adam(lr=0.03, params={key: parameters[key] for key in rates})
optimizer.set_learning_rate(rates)
parameters.update(optimizer)

losses = []
for step in range(60):
    # Without `params` a rendering has no derivatives. Its seed must change, or noise is learnt too.
    image = mi.render(scene, params=parameters, spp=1, seed=step)
    loss = dr.mean(dr.square(image - target))
    dr.backward(loss)
    optimizer.step()
    # A step may take a Gaussian out of the picture, or make it a spike.
    keep_in_bounds(optimizer, name, start)
    parameters.update(optimizer)
    losses.append(loss.item())
print(f"the loss went from {losses[0]:.5f} to {losses[-1]:.5f} in {len(losses)} steps")

# The poster itself, which nobody showed us: a set like any other, in linear light, which
# `picture_of` codes as sRGB.
found = gaussians_of(parameters, name, start)
found.save(folder / "poster_found.npz")
eg.save_image(folder / "poster_found.png", eg.picture_of(found))
print(f"PSNR of the poster that was found: {eg.psnr(photo, eg.picture_of(found)):.1f} dB")

for key, image in (("target", target), ("rendered", mi.render(scene, spp=16))):
    mi.util.write_bitmap(str(folder / f"poster_{key}.png"), image, write_async=False)
