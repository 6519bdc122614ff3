"""A model of lights whose photos a formula gives, and the formula."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import eigengs_dr as eg
from _helpers.light import to_linear as to_light
from _helpers.lit_spheres import directions, photos

__all__ = ["CHANNELS", "PLANES", "SIZE", "LitFormula", "spiral", "to_light"]

SIZE, PLANES, CHANNELS = (24, 16), 2, 3


def spiral(count=40):
    """Directions over the upper hemisphere, down to the horizon."""
    z = np.clip(1 - (np.arange(count) + 0.5) / count, 0, 1)
    turn, ring = np.arange(count) * (np.pi * (3 - 5**0.5)), np.sqrt(1 - z * z)
    return np.c_[ring * np.cos(turn), ring * np.sin(turn), z]


@cache
def any_model():
    """A model of a few photos, whose file lends its members."""
    lights = directions(8)
    return eg.Relightable.fit(photos(lights), lights, gaussians=8, iterations=0, progress=False)


def changed(model, **members):
    """The model of the file of another one with other members."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "m.npz"
        model.save(path)
        with np.load(path) as file:
            members = dict(file) | members
        np.savez(path, **members)
        return eg.Relightable.load(path)


class LitFormula:
    """Codes ``sum_k t_ck(l) P_k(u, v) + t_cK(l)``, t linear in l: what a thin plate holds exactly.

    Without a scale, no code leaves [0, 1].
    """

    def __init__(self, scale=1.0, seed=4):
        r = np.random.default_rng(seed)
        (w, h), n = SIZE, 30
        shape = np.c_[r.uniform(0.15, 0.3, n), r.uniform(-0.05, 0.05, n), r.uniform(0.15, 0.3, n)]
        mean, color = r.uniform([0, 0], [w, h], (n, 2)), r.uniform(-0.08, 0.08, (n, PLANES))
        self.planes = eg.Gaussians.from_arrays(
            mean, shape, color, np.full(PLANES, 0.2), size=SIZE, space="data"
        )
        self.base = r.uniform(-0.5, 0.5, (CHANNELS, PLANES + 1))
        self.slope = r.uniform(-0.12, 0.12, (CHANNELS, PLANES + 1, 3))
        self.base[:, -1], self.slope[:, -1] = 0.5, r.uniform(-0.08, 0.08, (CHANNELS, 3))
        self.base, self.slope = scale * self.base, scale * self.slope

    def model(self, brightest=1.0, kind="thin_plate", smoothing=1e-9):
        """The model that shows these photos."""
        lights = spiral()
        values = self.base + np.einsum("ckd,nd->nck", self.slope, lights)
        table = {"lights": np.float32(lights), "values": np.float32(values)}
        table |= {"kind": np.array(kind), "smoothing": np.array(smoothing)}
        given = self.planes.to_arrays() | {"size": np.array(SIZE)}
        table |= {"brightest": np.array(float(brightest)), "psnr_held_out": np.array(30.0)}
        return changed(any_model(), **given, **table)

    def codes(self, lights, uv):
        """Codes (n, 3) under lights (n, 3) of length 1 at places (n, 2) of the photo."""
        arrays = self.planes.to_arrays()
        x = uv[:, None] * SIZE - arrays["mean"]
        a, b, c = arrays["factor"].T
        square = (a * x[..., 0] + b * x[..., 1]) ** 2 + (c * x[..., 1]) ** 2
        near = np.where(square < self.planes.cutoff**2, np.exp(-0.5 * square), 0)
        planes = np.c_[near @ arrays["color"] + arrays["background"], np.ones(len(uv))]
        factors = self.base + np.einsum("ckd,nd->nck", self.slope, lights)
        return np.einsum("nck,nk->nc", factors, planes)
