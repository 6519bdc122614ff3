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
from numpy.typing import NDArray

from ..backend.arrays import ArrayTypes, types_of
from ..backend.entry_points import class_of_entry_points, shows_progress
from ..backend.interrupts import Interrupted
from ..backend.types import ArrayLike, Doubles, Rows
from ..codec.egs import is_packed, read_egs
from ..eigenbasis.incremental import product
from ..fitting.objective import Pixels
from ..fitting.solve import solve
from ..gaussian.file import ARRAYS, LIGHTS, SetData, check, check_suffix, members_of, packed_data
from ..gaussian.gaussians import Gaussians, notebook_html, with_colors
from ..image.color import to_linear
from ..image.io import read_floats, read_photo
from ..image.metrics import MAX_PSNR
from ..image.pixels import ImageError, codes_of, encoding_of
from ..image.read import is_picture
from ..image.resize import resample
from ..image.space import DATA, LINEAR, RGB
from ..raster.render import render
from ..storage import npz
from ..storage.npz import BadValue, Field, file_errors
from .directions import LatLong
from .fit import (
    MAX_PSNR_DROP,
    PLANES_SHARE,
    ROUNDING,
    find_planes,
    fit_fewest,
    fit_planes,
    most_planes,
    read_photos,
)
from .lights import MAX_LIGHTS, LightTable, check_lights, check_table
from .packed import check_brightest, read_table

VERSION = 1
"""Version of the format."""

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

BRIGHTEST = {"brightest": Field("f8", 0)}
"""An array that older files lack."""


