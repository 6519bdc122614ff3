"""What a pixel sees of a texture: the camera's cone, cut by the surface."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

PIXEL = 0.4
"""Standard deviation of a footprint in pixels. Samples fall anywhere in a pixel, which blurs by
0.29 (a box) already; at 0.4 one sample of a receding plane came closest to the mean of 1,024."""


def pixel_angle(sensor: Any) -> float:
    """Angle that a pixel in the middle of a perspective sensor's image subtends.

    It is what the property ``prefilter`` of a texture takes: ``2 tan(x_fov / 2) / width``. Rays
    start at the near clip plane, so keep ``near_clip`` small against the distance of the texture.

    Parameters
    ----------
    sensor : mitsuba.Sensor
        A ``perspective`` or ``thinlens`` one.

    Returns
    -------
    float
        In radians.

    Raises
    ------
    ValueError
        If the sensor has no field of view.
    """
    parameters = mi.traverse(sensor)
    if "x_fov" not in parameters:
        raise ValueError(
            f"pixel_angle: {type(sensor).__name__} has no x_fov; give it a perspective or thinlens "
            "sensor, or write the angle of a pixel, in radians, into 'prefilter' yourself"
        )
    fov = math.radians(float(dr.slice(parameters["x_fov"])))
    return 2 * math.tan(fov / 2) / sensor.film().size()[0]


def metric(si: Any, inverse: tuple, angle: float) -> tuple[list, Any]:
    """Metric of the texture plane in which the footprint of a pixel is the unit circle.

    Around a ray along d a pixel's cone has the radius ``r = PIXEL angle t``. A step ``J (du, dv)``,
    ``J = [dp_du dp_dv]``, is seen as ``P J (du, dv)`` with ``P = 1 - d d^T``, so the inverse
    covariance is ``J^T P J / r^2``. t counts from where the ray starts: the near clip plane, or the
    last bounce, behind which a texture is seen sharper than it has to be.

    Parameters
    ----------
    si : mitsuba.SurfaceInteraction3f
    inverse : tuple of 4 float
        Rows of the inverse of the linear part of ``to_uv``.
    angle : float
        Of a pixel, in radians.

    Returns
    -------
    metric : list of 3 Float
        xx, xy, yy; detached from derivatives.
    valid : Bool
        False where the surface has no uv Jacobian or the ray no length: there is no footprint.
    """
    d = dr.detach(si.to_world(si.wi))
    u, v = dr.detach(si.dp_du), dr.detach(si.dp_dv)
    t = dr.detach(si.t)
    b00, b01, b10, b11 = inverse
    u, v = u * b00 + v * b10, u * b01 + v * b11
    seen_u, seen_v = u - d * dr.dot(d, u), v - d * dr.dot(d, v)
    area = dr.squared_norm(dr.cross(u, v))
    sharp = dr.rcp(dr.square(PIXEL * angle * t))
    valid = (area > 0) & dr.isfinite(area) & (t > 0) & dr.isfinite(t)
    return [
        dr.squared_norm(seen_u) * sharp,
        dr.dot(seen_u, seen_v) * sharp,
        dr.squared_norm(seen_v) * sharp,
    ], valid
