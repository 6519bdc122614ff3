"""Fit an image: a photo becomes 3,000 Gaussians, and these a picture of any size."""

import sys
from pathlib import Path

import eigengs_dr as eg

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

# A part of a photo that is there already, 200 x 240 pixels of RGB in [0, 1]. For one of your own:
# eg.load_image("photo.jpg").
photo = eg.sample("chelsea")[20:220, 80:320]

result = eg.fit(photo, gaussians=3000, iterations=300)

# PSNR in decibels: at 40 the eye sees little difference, at 30 it does at once.
psnr = eg.psnr(photo, result.image)
print(f"{len(result.gaussians)} Gaussians, PSNR {psnr:.1f} dB, {result.seconds:.1f} s")

# The set is the picture: save it, load it, render it at the size that you need.
result.gaussians.save(folder / "cat.npz")
cat = eg.Gaussians.load(folder / "cat.npz")
large = eg.render(cat, width=4 * cat.width)

eg.save_image(folder / "cat.png", result.image)
eg.save_image(folder / "cat_4x.png", large.numpy())
print(f"wrote cat.npz, cat.png and cat_4x.png ({large.shape[1]} x {large.shape[0]}) to {folder}")
