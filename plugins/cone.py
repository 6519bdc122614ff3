"""The footprint of a pixel on a texture: the cone of the pixel, cut by the surface."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import rcp
from eigengs_dr.backend.doors import door
from eigengs_dr.backend.messages import warn
from eigengs_dr.backend.types import Bool, Float

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


FOOTPRINT_INPUTS = ("t", "wi", "sh_frame", "dp_du", "dp_dv")
"""Attributes of a surface interaction from which `metric` finds a footprint."""


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
