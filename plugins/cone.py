"""The footprint of a pixel on a texture: the cone of the pixel, cut by the surface."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arithmetic import rcp

PIXEL = 0.4
"""Standard deviation of a footprint in pixels. The random positions of samples in a pixel already
blur by 0.29 (a box); at 0.4, one sample of a receding plane came closest to the mean of 1,024."""


def pixel_angle(sensor: Any) -> float:
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
    parameters = mi.traverse(sensor)
    if "x_fov" not in parameters:
        raise ValueError(
            f"pixel_angle: {type(sensor).__name__} has no x_fov; use a perspective or thinlens "
            "sensor, or set 'prefilter' to the angle of a pixel in radians"
        )
    fov = math.radians(float(dr.slice(parameters["x_fov"])))
    return 2 * math.tan(fov / 2) / sensor.film().size()[0]


def metric(si: Any, inverse: tuple, angle: float) -> tuple[list, Any]:
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
    angle : float
        Angle of a pixel in radians.

    Returns
    -------
    metric : list of 3 Float
        Entries xx, xy, yy, without gradients.
    valid : Bool
        False if the footprint is undefined: the surface has no uv Jacobian, or t is not positive
        and finite.
    """
    d = dr.detach(si.to_world(si.wi))
    u, v = dr.detach(si.dp_du), dr.detach(si.dp_dv)
    t = dr.detach(si.t)
    b00, b01, b10, b11 = inverse
    u, v = u * b00 + v * b10, u * b01 + v * b11
    seen_u, seen_v = u - d * dr.dot(d, u), v - d * dr.dot(d, v)
    area = dr.squared_norm(dr.cross(u, v))
    sharp = rcp(dr.square(PIXEL * angle * t))
    valid = (area > 0) & dr.isfinite(area) & (t > 0) & dr.isfinite(t)
    return [
        dr.squared_norm(seen_u) * sharp,
        dr.dot(seen_u, seen_v) * sharp,
        dr.squared_norm(seen_v) * sharp,
    ], valid
