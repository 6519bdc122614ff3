"""The Mitsuba emitter ``gaussian_environment``: light from all directions as a sum of 2D Gaussians.

Directions are those of an ``envmap``: the picture is in equirectangular projection, its columns
repeat, and its first and last row lie on the poles.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.backend.arrays import rcp
from eigengs_dr.backend.recording import collector_off, guest
from eigengs_dr.backend.types import Float, Mask
from eigengs_dr.raster.lookup.points import axes_of, fold
from eigengs_dr.relight.directions import LatLong

from . import properties
from .color import luminance, unpolarized, upsample
from .cone import PIXEL, no_metric
from .emission import Spacing, emission_of, make_survey
from .sums import plugin_of_sums, resident_bytes

FAR = 1e8
"""Distance that stands for infinity where the bounds of the scene are unknown."""

ROUNDING = 1e-4
"""Relative margin of the bounds of a scene, and smallest radius of the bounds."""

WRAP = "sphere"

SMOOTH = 2.0
"""Standard deviation of a Gaussian, in cells of the density, in which light is nearly constant."""


def gaussian_environment() -> type:
    """Return the class of the emitter, a `mitsuba.Emitter` of the current variant."""

    class GaussianEnvironment(plugin_of_sums(mi.Emitter)):  # type: ignore[misc]
        """Light from all directions, as a sum of Gaussians in equirectangular projection.

        The Gaussians come from `filename`, from `model`, or from the arrays of a set, as
        `eigengs_dr.plugins.environment_of` writes them. Light below 0 is 0.

        Parameters
        ----------
        filename : string
            An ``.npz`` or ``.egs`` file, relative to the scene. Plugins of one file share its
            memory until a parameter changes.
        map : string
            Name of a map of `filename`.
        first : integer, default: all
            Number of Gaussians of `filename`, for sets with levels.
        model : string
            A model that ``eigengs-dr train`` writes.
        coefficients : tensor (C, k), default: 0
            Of the `model` of a family; 0 is the mean image.
        mean : tensor (N, 2)
            x, y in pixels.
        factor : tensor (N, 3)
            a, b, c in 1 / pixels.
        color : tensor (N, C)
            In the space of the set; C is 1 or 3.
        background : tensor (C,)
            Value without Gaussians; also as (1, C).
        width, height : integer
            Native size in pixels, with `mean`.
        space : string
            Space of `color`, with `mean`; only ``radiance`` and ``log`` exceed 1.
        to_world : transform, default: identity
            Rotates the light, whose zenith is the y axis before.
        scale : float, default: 1
            Factor of the light.
        prefilter : float or boolean, default: 0
            Angle of a pixel in radians, below 1 (`pixel_angle`), over which lookups average; 0
            looks at points; ``true`` takes that of the sensor of `follow`.
        cutoff : float, default: that of the set
            Standard deviations after which a Gaussian ends, above 0 and at most 12.
        memory : string, default: normal, of arrays exact
            ``normal``: a Gaussian takes 16 bytes until a parameter changes; ``small``: also lists
            of larger cells; ``exact``: floats.
        """

        transform_name = "to_world"
        others = frozenset({"to_world", "scale", "sampling_weight", "prefilter"})

        @guest()  # a thread of Mitsuba, whose caller may hold the lock
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying
            self.read(props, WRAP, False)
            properties.check_light(self.source.start, self.plugin)
            self.sphere = LatLong(self.width, self.height, pole_to_pole=True)
            self.to_world = self.world_transform()
            self.scale = dr.opaque(mi.Float, properties.light_scale(props))
            properties.check_known(props)
            self.daylight: Any = mi.load_dict({"type": "d65"}) if mi.is_spectral else None
            self.bounds: tuple | None = None
            self.parameters_changed([])

        def traverse(self, callback: mi.TraversalCallback) -> None:
            mi.Emitter.traverse(self, callback)
            callback.put("scale", self.scale, mi.ParamFlags.Differentiable)
            super().traverse(callback)

        def parameters_changed(self, keys: list[str]) -> None:
            super().parameters_changed(keys)
            mi.Emitter.parameters_changed(self, keys)
            if "scale" in keys:
                properties.check_scale(self.scale, self.plugin)
            if not keys or "to_world" in keys:
                properties.check_rotation(self.to_world)
                dr.make_opaque(self.to_world)
            if not keys or set(keys) - self.others:
                # Logarithms are sharper than the Gaussians that sum to them.
                largest = math.inf if self.space.affine else 1.0
                survey = make_survey(self, Spacing(1.0, largest, SMOOTH))
                self.importance = emission_of(survey, over_sphere=True)

        def set_scene(self, scene: mi.Scene) -> None:
            """Take the bounds of a scene.

            Mitsuba 3.9 does not call this method of a plugin in Python. Without it, rays from the
            light are NaN, and integrators that start at the light do not show it behind the scene.
            """
            box, center, radius = scene.bbox(), [0.0, 0.0, 0.0], 0.0
            if box.valid():
                sphere = box.bounding_sphere()
                center, radius = list(sphere.center), sphere.radius
            radius = max(radius * (1 + ROUNDING), ROUNDING)
            self.bounds = dr.opaque(mi.Point3f, center), dr.opaque(mi.Float, radius)

        # --- Lookups -----------------------------------------------------------------------------

        # For why the collector is off, see `eigengs_dr.plugins.gaussian_texture`.

        @collector_off()
        def eval(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> mi.Spectrum:
            return unpolarized(self._light(self._uv(-si.wi), si.wavelengths, active))

        @collector_off()
        def eval_direction(
            self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Mask = True
        ) -> mi.Spectrum:
            return unpolarized(self._light(self._uv(ds.d), it.wavelengths, active))

        def _uv(self, d: mi.Vector3f) -> mi.Point2f:
            """Return the point of the picture that lies in a direction of the world."""
            return mi.Point2f(*self.sphere.uv(*dr.normalize(self.to_world.inverse() @ d)))

        def _direction(self, uv: mi.Point2f) -> tuple[mi.Vector3f, Float]:
            """Return the direction of a point of the picture, and the density of uv over it."""
            d, sine = self.sphere.direction(uv.x, uv.y)
            area = self.sphere.area(dr.maximum(sine, dr.epsilon(mi.Float)))
            return self.to_world @ mi.Vector3f(*d), rcp(area)

        def point(self, uv: mi.Point2f) -> tuple:
            """Return x and y in pixels with the slopes 1; whether uv is finite."""
            one, (wrap_x, wrap_y) = mi.Float(1), axes_of(WRAP)
            x, _ = fold(uv.x * self.width, self.width, wrap_x)
            y, _ = fold(self.sphere.row(uv.y), self.height, wrap_y)
            return (x, one), (y, one), dr.isfinite(uv.x) & dr.isfinite(uv.y)

        def spans(self) -> NDArray[np.float64]:
            """Return the columns and rows of texels that the unit square of uv spans."""
            return np.array([self.width, self.sphere.rows], np.float64)

        def _footprint(self, uv: mi.Point2f) -> tuple | None:
            """Return the metric of a round footprint, in widths and heights of the picture."""
            if not self.filtered():
                return None
            angle = self.pixel()
            if angle is None:
                return no_metric(self.label())
            sharp = rcp(PIXEL * angle)
            along = 2 * dr.pi * dr.sin(uv.y * dr.pi) * sharp
            down = (dr.pi * self.height / self.sphere.rows) * sharp
            return [along * along, mi.Float(0), down * down], mi.Bool(True)

        def _light(
            self, uv: mi.Point2f, wavelengths: object, active: Mask, white: bool = True
        ) -> mi.UnpolarizedSpectrum:
            """Return the light from a point of the picture; spectra times D65 if `white`."""
            column, row, inside = self.point(uv)
            where = inside & active
            sums = self.sums_at(column, row, where, self._footprint(uv))
            color = [dr.select(where, self.scale * c, 0) for c in self.display(sums)]
            if mi.is_monochromatic:
                return mi.UnpolarizedSpectrum(luminance(color))
            rgb = mi.Color3f(*color)
            if not mi.is_spectral:
                return mi.UnpolarizedSpectrum(rgb)
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.wavelengths = wavelengths
            spectrum = upsample(rgb, wavelengths, self.spectra)
            return spectrum * self.daylight.eval(si) if white else spectrum

        # --- Sampling ----------------------------------------------------------------------------

        @collector_off()
        def sample_direction(
            self, it: mi.Interaction3f, sample: mi.Point2f, active: Mask = True
        ) -> tuple:
            uv, density = self.importance.sample(sample, active)
            d, jacobian = self._direction(uv)
            ds, far = dr.zeros(mi.DirectionSample3f), mi.Float(FAR)
            if self.bounds:  # sensors see nothing beyond their far clip plane
                center, radius = self.bounds
                far = 2 * dr.maximum(radius, dr.norm(it.p - center))
            ds.p, ds.n, ds.uv, ds.time = dr.fma(d, far, it.p), -d, uv, it.time
            ds.pdf = dr.select(active, density * jacobian, 0)
            ds.delta, ds.emitter, ds.d, ds.dist = False, mi.EmitterPtr(self), d, far
            active = active & (ds.pdf > 0)
            light = self._light(uv, it.wavelengths, active)
            return ds, unpolarized(light * dr.select(active, 1 / ds.pdf, 0))

        @collector_off()
        def pdf_direction(
            self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Mask = True
        ) -> Float:
            uv = self._uv(ds.d)
            _, jacobian = self._direction(uv)
            return dr.select(active, self.importance.density(uv, active) * jacobian, 0)

        @collector_off()
        def sample_ray(
            self,
            time: Float,
            sample1: Float,
            sample2: mi.Point2f,
            sample3: mi.Point2f,
            active: Mask = True,
        ) -> tuple:
            # Not known without `set_scene`. No error: programs record the emitters of all scenes.
            center, radius = self.bounds or (mi.Point3f(math.nan), mi.Float(math.nan))
            uv, density = self.importance.sample(sample3, active)
            d, jacobian = self._direction(uv)
            pdf = density * jacobian
            disk = mi.warp.square_to_uniform_disk_concentric(sample2)
            beside = mi.Frame3f(-d).to_world(mi.Vector3f(disk.x, disk.y, 0))
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.time, si.p, si.uv = time, center + (beside + d) * radius, uv
            wavelengths, weight = self.sample_wavelengths(si, sample1, active)
            weight = weight * (dr.pi * dr.square(radius) / pdf)
            return mi.Ray3f(si.p, -d, time, wavelengths), weight & active & (pdf > 0)

        @collector_off()
        def sample_wavelengths(
            self, si: mi.SurfaceInteraction3f, sample: Float, active: Mask = True
        ) -> tuple:
            if not mi.is_spectral:
                return mi.Color0f(), unpolarized(self._light(si.uv, si.wavelengths, active))
            count = dr.size_v(mi.UnpolarizedSpectrum)
            shifted = [sample + k / count for k in range(count)]
            shifted = type(si.wavelengths)([dr.select(s >= 1, s - 1, s) for s in shifted])
            wavelengths, weight = self.daylight.sample_spectrum(si, shifted, active)
            light = self._light(si.uv, wavelengths, active, white=False)
            return wavelengths, unpolarized(light * weight)

        def sample_position(self, time: Float, sample: mi.Point2f, active: Mask = True) -> tuple:
            return dr.zeros(mi.PositionSample3f), mi.Float(math.nan)  # as an envmap: it has none

        def pdf_position(self, ps: mi.PositionSample3f, active: Mask = True) -> Float:
            return mi.Float(math.nan)

        def bbox(self) -> mi.ScalarBoundingBox3f:
            return mi.ScalarBoundingBox3f()  # nowhere in particular

        # --- Description -------------------------------------------------------------------------

        def to_string(self) -> str:
            transform = str(self.to_world).replace("\n", "\n  ")
            return (
                f'GaussianEnvironment[\n  name = "{self.file}",\n'
                f"  gaussians = {self.source.count},\n"
                f"  resolution = [{self.width}, {self.height}],\n"
                f"  space = {self.space},\n  scale = {float(self.scale[0]):g},\n"
                f"  prefilter = {self.prefilter_name()},\n  cutoff = {self.cutoff:g},\n"
                f"  memory = {self.memory.name},\n"
                f"  resident_bytes = {resident_bytes(self)},\n"
                f"  to_world = {transform}\n]"
            )

    return GaussianEnvironment
