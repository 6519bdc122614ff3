"""Other arrays: mirror a set of Gaussians in NumPy, and colour it with PyTorch."""

import sys
from dataclasses import replace
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Dr.Jit: it names a libLLVM that works)
import drjit as dr
import numpy as np
from drjit.auto.ad import ArrayXf, TensorXf

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

photo = eg.sample("rocket")[40:232, 200:392]
rocket = eg.fit(photo, gaussians=1500, iterations=100, color="rgb").gaussians

# --- NumPy ---------------------------------------------------------------------------------------

# The set as plain arrays, one row a Gaussian: mean (N, 2), factor (N, 3), color (N, 3), and the
# background (3,). A mirror turns x around, and with it the shear b of the factor a, b, c.
arrays = rocket.to_arrays()
arrays["mean"][:, 0] = rocket.width - arrays["mean"][:, 0]
arrays["factor"][:, 1] *= -1
mirrored = eg.Gaussians.from_arrays(**arrays, size=(rocket.width, rocket.height), space="rgb")

# A rendering is a tensor of Dr.Jit: `numpy()` gives its pixels.
pixels = eg.render(rocket).numpy()
pixels_mirrored = eg.render(mirrored).numpy()
eg.save_image(folder / "rocket.png", pixels)
eg.save_image(folder / "rocket_mirrored.png", pixels_mirrored)
difference = np.abs(pixels[:, ::-1] - pixels_mirrored).max()
print(f"NumPy: the mirrored set and mirrored pixels differ by {difference:.4f} at most")

# --- PyTorch -------------------------------------------------------------------------------------

try:
    import torch
except ImportError:
    print("PyTorch: skipped, as it is not installed (pip install torch)")
    sys.exit()


@dr.wrap(source="torch", target="drjit")
def render(color):
    """Render with other colours: a tensor (N, 3) comes in, one (height, width, 3) goes out.

    To the caller both are PyTorch's, and derivatives find their way through. A set has one row a
    channel, not one a Gaussian.
    """
    return eg.render(replace(rocket, color=ArrayXf(color.T)))


# Take the colours away, and let an optimiser of PyTorch find them again.
device = "cuda" if dr.backend_v(rocket.color) == dr.JitBackend.CUDA else "cpu"
target = torch.tensor(photo, device=device)
color = torch.zeros(len(rocket), 3, device=device, requires_grad=True)
optimizer = torch.optim.Adam([color], lr=0.05)

losses = []
for _ in range(40):
    optimizer.zero_grad()
    loss = (render(color) - target).square().mean()
    loss.backward()
    losses.append(loss.item())
    if len(losses) == 1:
        first_gradient = color.grad.cpu().numpy().copy()
    optimizer.step()
eg.save_image(folder / "rocket_torch.png", render(color).detach().cpu())
print(f"PyTorch: the loss went from {losses[0]:.1e} to {losses[-1]:.1e} in {len(losses)} steps")

# The same derivatives without PyTorch.
black = ArrayXf(np.zeros((3, len(rocket)), np.float32))
dr.enable_grad(black)
dr.backward(dr.mean(dr.square(eg.render(replace(rocket, color=black)) - TensorXf(photo))))
difference = np.abs(dr.grad(black).numpy().T - first_gradient).max() / np.abs(first_gradient).max()
print(f"PyTorch: its first gradient differs from Dr.Jit's by {difference:.0e} of the largest entry")
