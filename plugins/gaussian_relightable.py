"""The material ``gaussian_relightable``: photos under many lights, under the lights of a scene."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import upload
from eigengs_dr.backend.recording import collector_off, guest
from eigengs_dr.backend.selection import backend_of
from eigengs_dr.backend.types import Float, Mask
from eigengs_dr.image.space import RGB
from eigengs_dr.relight.model import Relightable
from eigengs_dr.relight.planes import directions

from . import properties
from .color import luminance, unpolarized, upload_table, upsample
from .gaussian_texture import gaussian_texture

RESOLUTION = 32
"""Directions along each side of the octahedron on which factors of planes are tabulated."""

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
        where light falls straight. A light of irradiance pi shows the photo itself.

        Photos hold the shadows that the object casts on itself, but its highlights are those
        towards the camera of the photos, wherever the camera of the scene stands. The material has
        one side, and its values are not reciprocal.

        Parameters
        ----------
        model : string
            A file of a `Relightable`, as ``eigengs-dr train --lights`` writes; relative to the
            scene. Photos lie over uv as those of a ``gaussian_texture``, row 0 at v = 0.
        scale : float, default: 1
            Factor of all values.
        wrap_mode, to_uv, prefilter, memory
            See ``gaussian_texture``. Photos are not turned by `to_uv`: it may scale and move.

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
            path = properties.path(props, "model")
            lights = Relightable.load(path, backend_of(mi.variant())).table
            self.scale = dr.opaque(mi.Float, properties.light_scale(props))
            self.planes = texture(_properties_of_planes(path, props))
            properties.check_known(props)
            table = lights.at(directions(RESOLUTION)).reshape(RESOLUTION, RESOLUTION, -1)
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
            table = self.factors.eval(place_of(light_of(si, wo)), active)
            factors = [table[c * len(planes) : (c + 1) * len(planes)] for c in range(3)]
            codes = [sum(f * p for f, p in zip(fs, planes, strict=True)) for fs in factors]
            light = mi.Color3f(*RGB.to_lights(codes)) * (self.scale / math.pi)
            return unpolarized(dr.select(active, self._spectrum(light, si), 0))

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


def _properties_of_planes(path: str, props: mi.Properties) -> mi.Properties:
    """Return the properties of the texture of the planes: a channel for each."""
    texture = mi.Properties("gaussian_texture")
    texture.set_id(props.id())
    texture["planes"], texture["raw"] = path, True
    for key in ("wrap_mode", "to_uv", "prefilter", "memory"):
        if key in props:
            texture[key] = props[key]
    return texture


def light_of(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> mi.Vector3f:
    """Return a local direction in the axes of photos: x along u, y against v, z along the normal.

    The first axis of the shading frame goes along u. Its second one goes along v, or against it
    where uv is mirrored.
    """
    along = dr.dot(si.dp_dv, si.sh_frame.t)
    return mi.Vector3f(wo.x, -dr.mulsign(wo.y, along), wo.z)


def place_of(light: mi.Vector3f) -> mi.Point2f:
    """Return where an upper direction lies in the table, see `relight.planes.directions`."""
    length = dr.abs(light.x) + dr.abs(light.y) + dr.maximum(light.z, 0)
    scale = 0.5 * (RESOLUTION - 1) / RESOLUTION / dr.maximum(length, 1e-20)
    # The first and the last direction lie at the centres of the outer texels.
    turned = mi.Point2f(light.x + light.y, light.y - light.x)
    return turned * scale + 0.5


def density(wo: mi.Vector3f) -> Float:
    """Return the density of samples over the upper hemisphere."""
    uniform = mi.warp.square_to_uniform_hemisphere_pdf(wo)
    return dr.lerp(mi.warp.square_to_cosine_hemisphere_pdf(wo), uniform, UNIFORM)
