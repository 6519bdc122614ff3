"""`Relightable`: photos under many lights as planes on one set of Gaussians, and a table of lights.

As in `eigengs_dr.EigenGS`, a new member of the family is a product: the colours under a light are
``sum_k t_k(l) psi_nk`` with the colours psi of the planes and the factors t of the light.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from ..backend.arrays import types_of
from ..backend.doors import class_of_doors, shows_progress
from ..backend.types import ArrayLike, Doubles
from ..gaussian.file import ARRAYS, SetData, check, file_errors
from ..gaussian.gaussians import Gaussians
from ..image.space import DATA, RGB
from ..storage import npz
from ..storage.npz import Field
from .fit import find_planes, fit_planes, read_photos
from .lights import MAX_LIGHTS, LightTable, check_lights, check_table

FORMAT, VERSION = "eigengs_dr.relightable", 1

LAYOUT: dict[str, Field] = ARRAYS | {
    "size": Field("i8", 1),
    "cutoff": Field("f8", 0),
    "lights": Field("f4", 2, 3 * MAX_LIGHTS),
    "values": Field("f4", 3),
    "kind": Field("U", 0),
    "smoothing": Field("f8", 0),
    "psnr_held_out": Field("f8", 0),
}
"""Arrays of a file."""


@class_of_doors
@dataclass(frozen=True, eq=False, repr=False)
class Relightable:
    """An object under any light, from photos of one camera under some lights.

    Attributes
    ----------
    planes : Gaussians
        The planes, in the space "data": a channel for each. A light is a sum of them.
    table : LightTable
        The factors of the planes for every light.
    psnr_held_out : float
        Mean PSNR in dB, in sRGB, of photos that were left out: from planes of the others, before
        they become Gaussians.

    Notes
    -----
    A direction is a vector towards the light: x to the right of the photo, y up, z towards the
    camera. Lights are far, as the table knows no distance. Between lights, cast shadows fade
    instead of moving. Lights below the horizon are refused.
    """

    planes: Gaussians
    table: LightTable
    psnr_held_out: float = float("nan")

    @classmethod
    @shows_progress
    def fit(
        cls,
        photos: Any,
        lights: ArrayLike | str | os.PathLike[str] | None = None,
        *,
        gaussians: int | None = None,
        planes: int | None = None,
        iterations: int = 300,
        seed: int = 0,
        backend: str | None = None,
        progress: Any = None,
    ) -> Relightable:
        """Fit a model to photos of an object under known lights.

        Parameters
        ----------
        photos : path-like, or sequence of images or paths, or array_like of shape (n, H, W, 3)
            At least 4 photos of one size from one camera. A folder holds the photos that the list
            of lights names.
        lights : array_like of shape (n, 3), or path-like, optional
            The direction of the light of each photo, of any length; or a list ``.lp`` of names and
            directions. By default the only such file in the folder.
        gaussians : int, optional
            Number of Gaussians, by default one for 16 pixels.
        planes : int, optional
            Number of planes. By default as many as left-out lights need.
        iterations : int, optional
            Number of steps of the fit of the planes.
        seed, backend, progress : optional
            See `eigengs_dr.fit`.

        Raises
        ------
        ValueError
            If photos and lights do not match, a light is below the horizon, or an option is out of
            range; an `ImageError` if a photo cannot be used.
        OSError
            If a file cannot be opened.
        """
        read = read_photos(photos, lights)
        if planes is not None and not 1 <= planes <= min(64, len(read.rows)):
            raise ValueError(f"planes is {planes}; {len(read.lights)} photos have 1 to 64")
        found = find_planes(read, planes)
        del read  # the photos take more memory than the fit
        result = fit_planes(found.images, gaussians, iterations, seed, backend, progress)
        return cls(result.gaussians, found.table, found.psnr_held_out)

    def __repr__(self) -> str:
        size = f"{self.planes.width}x{self.planes.height} pixels"
        return (
            f"Relightable({len(self.planes)} Gaussians, {size}, {self.planes.channels} planes, "
            f"{len(self.lights)} lights, {self.table.kind})"
        )

    @property
    def lights(self) -> Doubles:
        """Directions of the lights of the photos, shape (n, 3)."""
        return self.table.lights

    def relight(self, light: Any) -> Gaussians:
        """Return the object under a light, as a set in the space "rgb".

        Parameters
        ----------
        light : sequence of 3 numbers, or Dr.Jit vector of 3 floats
            The direction of the light, of any length. The set is differentiable by the vector.

        Returns
        -------
        Gaussians
            On the means and shapes of the planes.

        Raises
        ------
        ValueError
            If numbers are no direction above the horizon. A vector of Dr.Jit is not checked: an
            optimiser may pass below the horizon for a step.
        """
        planes, types = self.planes, types_of(self.planes.mean)
        if dr.is_array_v(light):
            direction = [types.Float(v) for v in light]
        else:
            [numbers] = check_lights(np.asarray(light, np.float64)[None], "light").tolist()
            direction = [dr.opaque(types.Float, v) for v in numbers]
        factors = self.table.factors(types, direction)

        def shown(rows: Any, added: bool) -> Any:
            return type(rows)(
                [
                    sum((f * row for f, row in zip(fs, rows, strict=False)), fs[-1] * added)
                    for fs in factors
                ]
            )

        color, background = shown(planes.color, False), shown(planes.background, True)
        return replace(planes, color=color, background=background, space=RGB)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.npz`` file atomically; if that raises OSError, an old file is unchanged."""
        data, table = self.planes.data(), self.table
        arrays = {name: values.astype(np.float32) for name, values in data.arrays.items()}
        arrays |= {
            "size": np.array(data.size, np.int64),
            "cutoff": np.array(data.cutoff, np.float64),
            "lights": table.lights.astype(np.float32),
            "values": table.values.astype(np.float32),
            "kind": np.array(table.kind),
            "smoothing": np.array(table.smoothing, np.float64),
            "psnr_held_out": np.array(self.psnr_held_out, np.float64),
        }
        npz.write(path, FORMAT, VERSION, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], backend: str | None = None) -> Relightable:
        """Read a file that `save` wrote.

        Raises
        ------
        ValueError
            If the file has another format or version, is damaged, or holds invalid values; one line
            names the file and the key.
        OSError
            If the file cannot be opened.
        """
        with file_errors(Path(path)):
            members = npz.read(path, FORMAT, VERSION, LAYOUT)
            parts = {name: members[name] for name in ARRAYS}
            size = tuple(members["size"].tolist())
            data = check(SetData(parts, size, DATA, float(members["cutoff"])))
            table = LightTable(
                members["lights"].astype(np.float64),
                members["values"].astype(np.float64),
                str(members["kind"]),
                float(members["smoothing"]),
            )
            check_table(table, data.arrays["color"].shape[1])
            table = replace(table, lights=check_lights(table.lights))
            return cls(Gaussians.from_data(data, backend), table, float(members["psnr_held_out"]))
