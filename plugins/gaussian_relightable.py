"""The material ``gaussian_relightable``: photos under many lights, under the lights of a scene."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import rsqrt, upload
from eigengs_dr.backend.recording import collector_off, guest
from eigengs_dr.backend.types import Float, Mask, Texture
from eigengs_dr.image.color import clamp, to_linear
from eigengs_dr.relight.directions import Octahedron

from . import properties
from .color import luminance, unpolarized, upload_table, upsample
from .gaussian_texture import gaussian_texture

GRID = Octahedron(32)
"""Directions on which factors of planes are tabulated."""

UNIFORM = 0.5
"""Share of the samples that are uniform over the hemisphere; the others go with the cosine, whose
samples alone would weigh without bound at the horizon, where photos have ambient light."""


def gaussian_relightable() -> type:
    """Return the class of the material, a `mitsuba.BSDF` of the current variant."""
    texture = gaussian_texture()

    class GaussianRelightable(mi.BSDF):
        """A `Relightable` under the lights of a scene: what its camera saw, from everywhere.

        With the photo P under a light from l, the value towards any direction above the surface is
        ``scale / pi to_linear(P(u, v, l))``, which has the cosine in it: photos are brightest
        where light falls straight. A light of irradiance pi shows the photo itself. Light of
        photos above white is kept.

        Photos hold the shadows that the object casts on itself, but its highlights are those
        towards the camera of the photos, wherever the camera of the scene stands. The material has
        one side, and its values are not reciprocal: integrators that start at the light, such as
        ``ptracer``, get ``cos(wo) / cos(wi)`` times the value for the light from `wi`.

        Light comes from the side of the photo that it has on the surface, as `to_uv`, mirrored
        copies and uv place it there. The axes of the photo are those of `light_axes`.

        Parameters
        ----------
        model : string
            A file of a `Relightable`, as ``eigengs-dr train --lights`` writes; relative to the
            scene. Photos lie over uv as those of a ``gaussian_texture``, row 0 at v = 0. Or the
            arrays of a model, as `eigengs_dr.plugins.material_of` writes them.
        scale : float, default: 1
            Factor of all values.
        wrap_mode, to_uv, prefilter, memory, texels
            See ``gaussian_texture``.

        Raises
        ------
        ValueError
            If the file has another format or is damaged, a value is out of range, or a property is
            unknown. `mitsuba.load_dict` raises it as a RuntimeError with the same text.
        OSError
            If the file cannot be opened; from `mitsuba.load_dict` a RuntimeError, too.
        """

        @guest()  # a thread of Mitsuba, whose caller may hold the lock
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            lights, self.brightest, planes = properties.lit_planes(props)
            self.scale = dr.opaque(mi.Float, properties.light_scale(props))
            self.planes = texture(planes)
            properties.check_known(props)
            side = GRID.resolution
            table = lights.at(GRID.directions()).reshape(side, side, -1)
            self.factors = mi.Texture2f(
                upload(mi.TensorXf, table.astype(np.float32)),
                use_accel=False,
                wrap_mode=dr.WrapMode.Clamp,
            )
            self.spectra = upload_table() if mi.is_spectral else None
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0] | mi.BSDFFlags.SpatiallyVarying

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("planes", self.planes, mi.ParamFlags.Differentiable)
            callback.put("scale", self.scale, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            if "scale" in keys:
                properties.check_scale(self.scale, self.planes.plugin)

        # --- Values --------------------------------------------------------------------------

        # Mitsuba calls these while it records a program, see `GaussianTexture`.
        @collector_off()
        def eval(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            wo: mi.Vector3f,
            active: Mask = True,
        ) -> mi.Spectrum:
            active = active & self._seen(ctx, si, wo)
            values = self.planes.values(si, active)[: self.planes.channels]  # two get a third
            planes = [*values, mi.Float(1)]
            towards, scale = wo, self.scale / math.pi
            if ctx.mode == mi.TransportMode.Importance:  # a path from the light to the camera
                cos_theta = mi.Frame3f.cos_theta
                scale *= cos_theta(wo) / dr.select(active, cos_theta(si.wi), 1)
                towards = si.wi
            x, y = light_axes(si, self.planes)
            light = dr.dot(x, towards.xy), dr.dot(y, towards.xy), towards.z
            table = self.factors.eval(mi.Point2f(*GRID.uv(*light)), active)
            factors = [table[c * len(planes) : (c + 1) * len(planes)] for c in range(3)]
            codes = [sum(f * p for f, p in zip(fs, planes, strict=True)) for fs in factors]
            color = mi.Color3f(*(to_linear(clamp(code, self.brightest)) for code in codes)) * scale
            return unpolarized(dr.select(active, self._spectrum(color, si), 0))

        @collector_off()
        def pdf(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            wo: mi.Vector3f,
            active: Mask = True,
        ) -> Float:
            return dr.select(active & self._seen(ctx, si, wo), density(wo), 0)

        @collector_off()
        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: Float,
            sample2: mi.Point2f,
            active: Mask = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(
                sample1 < UNIFORM,
                mi.warp.square_to_uniform_hemisphere(sample2),
                mi.warp.square_to_cosine_hemisphere(sample2),
            )
            bs.pdf, bs.eta = density(bs.wo), 1.0
            bs.sampled_type, bs.sampled_component = mi.UInt32(+self.m_components[0]), 0
            active = active & self._seen(ctx, si, bs.wo) & (bs.pdf > 0)
            weight = dr.select(active, 1 / bs.pdf, 0)
            return bs, self.eval(ctx, si, bs.wo, active) * weight

        def _seen(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> Mask:
            """Return whether both directions are above the surface."""
            above = (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            return above & ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)

        def _spectrum(
            self, light: mi.Color3f, si: mi.SurfaceInteraction3f
        ) -> mi.UnpolarizedSpectrum:
            if self.spectra is not None:
                return upsample(light, si.wavelengths, self.spectra)
            return mi.UnpolarizedSpectrum(luminance([*light]) if mi.is_monochromatic else light)

        # --- Description ---------------------------------------------------------------------

        def to_string(self) -> str:
            planes = self.planes.to_string().replace("\n", "\n  ")
            return f"GaussianRelightable[\n  scale = {self.scale},\n  planes = {planes}\n]"

    return GaussianRelightable


def light_axes(si: mi.SurfaceInteraction3f, planes: Texture) -> tuple[mi.Vector2f, mi.Vector2f]:
    """Return the axes x and y of photos on a surface, in the first two axes of its shading frame.

    With B, the derivative of uv by the place in the photo, columns of the photo grow along
    ``ex = dp_du B00 + dp_dv B10`` and its rows along ``ey = dp_du B01 + dp_dv B11``. Then x has the
    direction of ex, and y is perpendicular to it on the side against ey. So directions keep
    their angles where uv shears the photo or scales it unequally.

    The first axis of the frame goes along u, but inside of a ``bumpmap`` of Mitsuba 3.9, which
    mixes axes of the world with those of its own frame.
    """
    (_, slope_x), (_, slope_y), _ = planes.point(si.uv)  # against uv in mirrored copies
    transposed = planes.transform.inverse_transpose
    (b00, b01), (b10, b11) = ([transposed[j, i] for j in range(2)] for i in range(2))
    normal = dr.cross(si.dp_du, si.dp_dv)
    v_side = dr.dot(normal, si.sh_frame.n)
    across = dr.mulsign(dr.sqrt(dr.maximum(dr.squared_norm(normal), TINY)), v_side)
    along = mi.Vector2f(
        dr.squared_norm(si.dp_du) * b00 + dr.dot(si.dp_du, si.dp_dv) * b10, across * b10
    )
    square = dr.squared_norm(along)
    unit = along * rsqrt(dr.maximum(square, TINY))
    x = dr.mulsign(dr.select(square > TINY, unit, mi.Vector2f(1, 0)), slope_x)
    mirrored = dr.mulsign(dr.mulsign((b00 * b11 - b01 * b10) * v_side, slope_x), slope_y)
    return x, dr.mulsign(mi.Vector2f(x.y, -x.x), mirrored)


TINY = 1e-30
"""Square of a length that counts as 0: uv that is constant along a surface has no direction."""


def density(wo: mi.Vector3f) -> Float:
    """Return the density of samples over the upper hemisphere."""
    uniform = mi.warp.square_to_uniform_hemisphere_pdf(wo)
    return dr.lerp(mi.warp.square_to_cosine_hemisphere_pdf(wo), uniform, UNIFORM)
