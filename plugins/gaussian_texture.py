"""The Mitsuba texture ``gaussian_texture``: a sum of 2D Gaussians, differentiable and prefiltered.

Dr.Jit treats `self` as loop state, which silently loses gradients, and supports no custom
derivatives inside a virtual call. So the class below only passes arrays to the functions of
`eigengs_dr.raster.lookup.points` and `eigengs_dr.raster.lookup.prefilter`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import Bool
from eigengs_dr.backend.recording import collector_off, guest
from eigengs_dr.image.color import rendered_as
from eigengs_dr.raster.lookup.footprint import arrange
from eigengs_dr.raster.lookup.points import (
    cell_side,
    fold,
    gradient_terms,
    in_list_order,
    list_cells,
    sum_at_points,
)
from eigengs_dr.raster.lookup.pyramid import build_pyramid, pyramid_mean
from eigengs_dr.raster.lookup.size_classes import classify_by_size
from eigengs_dr.raster.parameters import NUM_SHAPE_PARAMS, kernel_radius, pack_parameters
from eigengs_dr.raster.render import decode_parameters

from .color import (
    STEP,
    is_shown,
    keep_finite,
    luminance,
    show_all,
    slope_of,
    upload_table,
    upsample,
)
from .cone import footprint_inputs
from .emission import emission_of, make_survey, outside_of_recordings
from .lookup import reused, sum_here, sum_over_footprint
from .parameters import derived
from .properties import (
    cutoff,
    file_name,
    prefilter,
    prepare,
    raw,
    read_transform,
    source_of,
    wrap_mode,
)
from .versions import Interaction, Properties, Texture, register_texture, texture_class


def gaussian_texture() -> type:
    """Return the class of the texture, a `mitsuba.Texture` of the current variant."""
    if mi.variant().startswith("scalar"):
        return _Refusal

    class GaussianTexture(texture_class()):  # type: ignore[misc]
        """A sum of Gaussians over uv, ``(u, v) = (x / width, y / height)``, row 0 at v = 0.

        The Gaussians come from `filename`, from `model`, or from the arrays of a set, as
        `eigengs_dr.plugins.texture_of` writes them.

        Properties
        ----------
        filename : str
            Path of a set from ``eigengs-dr fit`` or `Gaussians.save`, or of a material. Textures
            of one file share the memory of means, shapes and lists until one of them changes.
        map : str
            With the `filename` of a material: the name of the map, such as "roughness".
        first : int
            With `filename`: number of Gaussians to use, from the first. Any number works for
            level-of-detail sets. By default all.
        model, coefficients
            Path of an `EigenGS` model and, optionally, coefficients (C, k).
        to_uv : transform
            Transform of uv before the lookup.
        wrap_mode : {"repeat", "mirror", "clamp"}
            Continuation of the texture outside of its borders; by default "repeat".
        raw : bool
            Return values without decoding and clamping; by default false.
        prefilter : float or bool
            Angle of a pixel in radians, at least 0 and below 1, see
            `eigengs_dr.plugins.pixel_angle`. Lookups average over the footprint of the pixel; 0,
            the default, looks at points. Footprints that rays carry (Mitsuba 3.10) go before the
            angle, and true takes them alone. Slopes of bump maps (`eval_1_grad`) ignore footprints.
        cutoff : float
            Radius of a Gaussian in standard deviations; by default the cutoff of the set.
        """

        @guest()  # a thread of Mitsuba, whose caller may hold the lock
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            self.source = source_of(props)
            self.file = file_name(props)
            self.raw = raw(props)
            self.cutoff = cutoff(props, self.source.start.cutoff)
            self.angle, self.follows = prefilter(props)
            self.inputs = ("uv", *(footprint_inputs() if self.filtered() else ()))
            self.wrap = wrap_mode(props)
            self.to_uv = read_transform(props)
            self.width, self.height = self.source.start.width, self.source.start.height
            self.space, self.channels = self.source.start.space, self.source.start.channels
            self.spectra = upload_table() if mi.is_spectral else None
            self.parameters_changed([])

        def traverse(self, callback: Any) -> None:
            self.source.put(callback)
            callback.put("to_uv", self.to_uv, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            self.transform = prepare(self.to_uv)
            if set(keys) != {"to_uv"}:
                self._take_over(not keys or any(key in self.source.shaping for key in keys))
            sampled = getattr(self, "emission", None) is not None
            self.survey: Any = None
            self.emission: Any = None
            if sampled:  # a frozen rendering cannot make it
                self._emission()

        def _take_over(self, moved: bool) -> None:
            """Take over the Gaussians; with new lists if they have moved."""
            inputs = self.source.inputs()
            # The lists come first, since they may raise: old lists would read beyond new Gaussians.
            if moved:
                fixed = self.source.gaussians(dr.detach(inputs))
                self._list(list(decode_parameters(fixed).shape))
            found = derived(inputs, self._prepare)
            self.packed, self.background = found["packed"], found["background"]
            self.arranged = found["arranged"]
            if self.filtered():
                self.pyramid = replace(self.levels, values=found["values"])
                self.average = found["average"]

        def _prepare(self, inputs: dict[str, Any]) -> dict[str, Any]:
            """Compute what lookups read from the parameters."""
            parameters = decode_parameters(self.source.gaussians(inputs))
            shape, color = parameters.shape, [keep_finite(c) for c in parameters.color]
            found: dict[str, Any] = {"background": [keep_finite(b) for b in parameters.background]}
            found["packed"] = pack_parameters([*shape, *color])
            if not self.filtered():
                found["arranged"] = in_list_order(self.cells.splat, [*shape, *color])
                dr.eval(found)
                return found
            found["arranged"] = arrange(self.cells.splat, shape, color)
            dr.eval(found)
            number = NUM_SHAPE_PARAMS + self.channels
            pyramid = build_pyramid(self.sizes, found["packed"], number, self.cutoff)
            self.levels = replace(pyramid, values=None)
            found |= {"values": pyramid.values, "average": pyramid_mean(pyramid)}
            dr.eval(found["average"])
            return found

        def _list(self, shape: list) -> None:
            """List the Gaussians near every cell."""
            size = (self.width, self.height)
            listed = self.source.listed
            if self.filtered():
                self.sizes = listed(
                    ("sizes", self.cutoff, self.wrap),
                    lambda: classify_by_size(shape, *size, self.cutoff, self.wrap),
                )
                _, self.cells = self.sizes.listed[0]  # slopes and the survey look at points
            else:
                side, radius = cell_side(*size, dr.width(shape)), kernel_radius(self.cutoff)
                self.cells = listed(
                    ("cells", radius), lambda: list_cells(shape, *size, radius, side)
                )

        # --- Lookups -----------------------------------------------------------------------------

        @collector_off()
        def eval(self, si: Interaction, active: Bool = True) -> Any:
            color = self._color(si, active)
            if len(color) == 1 or mi.is_monochromatic:
                return mi.UnpolarizedSpectrum(luminance(color))
            if not mi.is_spectral:
                return mi.Color3f(*color)
            if self.raw or rendered_as(self.space) is None:
                raise ValueError(
                    f"{_name(self)}: a spectral variant needs colours for a reflectance or "
                    "radiance, not raw data; use a set in a colour space, and raw = false"
                )
            return upsample(mi.Color3f(*color), si.wavelengths, self.spectra)

        @collector_off()
        def eval_1(self, si: Interaction, active: Bool = True) -> Any:
            return luminance(self._color(si, active))

        @collector_off()
        def eval_3(self, si: Interaction, active: Bool = True) -> Any:
            if self.channels != 3:
                raise ValueError(
                    f"{_name(self)}: a lookup of three channels, such as a normal map, needs a set "
                    "of three channels; this set has one"
                )
            return mi.Color3f(*self._color(si, active))

        @collector_off()
        def eval_1_grad(self, si: Interaction, active: Bool = True) -> Any:
            (x, sx), (y, sy), active = self._point(si, active)
            terms = gradient_terms(kernel_radius(self.cutoff))
            number = NUM_SHAPE_PARAMS + self.channels
            count = 3 * self.channels
            sums = sum_at_points(self.cells, self.packed, number, x, y, active, terms, count)
            coded = [s + b for s, b in zip(sums[::3], self.background, strict=True)]
            slope = [dr.select(is_shown(self, c), slope_of(self, c), 0) for c in coded]
            du = luminance([s * k for s, k in zip(slope, sums[1::3], strict=True)])
            dv = luminance([s * k for s, k in zip(slope, sums[2::3], strict=True)])
            du, dv = du * sx * self.width, dv * sy * self.height
            return mi.Vector2f(*self.transform.pull_back(du, dv))

        def _color(self, si: Interaction, active: Bool) -> list:
            """Look up the channels, decoded and clamped unless `raw`."""
            color = reused(self, si, self.inputs, lambda: self._look_up(si))
            return [dr.select(active, c, 0) for c in color]

        def _look_up(self, si: Interaction) -> list:
            """Look up the channels in all lanes; 0 where uv is not finite."""
            (x, sx), (y, sy), valid = self._point(si, True)
            if self.filtered():
                sums = sum_over_footprint(self, si, (x, sx), (y, sy), valid)
            else:
                sums = sum_here(self, x, y, valid)
            sums = [s + b for s, b in zip(sums, self.background, strict=True)]
            return [dr.select(valid, s, 0) for s in show_all(self, sums)]

        def _point(self, si: Interaction, active: Bool) -> tuple:
            """Fold uv into the image: x, y in pixels with their slopes, active if uv is finite."""
            u, v = self.transform.apply(si.uv)
            active = mi.Bool(active) & dr.isfinite(u) & dr.isfinite(v)
            x = fold(u * self.width, self.width, self.wrap)
            y = fold(v * self.height, self.height, self.wrap)
            return x, y, active

        # --- Sampling ----------------------------------------------------------------------------

        @collector_off()
        def sample_position(self, sample: Any, active: Bool = True) -> tuple:
            return self._emission().sample(sample, active)

        @collector_off()
        def pdf_position(self, p: Any, active: Bool = True) -> Any:
            return self._emission().density(p, active)

        @collector_off()
        def sample_spectrum(self, si: Interaction, sample: Any, active: Bool = True) -> tuple:
            if not mi.is_spectral:
                return mi.Color0f(), self.eval(si, active)
            width = mi.MI_CIE_MAX - mi.MI_CIE_MIN
            si = mi.SurfaceInteraction3f(si)
            si.wavelengths = mi.MI_CIE_MIN + width * sample
            return si.wavelengths, self.eval(si, active) * width

        def pdf_spectrum(self, si: Interaction, active: Bool = True) -> Any:
            if not mi.is_spectral:
                return mi.Color0f()
            inside = (si.wavelengths >= mi.MI_CIE_MIN) & (si.wavelengths <= mi.MI_CIE_MAX)
            return dr.select(inside & active, 1 / (mi.MI_CIE_MAX - mi.MI_CIE_MIN), 0)

        def spectral_resolution(self) -> float:
            return STEP

        def mean(self) -> Any:
            return self._surveyed().mean

        def max(self) -> float:
            return float(self._surveyed().largest[0])

        def _surveyed(self) -> Any:
            """Return the survey of the brightness; the first call after a change makes it."""
            if self.survey is None:
                self.survey = outside_of_recordings(lambda: make_survey(self))
            return self.survey

        def _emission(self) -> Any:
            """Return the distribution of emission; the first call after a change makes it."""
            if self.emission is None:
                self.emission = emission_of(self._surveyed())
            return self.emission

        # --- Description -------------------------------------------------------------------------

        def resolution(self) -> Any:
            return mi.ScalarVector2i(self.width, self.height)

        def filtered(self) -> bool:
            """Return whether lookups average over a footprint; Mitsuba 3.10 asks."""
            return self.follows or self.angle > 0

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            angle = "true" if self.follows else f"{self.angle:g}"
            transform = str(self.to_uv).replace("\n", "\n  ")
            return (
                f'GaussianTexture[\n  name = "{self.file}",\n'
                f"  gaussians = {len(self.source.start)},\n"
                f"  resolution = [{self.width}, {self.height}],\n"
                f"  space = {self.space},\n  raw = {int(self.raw)},\n"
                f"  wrap_mode = {self.wrap},\n  prefilter = {angle},\n"
                f"  cutoff = {self.cutoff:g},\n  mean = {self.mean()},\n"
                f"  transform = {transform}\n]"
            )

    return GaussianTexture


def _name(texture: Texture) -> str:
    return f"gaussian_texture {texture.id()!r}" if texture.id() else "gaussian_texture"


class _Refusal:
    """The class for scalar variants, which raises an error."""

    def __init__(self, props: Properties) -> None:
        raise RuntimeError(
            f"gaussian_texture does not support the variant {mi.variant()}; "
            "use mi.set_variant('llvm_ad_rgb') or another llvm or cuda variant"
        )


def register_plugins() -> None:
    """Register ``gaussian_texture`` with the current variant of Mitsuba and with later ones.

    Further calls change nothing. In scalar variants, a scene that uses the texture raises an error.

    Raises
    ------
    ImportError
        If Mitsuba is not installed.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> mi.set_variant("llvm_ad_rgb")
    >>> eg.register_plugins()
    """
    _follow()
    if mi.variant():
        _register(mi.variant())


@cache
def _follow() -> None:
    mi.detail.add_variant_callback(lambda old, new: _register(new))


@cache
def _register(variant: str) -> None:
    register_texture("gaussian_texture", gaussian_texture())
