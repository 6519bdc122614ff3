"""
Fit a photo
===========

A photo becomes 3,000 Gaussians. The Gaussians become a picture of any size.
"""

import sys
from pathlib import Path

import eigengs_dr as eg

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# The photo is part of a sample that scikit-image ships: 200 rows and 240 columns of RGB in [0, 1].
# To fit a photo of your own, write ``eg.load_image("photo.jpg")``.

photo = eg.sample("chelsea")[20:220, 80:320]
result = eg.fit(photo, gaussians=3000, iterations=300)

# %%
# PSNR measures the quality in decibels. At 40 dB most people see no difference; at 30 dB they do.

psnr = eg.psnr(photo, result.image)
print(f"{len(result.gaussians)} Gaussians, PSNR {psnr:.1f} dB, {result.seconds:.1f} s")
eg.save_image(folder / "cat.png", result.image)

# %%
# The trace holds the quality at some steps of the fit.

for row in result.trace[:: len(result.trace) // 4]:
    print(f"step {row['iteration']:3}: {row['psnr_rgb']:.1f} dB")

# %%
# The set of Gaussians is the picture. Save it, load it, and render it at the size you need.

result.gaussians.save(folder / "cat.npz")
cat = eg.Gaussians.load(folder / "cat.npz")
large = eg.render(cat, width=4 * cat.width)
eg.save_image(folder / "cat_4x.png", large, encoding="srgb")
print(f"wrote cat.npz, cat.png and cat_4x.png ({large.shape[1]} x {large.shape[0]} pixels)")
