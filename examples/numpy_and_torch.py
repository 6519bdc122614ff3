"""
Inside a PyTorch loop
=====================

The rendering is one differentiable step of a PyTorch program. The first part of this page needs
NumPy alone. The second part needs PyTorch (``pip install torch``), and is skipped without it.
"""

import sys
from dataclasses import replace
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Dr.Jit: it finds libLLVM)
import drjit as dr
import numpy as np
from drjit.auto.ad import ArrayXf, TensorXf

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

photo = eg.sample("rocket")[40:232, 200:392]
rocket = eg.fit(photo, gaussians=1500, iterations=100, space="rgb").gaussians

# %%
# NumPy
# -----
#
# ``to_arrays`` returns plain arrays with one row per Gaussian: mean (N, 2), factor (N, 3),
# color (N, 3), and the background (3,). This code mirrors the set: it reflects x, and
# changes the sign of the shear b of the factor (a, b, c).

arrays = rocket.to_arrays()
arrays["mean"][:, 0] = rocket.width - arrays["mean"][:, 0]
arrays["factor"][:, 1] *= -1
mirrored = eg.Gaussians.from_arrays(**arrays, size=(rocket.width, rocket.height), space="rgb")

pixels = eg.render(rocket).numpy()
pixels_mirrored = eg.render(mirrored).numpy()
eg.save_image(folder / "rocket.png", pixels)
eg.save_image(folder / "rocket_mirrored.png", pixels_mirrored)
difference = np.abs(pixels[:, ::-1] - pixels_mirrored).max()
print(f"NumPy: the mirrored set and mirrored pixels differ by {difference:.4f} at most")

# %%
# PyTorch
# -------
#
# ``dr.wrap`` turns the rendering into a function of PyTorch tensors. The gradient passes through
# it. PyTorch's colours have one row per Gaussian; a set has one per channel.

try:
    import torch
except ImportError:
    torch = None
    print("PyTorch: skipped, as it is not installed (pip install torch)")

# %%
# Start from black Gaussians, and let an optimiser of PyTorch find the colours again.


def find_colors():
    """Return the first gradient of PyTorch, shape (N, 3)."""

    @dr.wrap(source="torch", target="drjit")
    def render(color):
        """Render the set with other colours: (N, 3) comes in, (height, width, 3) goes out."""
        return eg.render(replace(rocket, color=ArrayXf(color.T)))

    device = "cuda" if dr.backend_v(rocket.color) == dr.JitBackend.CUDA else "cpu"
    target = torch.tensor(photo, device=device)
    color = torch.zeros(len(rocket), 3, device=device, requires_grad=True)
    optimizer = torch.optim.Adam([color], lr=0.05)

    losses, first_gradient = [], None
    for _ in range(40):
        optimizer.zero_grad()
        loss = (render(color) - target).square().mean()
        loss.backward()
        losses.append(loss.item())
        if first_gradient is None:
            first_gradient = color.grad.cpu().numpy().copy()
        optimizer.step()
    eg.save_image(folder / "rocket_torch.png", render(color).detach().cpu())
    print(f"PyTorch: the loss went from {losses[0]:.1e} to {losses[-1]:.1e} in {len(losses)} steps")
    return first_gradient


gradient = find_colors() if torch else None

# %%
# Dr.Jit computes the same gradient without PyTorch.

if torch:
    black = ArrayXf(np.zeros((3, len(rocket)), np.float32))
    dr.enable_grad(black)
    loss = dr.mean(dr.square(eg.render(replace(rocket, color=black)) - TensorXf(photo)))
    dr.backward(loss)
    error = np.abs(dr.grad(black).numpy().T - gradient).max() / np.abs(gradient).max()
    print(f"PyTorch: its first gradient differs from Dr.Jit's by {error:.0e} of the largest entry")

# %%
# Batches as channels
# -------------------
#
# Colourings of one geometry, such as a batch from a network, need one rendering: colours (B, 3, N)
# are a set of 3 B channels of data. Its pictures are those of B renderings, bit for bit; with 5
# colourings, the step of PyTorch takes about two thirds of the time. A set has up to 64 channels.


def render_batch(colors):
    """Render B colourings (B, 3, N) of the set at once: (B, height, width, 3)."""
    count = len(colors)
    background = np.tile(rocket.background.numpy(), (count, 1))
    plates = replace(rocket, space="data", background=ArrayXf(background))

    @dr.wrap(source="torch", target="drjit")
    def render(rows):
        return eg.render(replace(plates, color=ArrayXf(rows)))

    channels = render(colors.reshape(3 * count, -1))
    return channels.reshape(rocket.height, rocket.width, count, 3).permute(2, 0, 1, 3)


if torch:
    colors = torch.rand(5, 3, len(rocket))
    pictures = render_batch(colors)
    first = eg.render(replace(rocket, color=ArrayXf(colors[0].numpy()))).numpy()
    difference = np.abs(pictures[0].numpy() - first).max()
    print(f"PyTorch: a picture of the batch and one alone differ by {difference:g}")
