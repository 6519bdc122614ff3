"""Plugins that follow a sensor: footprints of its pixels, whatever its film and field of view."""

from __future__ import annotations

from numbers import Integral

import mitsuba as mi

from eigengs_dr.backend.doors import door
from eigengs_dr.backend.messages import shown, warn

from .cone import pixel_angle
from .versions import Texture

CLOSE = 1.25
"""Ratio of a prefilter to the angle of a pixel up to which nobody sees the difference."""


@door
def follow(scene: mi.Scene, sensor: mi.Sensor | int = 0) -> None:
    """Set the prefilter of all Gaussian textures and environments of a scene to a sensor's pixels.

    They follow the sensor: each rendering reads its field of view and the size of its film,
    so that a change of either changes the prefilter. A number that is written to the parameter
    ``prefilter`` of a texture ends that.

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
