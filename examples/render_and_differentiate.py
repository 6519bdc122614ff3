"""
Render and differentiate by hand
================================

Write three Gaussians by hand, render them, and differentiate the picture in both modes. Then find
the Gaussians again from the picture alone.
"""

import sys
from dataclasses import replace
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Dr.Jit: it finds libLLVM)
import drjit as dr
from drjit.auto.ad import Array2f, Float
from drjit.opt import Adam

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# A set by hand
# -------------
#
# A mean is x, y in pixels, and y points down. A factor (a, b, c) is one over a width: (0.1, 0, 0.2)
# has standard deviations of 10 and 5 pixels along x and y, and b shears. The Gaussians add up, so
# their order does not count. The space "rgb" takes colours as they are.

truth = eg.Gaussians.from_arrays(
    mean=[[20, 16], [30, 28], [48, 22]],
    factor=[[0.15, 0.0, 0.15], [0.1, 0.05, 0.2], [0.3, -0.1, 0.1]],
    color=[[0.8, 0.1, 0.0], [0.1, 0.7, 0.1], [0.5, 0.5, 0.4]],
    background=[0.05, 0.05, 0.2],
    size=(64, 48),
    space="rgb",
)
target = eg.render(truth)  # a Dr.Jit tensor: 48 rows, 64 columns, 3 channels
eg.save_image(folder / "target.png", target, encoding="srgb")

start = eg.Gaussians.from_arrays(
    mean=[[14, 24], [34, 20], [52, 30]],
    factor=[[0.12, 0.0, 0.12]] * 3,
    color=[[0.4, 0.4, 0.4]] * 3,
    background=[0, 0, 0],
    size=(64, 48),
    space="rgb",
)

# %%
# Reverse mode
# ------------
#
# Reverse mode gives the derivatives of one number with respect to all parameters. The gradient is a
# set with the same fields.

dr.enable_grad(start)
loss = dr.mean(dr.square(eg.render(start) - target))
dr.backward(loss)
gradient = dr.grad(start)
reverse = dr.sum(gradient.mean.x)[0]

# %%
# Forward mode
# ------------
#
# Forward mode gives the derivatives of all pixels with respect to one number. Here the number moves
# all three Gaussians to the right. Grey pixels do not change.

shift = Float(0)
dr.enable_grad(shift)
still = dr.detach(start)
image = eg.render(replace(still, mean=still.mean + Array2f(shift, 0)))
dr.forward(shift)
change = dr.grad(image)
eg.save_image(folder / "change.png", 0.5 + 5 * change, encoding="srgb")

# %%
# The chain rule gives the derivative of the loss, which the reverse mode gave above.

forward = dr.mean(2 * (dr.detach(image) - target) * change).item()
print(f"a shift changes the loss by {reverse:.6f} a pixel (reverse), {forward:.6f} (forward)")

# %%
# Gradient descent
# ----------------
#
# Dr.Jit's Adam takes one rate for each kind of parameter: pixels, 1 / pixels, colour.

fields = ("mean", "factor", "color", "background")
optimizer = Adam(lr=0.02, params={name: getattr(start, name) for name in fields})
optimizer.set_learning_rate({"mean": 0.3, "factor": 0.005})

losses = []
for _ in range(300):
    found = replace(start, **optimizer)  # the set that the optimiser holds now
    loss = dr.mean(dr.square(eg.render(found) - target))
    dr.backward(loss)
    optimizer.step()
    losses.append(loss.item())

found = replace(start, **optimizer)
eg.save_image(folder / "found.png", eg.picture_of(found))
print(f"the loss went from {losses[0]:.4f} to {losses[-1]:.1e} in {len(losses)} steps")
print("means found:", found.to_arrays()["mean"].round(2).tolist())
