"""The footprint of a pixel on a texture: the cone of the pixel, cut by the surface.

Mitsuba 3.10 gives footprints where the camera sees directly; elsewhere the angle of a pixel does.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import rcp
from eigengs_dr.backend.doors import door
from eigengs_dr.backend.messages import warn
from eigengs_dr.backend.types import Bool, Float

from .versions import footprint_of, has_footprints

PIXEL = 0.4
"""Standard deviation of a footprint in pixels. The random positions of samples in a pixel already
blur by 0.29 (a box); at 0.4, one sample of a receding plane came closest to the mean of 1,024."""


@door
def pixel_angle(sensor: mi.Sensor) -> float:
    """Return the angle of a pixel in the centre of a perspective image, for ``prefilter``.

    The angle is ``2 tan(x_fov / 2) / width``. Rays start at the near clip plane, so keep
    ``near_clip`` small against the distance of the texture.

    Parameters
    ----------
    sensor : mitsuba.Sensor
        A ``perspective`` or ``thinlens`` sensor.

    Returns
    -------
    float
        The angle in radians.

    Raises
    ------
    ValueError
        If the sensor has no field of view.
    """
    return float(dr.slice(current_angle(sensor)))


def current_angle(sensor: mi.Sensor) -> Float:
    """Return the angle of `pixel_angle` as an array of Dr.Jit, also while it records a program."""
    parameters = mi.traverse(sensor)
    if "x_fov" not in parameters:
        raise ValueError(
            f"pixel_angle: {type(sensor).__name__} has no x_fov; use a perspective or thinlens "
            "sensor, or set 'prefilter' to the angle of a pixel in radians"
        )
    half = dr.detach(parameters["x_fov"]) * (math.pi / 360)
    return dr.tan(half) * (2 / sensor.film().size()[0])


def footprint_inputs() -> tuple[str, ...]:
    """Return the attributes of a surface interaction from which `seen_metric` finds a footprint."""
    carried = ("footprint",) if has_footprints() else ()
    return ("t", "wi", "sh_frame", "dp_du", "dp_dv", *carried)


def seen_metric(
    si: mi.SurfaceInteraction3f, inverse: tuple, angle: Float | None, plugin: str
) -> tuple[list, Bool]:
    """Return the metric of the renderer's footprint, or of the cone's where there is none.

    Parameters
    ----------
    si, inverse, angle
        As for `metric`. Without an angle, surfaces without a footprint have no metric.
    plugin : str
        Name of the plugin, for messages.

    Returns
    -------
    metric : list of 3 Float
    valid : Bool

    Raises
    ------
    ValueError
        As for `no_metric`, if there is no angle, and rays carry no footprints.
    """
    footprint = footprint_of(si)
    if footprint is None:
        return metric(si, inverse, angle) if angle is not None else no_metric(plugin)
    entries, present = footprint_metric(footprint, inverse)
    if angle is None:
        return entries, present
    others, valid = metric(si, inverse, angle)
    return [dr.select(present, e, o) for e, o in zip(entries, others, strict=True)], present | valid


def no_metric(plugin: str) -> tuple[list, Bool]:
    """Return the metric of lookups at points, for a plugin that is to follow a sensor and has none.

    Dr.Jit records the lookups of all scenes that are alive: an error in a scene that only waits to
    be rendered would end the renderings of all others.

    Raises
    ------
    ValueError
        Outside of recordings.

    Warns
    -----
    UserWarning
        In a recording.
    """
    text = (
        f"{plugin}: prefilter = true needs a sensor, since rays of Mitsuba {mi.__version__} carry "
        "no footprints; call eigengs_dr.plugins.follow(scene, sensor), or render by 'eigengs-dr "
        "scene'"
    )
    if not dr.flag(dr.JitFlag.SymbolicScope):
        raise ValueError(text)
    warn(f"{text}. Until then it looks at points")
    return [mi.Float(0)] * 3, mi.Bool(False)


def footprint_metric(footprint: tuple, inverse: tuple) -> tuple[list, Bool]:
    """Return the metric in which the footprint of a renderer is the unit circle.

    With the footprint M, whose columns span a pixel in uv, and the inverse B of ``to_uv``, the
    covariance is ``PIXEL^2 B^-1 M M^T B^-T``.

    Parameters
    ----------
    footprint : tuple of 4 Float
        Entries m00, m01, m10, m11.
    inverse : tuple of 4 Float
        Rows of B.

    Returns
    -------
    metric : list of 3 Float
        Entries xx, xy, yy.
    present : Bool
        False if the footprint has no area.
    """
    m00, m01, m10, m11 = footprint
    b00, b01, b10, b11 = inverse
    area = dr.fma(m00, m11, -m01 * m10)
    present = (area != 0) & dr.isfinite(area)
    scale = rcp(PIXEL * dr.select(present, area, 1))
    n00, n01 = (m11 * b00 - m01 * b10) * scale, (m11 * b01 - m01 * b11) * scale
    n10, n11 = (m00 * b10 - m10 * b00) * scale, (m00 * b11 - m10 * b01) * scale
    return [n00 * n00 + n10 * n10, n00 * n01 + n10 * n11, n01 * n01 + n11 * n11], present


def metric(si: mi.SurfaceInteraction3f, inverse: tuple, angle: Float) -> tuple[list, Bool]:
    """Return the metric of the texture plane in which the footprint of a pixel is the unit circle.

    At the distance t along the ray direction d, the cone of a pixel has the radius
    ``r = PIXEL angle t``. With ``J = [dp_du dp_dv]`` and ``P = 1 - d d^T``, the camera sees a step
    ``J (du, dv)`` as ``P J (du, dv)``, so the inverse covariance is ``J^T P J / r^2``. t counts
    from the start of the ray: the near clip plane, or the last bounce. After a bounce the cone is
    narrower than it should be, and the texture sharper.

    Parameters
    ----------
    si : mitsuba.SurfaceInteraction3f
    inverse : tuple of 4 float
        Rows of the inverse of the linear part of ``to_uv``.
    angle : Float
        Angle of a pixel in radians.

    Returns
    -------
    metric : list of 3 Float
        Entries xx, xy, yy.
    valid : Bool
        False if the footprint is undefined: the surface has no uv Jacobian, or t is not positive
        and finite.
    """
    d, u, v = si.to_world(si.wi), si.dp_du, si.dp_dv
    ahead = (si.t > 0) & dr.isfinite(si.t)
    t = dr.select(ahead, si.t, 1)
    b00, b01, b10, b11 = inverse
    u, v = u * b00 + v * b10, u * b01 + v * b11
    seen_u, seen_v = u - d * dr.dot(d, u), v - d * dr.dot(d, v)
    area = dr.squared_norm(dr.cross(u, v))
    sharp = rcp(dr.square(PIXEL * angle * t))
    valid = (area > 0) & dr.isfinite(area) & ahead
    return [
        dr.squared_norm(seen_u) * sharp,
        dr.dot(seen_u, seen_v) * sharp,
        dr.squared_norm(seen_v) * sharp,
    ], valid
