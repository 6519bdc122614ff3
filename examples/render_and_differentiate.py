"""Gaussians by hand: render them, differentiate both ways, and find them again from a picture."""

import sys
from dataclasses import replace
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Dr.Jit: it names a libLLVM that works)
import drjit as dr
from drjit.auto.ad import Array2f, Float
from drjit.opt import Adam

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

# --- A set by hand -------------------------------------------------------------------------------

# Three splats in an image of 64 x 48 pixels, on dark blue. A mean is x, y in pixels, y down. A
# factor a, b, c is one over a width: (0.1, 0, 0.2) has standard deviations of 10 and 5 pixels along
# x and y, and b shears. Splats add up, in any order, and space "rgb" takes colours as they are.
truth = eg.Gaussians.from_arrays(
    mean=[[20, 16], [30, 28], [48, 22]],
    factor=[[0.15, 0.0, 0.15], [0.1, 0.05, 0.2], [0.3, -0.1, 0.1]],
    color=[[0.8, 0.1, 0.0], [0.1, 0.7, 0.1], [0.5, 0.5, 0.4]],
    background=[0.05, 0.05, 0.2],
    size=(64, 48),
    space="rgb",
)
target = eg.render(truth)  # a Dr.Jit tensor: 48 rows, 64 columns, 3 channels
eg.save_image(folder / "target.png", target)

# Where we begin: three round grey splats, somewhere else, on black.
start = eg.Gaussians.from_arrays(
    mean=[[14, 24], [34, 20], [52, 30]],
    factor=[[0.12, 0.0, 0.12]] * 3,
    color=[[0.4, 0.4, 0.4]] * 3,
    background=[0, 0, 0],
    size=(64, 48),
    space="rgb",
)

# --- Reverse mode: one number, and its derivatives by all parameters -----------------------------

dr.enable_grad(start)
loss = dr.mean(dr.square(eg.render(start) - target))
dr.backward(loss)
gradient = dr.grad(start)  # a set of derivatives, with the same fields
reverse = dr.sum(gradient.mean.x)[0]

# --- Forward mode: one parameter, and the derivatives of all pixels by it ------------------------

# One number moves all three splats to the right. What does that do to the picture?
shift = Float(0)
dr.enable_grad(shift)
still = dr.detach(start)
image = eg.render(replace(still, mean=still.mean + Array2f(shift, 0)))
dr.forward(shift)
change = dr.grad(image)
eg.save_image(folder / "change.png", 0.5 + 5 * change)  # grey: stays as it is

# And so to the loss, whose derivative is known from above as well.
forward = dr.mean(2 * (dr.detach(image) - target) * change).item()
print(f"a shift changes the loss by {reverse:.6f} a pixel (reverse), {forward:.6f} (forward)")

# --- Gradient descent ----------------------------------------------------------------------------

# Dr.Jit's Adam, with a rate for each kind of parameter: pixels, 1 / pixels, colour.
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
eg.save_image(folder / "found.png", eg.render(found))
print(f"the loss went from {losses[0]:.4f} to {losses[-1]:.1e} in {len(losses)} steps")
print("means found:", found.to_arrays()["mean"].round(2).tolist())
