"""The texture ``gaussian_texture``: a sum of 2D Gaussians, differentiable and prefiltered."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.backend.recording import collector_off, guest
from eigengs_dr.backend.types import Bool, Float, Mask
from eigengs_dr.raster.lookup.points import fold, gradient_terms, near_image, sum_at_points

from . import properties
from .color import STEP, luminance, slope_of, upsample
from .cone import FOOTPRINT_INPUTS, metric, no_metric
from .emission import Emission, Survey, emission_of, make_survey, outside_of_recordings
from .lookup import reused
from .sums import plugin_of_sums, resident_bytes


def gaussian_texture() -> type:
    """Return the class of the texture, a `mitsuba.Texture` of the current variant."""

    class GaussianTexture(plugin_of_sums(mi.Texture)):  # type: ignore[misc]
        """A sum of Gaussians over uv, ``(u, v) = (x / width, y / height)``, row 0 at v = 0.

        The Gaussians come from `filename`, from `model`, or from the arrays of a set, as
        `eigengs_dr.plugins.texture_of` writes them.

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
        light : vector, default: (0, 0, 1)
            Of a `model` of lights: towards the light, of any length; x to the right of the photo,
            y up, z towards the camera.
        mean : tensor (N, 2)
            x, y in pixels.
        factor : tensor (N, 3)
            a, b, c in 1 / pixels.
        color : tensor (N, C)
            In the space of the set; C is 1 or 3, or 2 for x and y of normals in ``data``.
        background : tensor (C,)
            Value without Gaussians; also as (1, C).
        width, height : integer
            Native size in pixels, with `mean`.
        space : string
            Space of `color`, with `mean`.
        to_uv : transform, default: identity
            Applied to uv; invertible.
        wrap_mode : string, default: repeat
            Outside of the image: ``repeat``, ``mirror`` or ``clamp``.
        raw : boolean, default: false
            Whether sums are neither decoded nor clamped.
        prefilter : float or boolean, default: 0
            Angle of a pixel in radians, below 1 (`pixel_angle`), over which lookups average; 0
            looks at points; ``true`` takes that of the sensor of `follow`.
        cutoff : float, default: that of the set
            Standard deviations after which a Gaussian ends, above 0 and at most 12.
        memory : string, default: normal, of arrays exact
            ``normal``: a Gaussian takes 16 bytes until a parameter changes; ``small``: also lists
            of larger cells; ``exact``: floats.
        texels : integer, default: 0
            Texels along the longer side, into which the texture draws itself at every change, and
            which lookups read, without `prefilter` and `memory`; 0: lookups sum Gaussians.
        """

        transform_name, others = "to_uv", frozenset({"to_uv", "prefilter"})

        @guest()  # a thread of Mitsuba, whose caller may hold the lock
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.read(props, properties.wrap_mode(props), properties.raw(props))
            self.to_uv = properties.to_uv(props)
            self.drawn = properties.texels(props, self.source.start)
            if self.drawn:
                self.width, self.height = self.drawn
            properties.check_known(props)
            self.parameters_changed([])

        def parameters_changed(self, keys: list[str]) -> None:
            if not keys or "to_uv" in keys:
                properties.check_invertible(self.to_uv, self.plugin)
                self.transform = mi.Transform3f(self.to_uv)
                dr.make_opaque(self.transform)  # another transform compiles no other programs
            super().parameters_changed(keys)
            sampled = getattr(self, "emission", None) is not None
            self.survey: Survey | None = None
            self.emission: Emission | None = None
            if sampled:  # a frozen rendering cannot make it
                self._emission()

        # --- Lookups -----------------------------------------------------------------------------

        # Mitsuba calls lookups while it records a program: if the collector freed another scene
        # then, the program would lose that scene's textures, and read freed memory.

        @collector_off()
        def eval(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> mi.Spectrum:
            color = self._color(si, active)
            if len(color) == 1 or mi.is_monochromatic:
                return mi.UnpolarizedSpectrum(luminance(color))
            if self.spectra is None:
                return mi.Color3f(*color)
            if self.raw or not self.space.is_color:
                raise ValueError(
                    f"{self.label()}: a spectral variant needs colours for a reflectance or "
                    "radiance, not raw data; use a set in a colour space, and raw = false"
                )
            return upsample(mi.Color3f(*color), si.wavelengths, self.spectra)

        @collector_off()
        def eval_1(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> Float:
            return luminance(self._color(si, active))

        @collector_off()
        def eval_3(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> mi.Color3f:
            if self.channels == 1:
                raise ValueError(
                    f"{self.label()}: a lookup of three channels, such as a normal map, needs a "
                    "set of two or three channels; this set has one"
                )
            return mi.Color3f(*self._color(si, active))

        @collector_off()
        def eval_1_grad(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> mi.Vector2f:
            if self.channels not in (1, 3):
                raise ValueError(
                    f"{self.label()}: a bump map needs heights; this set has {self.channels} "
                    "channels"
                )
            (x, sx), (y, sy), inside = self.point(si.uv)
            slopes = self.texels.slopes if self.drawn else self._slopes
            along, down = slopes(x, y, inside & active)
            du, dv = luminance(along) * sx * self.width, luminance(down) * sy * self.height
            m = self.transform.matrix
            return mi.Vector2f(m[0, 0] * du + m[1, 0] * dv, m[0, 1] * du + m[1, 1] * dv)

        def _slopes(self, x: Float, y: Float, active: Bool) -> list[list]:
            """Return the derivatives of all channels by x, and by y."""
            cells, packed = self.table.lists.cells, self.table.packed
            terms = gradient_terms(packed)
            sums = sum_at_points(cells, packed, x, y, active, terms, 3 * packed.channels)
            values, *derivatives = (sums[k::3][self.part] for k in range(3))
            background = self.table.background[self.part]
            slope = [slope_of(self, v + b) for v, b in zip(values, background, strict=True)]
            return [[s * k for s, k in zip(slope, ks, strict=True)] for ks in derivatives]

        def _color(self, si: mi.SurfaceInteraction3f, active: Mask) -> list:
            """Look up the channels of a colour, a number or a normal."""
            if self.channels > 3:
                raise ValueError(
                    f"{self.label()}: the set has {self.channels} channels; use a set of 1 to 3"
                )
            return self.values(si, active)

        def values(self, si: mi.SurfaceInteraction3f, active: Mask) -> list:
            """Look up all channels, decoded and clamped unless `raw`; 0 where uv is not finite."""
            (x, _), (y, _), inside = self.point(si.uv)
            seen = inside & active
            channels = self.texels.at(x, y, seen) if self.drawn else self.display(self._sums(si))
            return [dr.select(seen, c, 0) for c in channels]

        def _sums(self, si: mi.SurfaceInteraction3f) -> list:
            """Return the sums of all channels of the table, perhaps those of an earlier lookup."""
            where = (self.wrap, self.angle, id(self.sensor), *np.array(self.to_uv.matrix).flat)
            inputs = ("uv", *(FOOTPRINT_INPUTS if self.filtered() else ()))
            return reused(self.table, where, si, inputs, lambda: self._look_up(si))

        def _look_up(self, si: mi.SurfaceInteraction3f) -> list:
            """Sum all channels of the table, in all lanes."""
            (x, sx), (y, sy), inside = self.point(si.uv)
            if not self.filtered():
                return self.sums_at((x, sx), (y, sy), inside)
            # B of a transform with the rows of B^-1
            turned = self.transform.inverse_transpose
            inverse = tuple(turned[j, i] for i in range(2) for j in range(2))
            angle = self.pixel()
            seen = no_metric(self.label()) if angle is None else metric(si, inverse, angle)
            if self.wrap == "clamp":  # a footprint beyond the border may see what lies inside
                u, v = self.transform @ si.uv
                x, y = (
                    near_image(u * self.width, self.width),
                    near_image(v * self.height, self.height),
                )
                sx = sy = type(x)(1)
            return self.sums_at((x, sx), (y, sy), inside, seen)

        def point(self, uv: mi.Point2f) -> tuple:
            """Fold uv into the image: x, y in pixels with their slopes; whether uv is finite."""
            u, v = self.transform @ uv
            x = fold(u * self.width, self.width, self.wrap)
            y = fold(v * self.height, self.height, self.wrap)
            return x, y, dr.isfinite(u) & dr.isfinite(v)

        def spans(self) -> NDArray[np.float64]:
            """Return the columns and rows of texels that the unit square of uv spans."""
            size = np.array([[self.width], [self.height]])
            return np.hypot(*(np.array(self.to_uv.matrix, np.float64)[:2, :2] * size))

        # --- Sampling ----------------------------------------------------------------------------

        @collector_off()
        def sample_position(self, sample: mi.Point2f, active: Mask = True) -> tuple:
            return self._emission().sample(sample, active)

        @collector_off()
        def pdf_position(self, p: mi.Point2f, active: Mask = True) -> Float:
            return self._emission().density(p, active)

        @collector_off()
        def sample_spectrum(
            self, si: mi.SurfaceInteraction3f, sample: mi.Spectrum, active: Mask = True
        ) -> tuple:
            if not mi.is_spectral:
                return mi.Color0f(), self.eval(si, active)
            width = mi.MI_CIE_MAX - mi.MI_CIE_MIN
            si = mi.SurfaceInteraction3f(si)
            si.wavelengths = mi.MI_CIE_MIN + width * sample
            return si.wavelengths, self.eval(si, active) * width

        def pdf_spectrum(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> mi.Spectrum:
            if not mi.is_spectral:
                return mi.Color0f()
            inside = (si.wavelengths >= mi.MI_CIE_MIN) & (si.wavelengths <= mi.MI_CIE_MAX)
            return dr.select(inside & active, 1 / (mi.MI_CIE_MAX - mi.MI_CIE_MIN), 0)

        def spectral_resolution(self) -> float:
            return STEP

        def mean(self) -> Float:
            return self._surveyed().mean

        def max(self) -> float:
            return float(self._surveyed().largest[0])

        def _surveyed(self) -> Survey:
            """Return the survey of the brightness; the first call after a change makes it."""
            if self.survey is None:
                self.survey = outside_of_recordings(lambda: make_survey(self))
            return self.survey

        def _emission(self) -> Emission:
            """Return the distribution of emission; the first call after a change makes it."""
            if self.emission is None:
                self.emission = emission_of(self._surveyed())
            return self.emission

        # --- Description -------------------------------------------------------------------------

        def resolution(self) -> mi.ScalarVector2i:
            return mi.ScalarVector2i(self.width, self.height)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            transform = str(self.to_uv).replace("\n", "\n  ")
            return (
                f'GaussianTexture[\n  name = "{self.file}",\n'
                f"  gaussians = {self.source.count},\n"
                f"  resolution = [{self.width}, {self.height}],\n"
                f"  space = {self.space},\n  raw = {int(self.raw)},\n"
                f"  wrap_mode = {self.wrap},\n  prefilter = {self.prefilter_name()},\n"
                f"  cutoff = {self.cutoff:g},\n  memory = {self.memory.name},\n"
                f"  texels = {max(self.drawn or (0,))},\n"
                f"  resident_bytes = {resident_bytes(self)},\n"
                f"  transform = {transform}\n]"
            )

    return GaussianTexture
