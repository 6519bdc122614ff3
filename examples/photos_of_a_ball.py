"""
A texture recovered from photos
===============================

A painted ball stands under a lamp. All there is are six photos of it, with noise. Gradient descent
through the renderer finds the paint: once as texels, once as Gaussians, in as many steps. This page
needs Mitsuba: ``pip install '.[plugins]'``.
"""

import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it finds libLLVM)
import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.image.color import to_coded, to_linear
from eigengs_dr.plugins import photo_loss
from eigengs_dr.viewer.pictures import overlay

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")

# %%
# The photos
# ----------
#
# Six cameras stand around the ball; a seventh, between two of them, takes no photo and judges what
# is found. The photos are made here, with paint that is known.

CAMERAS, SIDE, TEXELS, STEPS = 6, 128, 128, 240


def save(name, *pictures):
    """Write pictures side by side, at twice the size unless they are large already."""
    large = [p if len(p) > SIDE else p.repeat(2, axis=0).repeat(2, axis=1) for p in pictures]
    eg.save_image(folder / name, np.concatenate(large, axis=1).clip(0, 1))


def room(paint):
    """Make the scene with other paint, an array (H, W, 3) of linear light."""
    at = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "pixel_format": "rgb", "width": SIDE, "height": SIDE}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 12.0}}
    bitmap = {"type": "bitmap", "data": mi.TensorXf(paint), "raw": True}
    scene = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": 2},
        "sky": {"type": "constant", "radiance": 0.4},
        "lamp": {
            "type": "rectangle",
            "to_world": at.look_at([2, 4, 3], [0, 0, 0], [0, 1, 0]),
            "emitter": lamp,
        },
        "ball": {
            "type": "sphere",
            "to_world": at.rotate([1, 0, 0], 90),
            "bsdf": {"type": "diffuse", "reflectance": bitmap},
        },
    }
    for camera, turn in enumerate([*np.arange(CAMERAS), 0.5]):
        angle = 2 * np.pi * turn / CAMERAS
        place = [3.6 * np.sin(angle), 1.2 * np.cos(3 * angle), 3.6 * np.cos(angle)]
        view = at.look_at(place, [0, 0, 0], [0, 1, 0])
        scene[f"camera{camera}"] = {
            "type": "perspective",
            "to_world": view,
            "fov": 36,
            "film": film,
        }
    return mi.load_dict(scene)


photo = eg.sample("astronaut")[:256, 100:356]
photo = photo.reshape(TEXELS, 2, TEXELS, 2, 3).mean(axis=(1, 3))  # half the size
known = room(np.float32(to_linear(photo)))
photos = [mi.render(known, sensor=k, spp=4, seed=1000 + k).numpy() for k in range(CAMERAS)]
view = to_coded(mi.render(known, sensor=CAMERAS, spp=512).numpy())
save("photos.png", *(to_coded(photo) for photo in photos[::2]))

# %%
# Texels
# ------
#
# A bitmap of grey, and Adam. Each step renders one of the cameras and compares it with its photo.
# The seed changes with the step, so that the descent does not fit the noise of renderings.

GREY = np.full((TEXELS, TEXELS, 3), 0.2, np.float32)
scene = room(GREY)
parameters = mi.traverse(scene)
key = "ball.bsdf.reflectance.data"
adam = mi.ad.Adam(lr=0.02, beta_1=0.5, params={key: parameters[key]})
for step in range(STEPS):
    adam[key] = dr.clip(adam[key], 0, 1)
    parameters.update(adam)
    adam.set_learning_rate(0.001 + 0.019 * (1 - step / STEPS))
    image = mi.render(scene, parameters, sensor=step % CAMERAS, spp=4, seed=step)
    dr.backward(dr.mean(dr.square(image - mi.TensorXf(photos[step % CAMERAS])), axis=None))
    adam.step()
texels = to_coded(dr.clip(adam[key], 0, 1).numpy())


def seen_by_the_judge(coded):
    """Render paint of sRGB codes by the camera that took no photo."""
    light = np.float32(to_linear(coded.clip(0, 1)))
    return to_coded(mi.render(room(light), sensor=CAMERAS, spp=512).numpy())


by_texels = seen_by_the_judge(texels)
print(f"{3 * TEXELS**2:,} numbers as texels: {eg.psnr(view, by_texels):.1f} dB in another view")

# %%
# Gaussians
# ---------
#
# ``photo_loss`` names the bitmap to recover, and the photos. ``eg.fit`` does the rest, and
# chooses the number of Gaussians.

loss = photo_loss(room(GREY), "ball.bsdf.reflectance", photos, sensors=range(CAMERAS))
result = eg.fit(loss=loss, size=(TEXELS, TEXELS), iterations=STEPS, space="linear")
result.save(folder / "paint.npz")
by_gaussians = seen_by_the_judge(result.image)
numbers = 8 * len(result.gaussians)
print(f"{numbers:,} numbers as Gaussians: {eg.psnr(view, by_gaussians):.1f} dB in another view")

# %%
# The paint: as it is, as texels, as Gaussians, and the outlines of the Gaussians. Each Gaussian is
# seen by many pixels of the photos, so that their noise averages out.

found = result.image.clip(0, 1).astype(np.float32)
large = eg.picture_of(result.gaussians, width=2 * SIDE)
save("paint.png", photo, texels, found, overlay(result.gaussians, large))

# %%
# Errors
# ------
#
# Four times the errors of texels and of Gaussians: in the paint, and in the view by the seventh
# camera. Texels keep the noise. Gaussians lose edges that are finer than a pixel of a photo. Both
# miss the last rows of the paint, a pole of the ball, which all cameras see at a slant. With photos
# of 16 samples, texels are ahead: then there is little noise to keep out.

errors = [np.abs(photo - paint) for paint in (texels, found)]
errors += [np.abs(view - shown) for shown in (by_texels, by_gaussians)]
save("errors.png", *(4 * error for error in errors))
