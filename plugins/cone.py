"""The footprint of a pixel on a texture, the cone of the pixel cut by the surface; its sensor."""

from __future__ import annotations

import math
from numbers import Integral

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.arrays import rcp
from eigengs_dr.backend.entry_points import entry_point
from eigengs_dr.backend.messages import shown, warn
from eigengs_dr.backend.types import Bool, Float, Texture

PIXEL = 0.4
"""Standard deviation of a footprint in pixels. The random positions of samples in a pixel already
blur by 0.29 (a box); at 0.4, one sample of a receding plane came closest to the mean of 1,024."""


@entry_point
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


CLOSE = 1.25
"""Ratio of a prefilter to the angle of a pixel up to which nobody sees the difference."""


@entry_point
def follow(scene: mi.Scene, sensor: mi.Sensor | int = 0) -> None:
    """Set the prefilter of all Gaussian textures and environments of a scene to a sensor's pixels.

    They follow the sensor: each rendering reads its field of view and the size of its film,
    so that a change of either changes the prefilter. A number that is written to the parameter
    ``prefilter`` of a texture ends that. Textures with ``texels`` have no prefilter.

    Parameters
    ----------
    scene : mitsuba.Scene
    sensor : mitsuba.Sensor or int, optional
        A ``perspective`` or ``thinlens`` sensor, or its number in the scene. Call the function
        again before another sensor renders.

    Raises
    ------
    ValueError
        If the sensor has no field of view, or the scene no sensor of this number.
    TypeError
        If the scene or the sensor is none.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> from eigengs_dr.plugins import follow, texture_of
    >>> g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1]], size=(8, 8), space="data")
    >>> bsdf = {"type": "diffuse", "reflectance": texture_of(g)}
    >>> wall = {"type": "rectangle", "bsdf": bsdf}
    >>> scene = mi.load_dict({"type": "scene", "wall": wall, "sensor": {"type": "perspective"}})
    >>> follow(scene)
    """
    check_scene("follow", scene)
    sensor = sensor_of(scene, sensor)
    for plugin in plugins_of(scene):
        plugin.follow(sensor)


def follow_where_asked(scene: mi.Scene, sensor: mi.Sensor | int) -> None:
    """Let the plugins whose prefilter is ``true`` follow a sensor, as `follow` does.

    Warns
    -----
    UserWarning
        If the prefilter of a texture is a number that is not the angle of a pixel.
    """
    sensor = sensor_of(scene, sensor)
    for plugin in plugins_of(scene):
        is_texture = isinstance(plugin, mi.Texture)  # environments may be blurred on purpose
        if plugin.follows:
            plugin.follow(sensor)
        elif is_texture and plugin.angle and "x_fov" in mi.traverse(sensor):
            angle = pixel_angle(sensor)
            if not 1 / CLOSE < plugin.angle / angle < CLOSE:
                warn(
                    f"prefilter is {plugin.angle:.3g} and a pixel of the camera {angle:.3g}; "
                    "say true, and the texture follows the camera"
                )


def sensor_of(scene: mi.Scene, sensor: mi.Sensor | int) -> mi.Sensor:
    """Return a sensor, or that of a number in the scene.

    Raises
    ------
    ValueError
        If the scene has no sensor of this number.
    TypeError
        If it is neither.
    """
    if isinstance(sensor, mi.Sensor):
        return sensor
    if isinstance(sensor, bool) or not isinstance(sensor, Integral):
        raise TypeError(f"{shown(sensor)} is no sensor; give one, or its number in the scene")
    known, number = scene.sensors(), int(sensor)
    if not -len(known) <= number < len(known):
        raise ValueError(f"there is no sensor {number}; the scene has {len(known)}")
    return known[number]


def check_scene(function: str, scene: object) -> None:
    """Raise `TypeError` if the argument of a function is no scene, but its file or dictionary."""
    if mi.variant() is None or not isinstance(scene, mi.Scene):
        raise TypeError(
            f"{function}: scene is a {type(scene).__name__}; give a loaded one, by mi.load_file or "
            "mi.load_dict"
        )


def plugins_of(scene: mi.Scene) -> list[Texture]:
    """Return the textures and environments of Gaussians in a scene.

    They are not asked for their parameters, as `mitsuba.traverse` does, which they make for it.
    """
    found: dict[mi.Object, None] = {}

    class Objects(mi.TraversalCallback):
        """What walks through the objects of a scene: another one for each, as it calls itself."""

        only_objects = True

        def put(self, name: str, value: object, flags: object, kind: object = None) -> None:
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)

        def put_value(self, name: str, value: object, flags: object, kind: object) -> None:
            pass

        def put_object(self, name: str, value: mi.Object, flags: object) -> None:
            if value is not None and value not in found:
                found[value] = None
                value.traverse(Objects())

    scene.traverse(Objects())
    return [node for node in found if hasattr(node, "follow")]
