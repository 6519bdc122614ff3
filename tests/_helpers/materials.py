"""Small materials."""

import numpy as np

import eigengs_dr as eg

MAPS = (
    ("albedo", "linear", 3, 0.5),
    ("roughness", "data", 1, 2.0),
    ("normal", "normal", 3, 1.0),
)


def material(count=24, size=(22, 17), maps=MAPS, backend=None, seed=0):
    """Round Gaussians with channels near the middle of their range."""
    random = np.random.default_rng(seed)
    channels = sum(m[2] for m in maps)
    factor = np.zeros((count, 3))
    factor[:, [0, 2]] = random.uniform(0.2, 0.5, (count, 2))
    return eg.Gaussians.from_arrays(
        random.uniform(0, 1, (count, 2)) * size,
        factor,
        random.uniform(-0.1, 0.1, (count, channels)),
        random.uniform(0.4, 0.6, channels),
        size=size,
        space="data",
        backend=backend,
        maps=maps,
    )


def images(side=32):
    """Three maps of waves with one structure: colours, roughness and normals, in [0, 1]."""
    y, x = np.mgrid[:side, :side] / side
    wave = 0.5 + 0.3 * np.sin(11 * x + 4 * y) * np.cos(7 * y)
    dy, dx = np.gradient(8 * wave)
    n = np.stack([-dx, -dy, np.ones_like(x)], axis=2)
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    found = {
        "albedo": np.stack([wave, 0.8 * wave, 0.3 + 0.2 * y], axis=2),
        "roughness": (0.9 - 0.7 * wave)[..., None],
        "normal": 0.5 + 0.5 * n,
    }
    # Whole codes of 8 bits: between two of them, rounding would decide psnr_rgb.
    return {name: np.float32(np.rint(255 * image) / 255) for name, image in found.items()}
