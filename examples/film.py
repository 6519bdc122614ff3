"""
Fit a film
==========

``start=`` begins a frame from the set of the one before. Gaussians that fit the new frame stay, the
others are placed anew; after a cut, all of them.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

import eigengs_dr as eg

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
folder.mkdir(parents=True, exist_ok=True)
SIDE, FRAMES, GAUSSIANS, STEPS = 96, 6, 500, 40

# %%
# Four films of six frames: parts of two photos, with the noise of a camera.

astronaut, coffee = eg.sample("astronaut"), eg.sample("coffee")


def window(photo, x):
    """Return a part of a photo."""
    return photo[80 : 80 + SIDE, x : x + SIDE]


def with_object(x):
    """Return a photo with an object in front of it."""
    frame = window(astronaut, 60).copy()
    frame[40:70, x : x + 30] = coffee[150:180, 200:230]
    return frame


films = {
    "still": [window(astronaut, 60) for _ in range(FRAMES)],
    "an object moves": [with_object(5 + 4 * k) for k in range(FRAMES)],
    "pan, 2 pixels a frame": [window(astronaut, 60 + 2 * k) for k in range(FRAMES)],
    "cuts": [window([astronaut, coffee][k % 2], 60 + 20 * k) for k in range(FRAMES)],
}
noise = np.random.default_rng(0).normal(0, 1 / 255, (FRAMES, SIDE, SIDE, 3))

# %%
# Each frame is fitted twice: from the frame before, and alone. Flicker is the PSNR between
# neighbouring frames as they are rendered, beside that of the noisy ones. Bytes are those of packed
# files.

print(f"{'film':21}  {'PSNR':>11}  {'between neighbours':>24}  {'bytes per frame':>13}")
for name, frames in films.items():
    frames = [np.float32(np.clip(frame + n, 0, 1)) for frame, n in zip(frames, noise, strict=True)]
    alone = [eg.fit(frame, GAUSSIANS, STEPS) for frame in frames]
    film = alone[:1]
    for frame in frames[1:]:
        film.append(eg.fit(frame, start=film[-1], iterations=STEPS))
    means, flicker, sizes = [], [], []
    for fits in (film, alone):
        means.append(np.mean([one.psnr_rgb for one in fits[1:]]))
        flicker.append(np.mean([eg.psnr(a.image, b.image) for a, b in pairwise(fits)]))
        sizes.append(eg.pack(fits[-1], folder / "frame.egs").bytes)
    seen = np.mean([eg.psnr(a, b) for a, b in pairwise(frames)])
    print(
        f"{name:21}  {means[0]:.1f} ({means[1]:.1f})"
        f"  {flicker[0]:.1f} ({flicker[1]:.1f}), {seen:.1f} seen"
        f"  {sizes[0]} ({sizes[1]})"
    )
    eg.save_image(folder / f"{name.split(',')[0].replace(' ', '_')}.png", film[-1].image)
print("in brackets: frames fitted alone")