@class_of_entry_points
@dataclass(frozen=True, eq=False, repr=False)
class Relightable:
    """An object under any light, from photos of one camera under some lights.

    Attributes
    ----------
    planes : Gaussians
        The planes, in the space "data": a channel for each. A light is a sum of them. Their mean
        squared errors add up to that of photos that were left out.
    table : LightTable
        The factors of the planes for every light.
    psnr_held_out : float
        Mean psnr_rgb in dB of photos that such a model has not seen, as it shows them: an estimate
        from the errors of planes of other photos and of the Gaussians, after `pack` also of its
        rounding. The peak is white, and errors of brighter light count too. NaN if unknown.
    brightest : float
        The largest code of the photos, at least 1: codes above 1 are light above white, by the same
        curve. What exceeds it is clamped in scenes and in environments.

    Notes
    -----
    A direction is a vector towards the light: x to the right of the photo, y up, z towards the
    camera. Lights are far, as the table knows no distance. Between lights, cast shadows fade
    instead of moving. Lights below the horizon are refused. A fit holds all photos in memory, 12
    bytes for each of their pixels.
    """

    planes: Gaussians
    table: LightTable
    psnr_held_out: float = float("nan")
    brightest: float = 1.0

    _repr_html_ = notebook_html  # what a notebook shows

    @classmethod
    @shows_progress
    def fit(
        cls,
        photos: Any,
        lights: ArrayLike | str | os.PathLike[str] | None = None,
        *,
        gaussians: int | None = None,
        planes: int | None = None,
        max_psnr_drop: float | None = None,
        iterations: int = 300,
        seed: int = 0,
        encoding: str | None = None,
        backend: str | None = None,
        progress: Any = None,
    ) -> Relightable:
        """Fit a model to photos of an object under known lights.

        Parameters
        ----------
        photos : path-like, or sequence of images or paths, or array_like of shape (n, H, W, 3)
            At least 4 photos of one size from one camera. A folder holds the photos that the list
            of lights names. Files are read as stored: an EXIF orientation is ignored, with a
            warning, because lights belong to those pixels. Numbers of a list, an array or a tensor
            of Dr.Jit are linear light if they are floats, as those of `mitsuba.render`, and sRGB
            codes if they are whole; other photos are what they say. Light may be brighter than
            white.
        lights : array_like of shape (n, 3), or path-like, optional
            The direction of the light of each photo, of any length; or a list ``.lp`` of names and
            directions. By default the only such file in the folder. A list is paired with files by
            name, and with arrays in order.
        gaussians : int, optional
            Number of Gaussians. By default one for 16 pixels, halved as often as the budget allows,
            as short tries predict.
        planes : int, optional
            Number of planes. By default the smallest within the budget.
        max_psnr_drop : float, optional
            The budget: decibels of left-out lights that a model may lose, by default 0.3. A quarter
            may go to fewer planes than are best, and the rest to fewer Gaussians.
        iterations : int, optional
            Number of steps of the fit of the planes.
        encoding : {"srgb", "linear"}, optional
            What the numbers of all photos are, instead: "srgb" for arrays of
            `eigengs_dr.load_image`, "linear" for developed files of integers.
        seed, backend, progress : optional
            See `eigengs_dr.fit`.

        Raises
        ------
        ValueError
            If photos and lights do not match, a light is below the horizon, all lights are one, the
            photos take more memory than there is, or an option is out of range; an `ImageError` if
            a photo cannot be used.
        OSError
            If a file cannot be opened.
        Interrupted
            At Ctrl-C or SIGTERM during the fit of the planes; its ``result`` is the model of the
            best set so far.
        """
        if max_psnr_drop is not None and gaussians is not None and planes is not None:
            raise ValueError("max_psnr_drop finds numbers; leave out gaussians, planes or it")
        budget = MAX_PSNR_DROP if max_psnr_drop is None else max_psnr_drop
        if not 0 < budget <= MAX_PSNR:
            raise ValueError(
                f"max_psnr_drop is {budget:g}; it must be above 0 and at most {MAX_PSNR:g} dB, "
                f"such as {MAX_PSNR_DROP}"
            )
        read = read_photos(photos, lights, encoding)
        most = most_planes(len(read.lights))
        if planes is not None and not 1 <= planes <= most:
            raise ValueError(f"planes is {planes}; {len(read.lights)} photos have 1 to {most}")
        brightest = max(1.0, float(read.rows.max()))
        found = find_planes(read, planes, PLANES_SHARE * budget).for_left_out()
        del read  # the photos take more memory than the fit
        options = iterations, seed, backend, progress
        if gaussians is None:
            result = fit_fewest(found, (1 - PLANES_SHARE) * budget, *options)
        else:
            result = fit_planes(found.images, gaussians, *options)
        shown = result.image.reshape(found.images.shape)
        model = cls(result.gaussians, found.table, found.psnr_held_out(shown), brightest)
        if result.stopped == "interrupted":
            raise Interrupted(model, "the fit was interrupted; .result holds the model so far")
        return model

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
        """Return the object under a light, or under an environment, as a set.

        Parameters
        ----------
        light : sequence of 3 numbers, Dr.Jit vector of 3 floats, image (h, w, 3) or path-like
            The direction of the light, of any length. The set is differentiable by the vector. Or
            an environment of light around the object, see `environment_lights`; then colours are
            solved for the shapes, without a derivative.

        Returns
        -------
        Gaussians
            On the means and shapes of the planes; in the space "rgb", and for an environment in
            "linear", or "radiance" if it is brighter than white. In "rgb", light above white has
            codes above 1: renderings and files of floats keep it, a display and a
            ``gaussian_texture`` clamp it.

        Raises
        ------
        ValueError
            If numbers are no direction above the horizon, or an environment has another shape, or
            light below 0. A vector of Dr.Jit may be below the horizon, as an optimiser may leave it
            there for a step. Where it must be computed first, as in a frozen function, one that is
            no direction stands for the light of the camera, (0, 0, 1).
        TypeError
            If it is neither a direction nor an environment.
        """
        planes, types = self.planes, types_of(self.planes.mean)
        if dr.is_array_v(light):
            if dr.is_tensor_v(light) and light.ndim > 1:
                return self._under(_numbers_of(light.numpy()))
            direction = _vector_of(light, types)
        elif isinstance(light, (str, os.PathLike)) or _numbers_of(light).ndim > 1:
            return self._under(light)
        else:
            [numbers] = check_lights(_numbers_of(light)[None], "light").tolist()
            direction = [dr.opaque(types.Float, v) for v in numbers]
        factors = self.table.factors(types, direction)

        def shown(rows: Rows, added: bool) -> Rows:
            return type(rows)(
                [
                    sum((f * row for f, row in zip(fs, rows, strict=False)), fs[-1] * added)
                    for fs in factors
                ]
            )

        color, background = shown(planes.color, False), shown(planes.background, True)
        return replace(planes, color=color, background=background, space=RGB)

    def _under(self, environment: object) -> Gaussians:
        """Return the object under an environment: a sum of light over directions."""
        lights, radiance = environment_lights(environment)
        shown = render(self.planes).numpy().astype(np.float32)
        total = np.zeros((*shown.shape[:2], 3), np.float32)
        for factors, light in zip(self.table.at(lights).astype(np.float32), radiance, strict=True):
            if light.any():
                codes = shown @ factors[:, :-1].T + factors[:, -1]
                total += to_linear(np.clip(codes, 0, self.brightest)) * light.astype(np.float32)
        space = LINEAR.above_white if total.max() > 1 else LINEAR
        start = with_colors(self.planes, np.zeros((len(self.planes) + 1, 3)), space)
        return solve(start, Pixels.plain(total, start, space.weight(total)))

    def find_light(self, photo: Any, *, encoding: str | None = None) -> tuple[Doubles, float]:
        """Find the light of a photo of the object, from the same camera with the same exposure.

        Directions above the horizon are compared, by how well the photos of the model tell each
        other: planes that are badly interpolated between lights count less.

        Parameters
        ----------
        photo, encoding
            As the photos of `fit`, and of their size.

        Returns
        -------
        light : ndarray of float64, shape (3,)
            The mean of the directions that the photo may have been lit from; a unit vector.
        angle : float
            Its uncertainty: the root mean square angle between these directions and their mean, in
            degrees. Large where photos differ little, as those of a flat object may.

        Raises
        ------
        ValueError
            If the photo cannot be used, or is of another size than those of the model.
        OSError
            If a file cannot be opened.
        """
        width, height = self.planes.width, self.planes.height
        pixels = codes_of(read_photo(photo, encoding, upright=False))
        if pixels.shape[:2] != (height, width):
            raise ImageError(
                f"photo: is {pixels.shape[1]}x{pixels.shape[0]}, but those of the model are "
                f"{width}x{height}; scale it to that size"
            )
        colors = pixels.reshape(-1, 3).T
        images = render(self.planes).numpy().astype(np.float32).reshape(colors.shape[1], -1).T
        images = np.vstack([images, np.ones((1, colors.shape[1]), np.float32)])
        moments = product(images, images) / images.shape[1]
        moments += UNSEEN * np.trace(moments) * np.eye(len(moments))
        inverse = np.linalg.inv(moments)
        shown = inverse @ product(images, colors) / images.shape[1]
        return self.table.find(shown.T, ROUNDING * inverse)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.npz`` file atomically; if that raises OSError, an old file is unchanged."""
        check_suffix(path)
        table = self.table
        arrays = members_of(self.planes.data()) | {
            "lights": table.lights.astype(np.float32),
            "values": table.values.astype(np.float32),
            "kind": np.array(table.kind),
            "smoothing": np.array(table.smoothing, np.float64),
            "psnr_held_out": np.array(self.psnr_held_out, np.float64),
            "brightest": np.array(self.brightest, np.float64),
        }
        npz.write(path, LIGHTS, VERSION, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], backend: str | None = None) -> Relightable:
        """Read a file that `save` or `eigengs_dr.pack` wrote.

        Raises
        ------
        ValueError
            If the file has another format or version, is damaged, or holds invalid values; one line
            names the file and the key.
        OSError
            If the file cannot be opened.
        """
        with file_errors(Path(path)):
            if is_packed(path):
                content = read_egs(path)
                if not content.lights:
                    raise BadValue("holds a set without a table of lights; Gaussians.load reads it")
                data = check(packed_data(content))
                table, *figures = read_table(content.lights, len(content.background))
            else:
                layout = LAYOUT | (BRIGHTEST if "brightest" in npz.sizes_of(path) else {})
                members = npz.read(path, LIGHTS, VERSION, layout)
                parts = {name: members[name] for name in ARRAYS}
                size = tuple(members["size"].tolist())
                data = check(SetData(parts, size, DATA, float(members["cutoff"])))
                lights, values = (members[name].astype(np.float64) for name in ("lights", "values"))
                kind, smoothing = str(members["kind"]), float(members["smoothing"])
                table = LightTable(lights, values, kind, smoothing)
                table = check_table(table, data.arrays["color"].shape[1])
                figures = [float(members.get(name, 1)) for name in ("psnr_held_out", "brightest")]
                check_brightest(figures[1])
        return cls(Gaussians.from_data(data, backend), table, *figures)


GIVE = "give one direction, three numbers as lights[0], or an environment: an image (h, w, 3)"


def _numbers_of(light: Any) -> NDArray[Any]:
    """Return a direction, or the pixels of an environment, as an array of real numbers."""
    try:
        array = np.asarray(light)
    except (ValueError, RuntimeError):  # rows of unequal length
        array = np.array(None)
    if array.ndim == 0 or array.dtype.kind not in "biuf":
        raise TypeError(f"light is of type {type(light).__name__}; {GIVE} or its path")
    if array.ndim != 3 and array.shape != (3,):
        raise ValueError(f"light has shape {array.shape}; {GIVE} or its path")
    return array


def _vector_of(light: Any, types: ArrayTypes) -> list[Any]:
    """Return the components of a vector of Dr.Jit; `ValueError` if they are known to be none."""
    shape = dr.shape(light)
    if shape not in ((3,), (3, 1)):
        raise ValueError(f"light has shape {shape}; {GIVE}")
    if len(shape) == 1:  # a tensor, or a flat array
        flat = light.array if dr.is_tensor_v(light) else light
        light = dr.unravel(types.Float3, types.Float(flat))
    vector = types.Float3([types.Float(v) for v in light])
    recorded = dr.flag(dr.JitFlag.SymbolicScope) or dr.flag(dr.JitFlag.FreezingScope)
    without_program = (dr.VarState.Literal, dr.VarState.Evaluated)
    if not recorded and all(v.state in without_program for v in vector):
        numbers = [dr.detach(v)[0] for v in vector]
        if not (np.isfinite(numbers).all() and any(numbers)):
            raise ValueError(f"light is {numbers}, which is no direction")
    return list(or_camera(vector))


def or_camera(light: Any) -> Any:
    """Return a light that an optimiser may have spoilt, or the light of the camera."""
    length = dr.squared_norm(light)
    return dr.select(dr.isfinite(length) & (length > 0), light, type(light)(0, 0, 1))


UNSEEN = 1e-7
"""Added to the moments of planes, times their trace: what no Gaussian shows tells no light."""

ENVIRONMENT_SIZE = (32, 16)
"""Width and height to which environments are averaged: 256 directions above the horizon."""


def environment_lights(environment: object) -> tuple[Doubles, Doubles]:
    """Return directions (m, 3) above the horizon, and what each adds of its photo, (m, 3).

    The photo under a light of irradiance pi counts as 1, so that a white diffuse surface is white
    under an environment of 1: the sum is ``1 / pi integral L(l) photo(l) dl``.

    Parameters
    ----------
    environment : array_like, shape (h, w, 3), or path-like
        Latitudes and longitudes, as an ``envmap`` of Mitsuba: the first row is up (y), and the
        middle column is behind the camera (z). Arrays hold linear light; files, bitmaps of Mitsuba
        and pictures know their encoding.
    """
    told = isinstance(environment, (str, os.PathLike)) or is_picture(environment)
    encoding = None if told else encoding_of(environment) or "linear"
    pixels, encoding, _ = read_floats(environment, encoding=encoding)
    light = to_linear(pixels) if encoding == "srgb" else pixels
    if light.min() < 0:
        raise ValueError(
            f"environment: light is {light.min():g} somewhere; it must be at least 0, as after "
            "numpy.maximum(sky, 0)"
        )
    width, height = ENVIRONMENT_SIZE
    if len(light) > 1:  # the outermost rows have half the height of the others
        light = np.repeat(resample(light, width, len(light)), 2, axis=0)[1:-1]
    average = np.maximum(resample(light, width, height), 0).astype(np.float64)
    directions, areas = LatLong(width, height).directions(), LatLong(width, height).areas()
    above = directions[..., 2] > 0
    return directions[above], (average * areas[:, None, None] / np.pi)[above]
