"""
A poster recovered from photos
==============================

A poster hangs on a wall. All there is are two photos of the wall. Gradient descent through the
renderer finds the poster in two stages: first the coefficients of an eigenbasis, then all
parameters of the Gaussians. This page needs Mitsuba: ``pip install '.[plugins]'``.
"""

import sys
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it finds libLLVM)
import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.eigenbasis.eigengs import SHIPPED
from eigengs_dr.plugins import gaussians_of, keep_in_bounds, texture_of

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()

# %%
# The photos
# ----------
#
# The scene is a poster under a lamp, seen by two cameras. The photos are made here, with a poster
# that is a plain bitmap. The eigenbasis was not trained on this picture.

NAME = "poster.bsdf.reflectance"


def camera(x):
    """Stand in front of the poster, moved to the side by x."""
    return {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.ScalarTransform4f().look_at([x, 0.3, 3], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 128, "height": 128},
    }


def room(texture):
    """Make the scene with another poster."""
    # The first row of a picture lies at v = 0, which is the lower edge of a rectangle.
    upright = mi.ScalarTransform4f().translate([0, 1, 0]).scale([1, -1, 1])
    reflectance = {**texture, "to_uv": upright, "wrap_mode": "clamp"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "left": camera(-1.2),
            "right": camera(1.2),
            "lamp": {"type": "point", "position": [0, 2, 2], "intensity": 15.0},
            "poster": {
                "type": "rectangle",
                "bsdf": {"type": "diffuse", "reflectance": reflectance},
            },
        }
    )


photo = eg.sample("coffee")[60:316, 180:436]
photo = photo.reshape(128, 2, 128, 2, 3).mean(axis=(1, 3))  # half the size
eg.save_image(folder / "poster.png", photo)
known = room({"type": "bitmap", "filename": str(folder / "poster.png")})
targets = [mi.render(known, sensor=k, spp=64) for k in range(2)]
both = np.concatenate([np.array(image) for image in targets], axis=1)
mi.util.write_bitmap(str(folder / "poster_target.png"), mi.TensorXf(both), write_async=False)

# %%
# Both stages change their unknowns by Adam. Each step renders one of the two views, and compares
# the rendering with the photo. Without ``params`` a rendering has no derivatives. The seed changes
# with the step, so that the descent does not fit the noise.

losses = []


def render_loss(scene, parameters):
    """Compare a photo with a rendering of the present poster."""
    step = len(losses)
    image = mi.render(scene, params=parameters, sensor=step % 2, spp=1, seed=step)
    loss = dr.mean(dr.square(image - targets[step % 2]))
    losses.append(loss.item())
    return loss


# %%
# Stage one: coefficients
# -----------------------
#
# The model "natural" ships with the package. A texture with a model has one parameter, the
# coefficients. Here they are in units of about the standard deviation of each component. They start
# at 0, which is the mean image.

file = SHIPPED["natural"]
model = eg.EigenGS.load(file)
scene = room({"type": "gaussian_texture", "model": str(file)})
parameters = mi.traverse(scene)
key = f"{NAME}.coefficients"

variances = np.zeros(parameters[key].shape, np.float32)
for row, values in zip(variances, model.eigenvalues, strict=True):
    row[: len(values)] = values
# Components of less than a twentieth of the largest variance move less and less.
largest = variances.max()
scale = mi.TensorXf(np.sqrt(variances / (0.05 + variances / largest)))

optimizer = mi.ad.Adam(lr=0.3, beta_1=0.5, params={"z": dr.zeros(mi.TensorXf, scale.shape)})
for _ in range(16):
    parameters[key] = optimizer["z"] * scale
    parameters.update()
    loss = render_loss(scene, parameters)
    # A PCA takes the pictures of its family as normally distributed: that is the prior.
    prior = 1e-6 * dr.sum(dr.square(optimizer["z"]), axis=None)
    dr.backward(loss + prior)
    optimizer.step()

found = dr.detach(optimizer["z"] * scale).numpy()
rows = [row[:k] for row, k in zip(found, model.components, strict=True)]
guess = eg.picture_of(model.reconstruct(tuple(rows)), width=128).clip(0, 1)
print(f"PSNR after the coefficients, {len(losses)} steps: {eg.psnr(photo, guess):.1f} dB")

# %%
# Stage two: Gaussians
# --------------------
#
# The second stage places 3,000 Gaussians by the first result, in linear light, and then changes all
# of their parameters. The rates are in units of light, in pixels, and in 1 / pixels.

start = eg.fit(guess, gaussians=3000, iterations=0, space="linear").gaussians
scene = room(texture_of(start))
parameters = mi.traverse(scene)
rates = {f"{NAME}.color": 0.02, f"{NAME}.mean": 0.1, f"{NAME}.factor": 0.005}
optimizer = mi.ad.Adam(lr=0.02, params={key: parameters[key] for key in rates})
optimizer.set_learning_rate(rates)
parameters.update(optimizer)

for _ in range(104):
    dr.backward(render_loss(scene, parameters))
    optimizer.step()
    # A step may move a Gaussian out of the picture, or make it a spike.
    keep_in_bounds(optimizer, NAME, start)
    parameters.update(optimizer)
print(f"the loss went from {losses[0]:.5f} to {losses[-1]:.5f} in {len(losses)} steps")

# %%
# The poster
# ----------
#
# The result is a set like any other. ``picture_of`` codes its linear light as sRGB.

result = gaussians_of(parameters, NAME, start)
result.save(folder / "poster_found.npz")
eg.save_image(folder / "poster_found.png", eg.picture_of(result))
print(f"PSNR of the poster that was found: {eg.psnr(photo, eg.picture_of(result)):.1f} dB")

image = mi.render(scene, sensor=0, spp=16)
mi.util.write_bitmap(str(folder / "poster_rendered.png"), image, write_async=False)
