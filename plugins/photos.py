"""Photos of a scene as a loss: which textures of the scene look like them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from eigengs_dr.backend.entry_points import entry_point
from eigengs_dr.backend.messages import warn
from eigengs_dr.backend.recording import freeze_rendering
from eigengs_dr.backend.types import ArrayLike
from eigengs_dr.fitting.loss import Loss
from eigengs_dr.gaussian.channels import usual_space
from eigengs_dr.image.color import to_linear
from eigengs_dr.image.io import read_photo
from eigengs_dr.image.notes import series
from eigengs_dr.image.pixels import ImageError, check_encoding, reason_of
from eigengs_dr.image.space import space_of

from .cone import check_scene, sensor_of
from .parameters import texels_of


@entry_point
def photo_loss(
    scene: mi.Scene,
    pictures: str | Mapping[str, str],
    photos: Sequence[ArrayLike | mi.Bitmap],
    *,
    sensors: Sequence[mi.Sensor | int] | None = None,
    integrator: mi.Integrator | None = None,
    spp: int = 4,
    bounds: tuple[float, float] | Literal["auto"] | None = "auto",
    parameters: Any = None,
    seed: int = 0,
    encoding: str | None = None,
) -> Loss:
    """Return the squared error of renderings against photos, for `eigengs_dr.fit`.

    A step puts the picture into the scene as texels, and renders one photo after another. Dr.Jit
    records the rendering of each camera and replays it, so a step takes less time than one of
    texels in a loop of `mitsuba.render`. With `parameters`, and with integrators that Dr.Jit cannot
    record, such as projective ones, a step traces the rendering anew.

    Parameters
    ----------
    scene : mitsuba.Scene
        Its bitmaps get the pictures, of any size; the last one stays in the scene.
    pictures : str or mapping of str to str
        The bitmap to recover, as `mitsuba.traverse` names it, such as
        ``"ball.bsdf.base_color"``; or the bitmaps of several maps by the names of the maps, which
        are those of the set. Bitmaps need ``raw: true``, and those of files of 8 bits also
        ``format: "variant"``, to hold floats. Their texels are then light or data, so the ``space``
        of a fit is by default "linear" for three channels, "normal" for a map with the name
        "normal", and "data" for one channel. An ``envmap`` counts as a bitmap, of the space "log".
    photos : sequence of array_like or tensor, shape (H, W, 3), path-like, PIL or mitsuba.Bitmap
        Of the size of the film of its sensor each; grey is replicated. Numbers of a list, an array
        or a tensor of Dr.Jit or PyTorch are linear light if they are floats, as those of
        `mitsuba.render`, and sRGB codes if they are whole; other photos are what they say.
    sensors : sequence of sensors or numbers, optional
        One for each photo, by default those of the scene.
    integrator : mitsuba.Integrator, optional
        By default that of the scene.
    spp : int, optional
        Samples per pixel of a step.
    bounds : "auto", (float, float) or None, optional
        See `eigengs_dr.Loss`; "auto" is (0, 1), and None for an ``envmap``.
    parameters : optimiser, optional
        Of other parameters of the scene, by their names there, see `eigengs_dr.Loss`. A
        `mitsuba.ad.Adam` with the key ``"lamp.emitter.radiance.value"`` looks for a light, say.
    seed : int, optional
        Seed of the renderings, at least 0. Seeds that are equal modulo 2^32 give equal renderings.
    encoding : {"srgb", "linear"}, optional
        What the numbers of all photos are, instead: "srgb" for arrays of `eigengs_dr.load_image`.

    Returns
    -------
    Loss

    Raises
    ------
    ValueError
        If a name is unknown, a bitmap holds no floats, has fewer than 2x2 texels or, in a spectral
        variant, holds colours; if photos and sensors do not fit together, a photo cannot be read,
        an argument is out of range, or bounds would hold for bitmaps and an ``envmap``. In the fit,
        if its size is below 2x2.
    TypeError
        If the scene, a sensor or the integrator is none.

    Notes
    -----
    Renderings of few samples are noisy. `mitsuba.render` gives the derivatives other random numbers
    than the picture, so that their product has the right mean.

    Equal seeds give equal renderings, but not equal bits of a fit: several threads of Dr.Jit add
    the derivatives of samples that share a texel in any order. Six fits of 60 Gaussians, 32x32
    texels and 60 steps had six results with two threads, up to 0.05 apart, and one result with
    ``drjit.set_thread_count(1)``, with which Mitsuba may wait for ever to read an EXR file.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi, numpy as np
    >>> from eigengs_dr.plugins import photo_loss
    >>> grey = {"type": "bitmap", "data": mi.TensorXf(np.full((8, 8, 3), 0.5)), "raw": True}
    >>> scene = mi.load_dict({
    ...     "type": "scene", "integrator": {"type": "direct"}, "light": {"type": "constant"},
    ...     "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 16, "height": 16,
    ...         "pixel_format": "rgb", "rfilter": {"type": "box"}},
    ...         "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])},
    ...     "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": grey}}})
    >>> photo = 1.2 * mi.render(scene, spp=64).numpy()
    >>> loss = photo_loss(scene, "wall.bsdf.reflectance", [photo])
    >>> result = eg.fit(loss=loss, size=(32, 32), gaussians=20, iterations=40)
    """
    check_scene("photo_loss", scene)
    check_encoding(encoding)
    for name, number, least in (("spp", spp, 1), ("seed", seed, 0)):
        if number < least:
            raise ValueError(f"photo_loss: {name} is {number}; it must be at least {least}")
    if isinstance(photos, (str, os.PathLike)):
        raise TypeError(f"photo_loss: photos is {photos!r}; give a list, one for each sensor")
    known = mi.traverse(scene)
    keys = dict(pictures) if isinstance(pictures, Mapping) else {"": pictures}
    keys = {name: _data_of(known, key) for name, key in keys.items()}
    chosen = _sensors_of(scene, sensors, len(photos))
    integrator = scene.integrator() if integrator is None else integrator
    if not isinstance(integrator, mi.Integrator):  # None if the scene has none
        raise TypeError(
            f"photo_loss: integrator is {integrator!r}; give a loaded one, such as "
            "mi.load_dict({'type': 'prb'})"
        )
    with series():
        targets = [
            _check_photo(number, photo, sensor.film().crop_size(), encoding)
            for number, (photo, sensor) in enumerate(zip(photos, chosen, strict=True))
        ]
    drawn = scene, known, keys, chosen, integrator, spp
    taken = _Photos(*drawn, targets, parameters, _first_of(seed))
    spaces = {name: _space_for(known, name, key) for name, key in keys.items()}
    space = spaces if isinstance(pictures, Mapping) else spaces[""]
    bounds = _bounds_for({*spaces.values()}) if bounds == "auto" else bounds
    pixels = sum(target.shape[0] * target.shape[1] for target in targets)
    loss = Loss(taken.loss, bounds, parameters, space=space, pixels=pixels)
    for key in parameters.keys() if parameters is not None else ():
        _check_known(known, key)
    return loss


@dataclass(repr=False)  # that of a scene takes hundreds of lines
class _Photos:
    """Photos of a scene.

    Attributes
    ----------
    scene : mitsuba.Scene
    known : mitsuba.SceneParameters
    keys : dict of str to str
        The names of the texels in the scene, by the names of the maps.
    sensors : list of mitsuba.Sensor
    integrator : mitsuba.Integrator
    spp : int
    photos : list of tensor, shape (H, W, 3)
    parameters : optimiser, or None
    first : int
        Seed of the first rendering.
    """

    scene: mi.Scene
    known: mi.SceneParameters
    keys: dict[str, str]
    sensors: list[mi.Sensor]
    integrator: mi.Integrator
    spp: int
    photos: list[mi.TensorXf]
    parameters: Any
    first: int

    def __post_init__(self) -> None:
        self.channels = {name: self.known[key].shape[2] for name, key in self.keys.items()}
        self.add_slopes = freeze_rendering(_add_slopes)
        # A recording holds for the state of all films of the scene, which their first use changes.
        with dr.suspend_grad():
            for sensor in self.sensors if self.parameters is None else ():
                dr.eval(mi.render(self.scene, None, sensor, self.integrator, spp=self.spp))

    def loss(self, picture: Any, step: int) -> Any:
        """Return the squared error of the rendering of one photo."""
        number, texels = step % len(self.photos), self.texels(picture)
        seed = (self.first + step) % SEEDS
        if self.parameters is None and dr.grad_enabled(picture):
            return dr.custom(_Frozen, partial(self.slopes, number, seed), texels)
        self.show(texels)
        sensor, integrator = self.sensors[number], self.integrator
        shown = mi.render(self.scene, self.known, sensor, integrator, seed, spp=self.spp)
        return _squared_error(shown, self.photos[number])

    def show(self, texels: dict) -> None:
        """Put texels and the parameters of the user into the scene."""
        self.known.update(texels)
        if self.parameters is not None:
            self.known.update(self.parameters)

    def slopes(self, number: int, seed: int, texels: dict) -> tuple[Any, dict]:
        """Return the squared error of a photo, and its derivatives by texels; replayed."""
        with dr.resume_grad():
            leaves = {key: dr.detach(t) for key, t in texels.items()}
            dr.enable_grad(leaves)
            # What the user differentiates gets nothing: Mitsuba would add to all derivatives.
            known = ((k, v) for k, v in self.known if k not in texels and dr.grad_enabled(v))
            others = {key: type(value)(value) for key, value in known}
            drawn = self.scene, self.sensors[number], self.integrator, self.spp
            seen = dr.opaque(mi.UInt32, seed), self.photos[number]
            try:
                self.known.update(leaves | {key: dr.detach(value) for key, value in others.items()})
                try:
                    value = self.add_slopes(*drawn, *seen)
                except RuntimeError as error:
                    self._give_up_recording(error)
                    dr.clear_grad(leaves)
                    value = _add_slopes(*drawn, *seen)  # a lasting error is raised here
            finally:
                self.known.update(texels | others)
            return value, dr.grad(leaves)

    def _give_up_recording(self, error: RuntimeError) -> None:
        """Record no more if Dr.Jit cannot, as for projective integrators; else say the error."""
        cause: BaseException = error
        while cause.__cause__:  # the contexts of Dr.Jit's errors form a ring
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):  # Dr.Jit wraps it
            raise cause
        if "supported inside of frozen functions" in str(cause):
            self.add_slopes = _add_slopes
        else:
            warn(f"photo_loss: a recording failed, its step renders anew: {reason_of(cause)}")

    def texels(self, picture: Any) -> dict[str, mi.TensorXf]:
        """Return the texels of each bitmap by its name in the scene."""
        named = picture if isinstance(picture, Mapping) else {"": picture}
        given = {name: p.shape[2] for name, p in named.items()}
        if given != self.channels:
            raise ValueError(
                f"photo_loss: the bitmaps have the channels {_listed(self.channels)}, the pictures "
                f"of the fit {_listed(given)}; the names and spaces of eigengs_dr.fit say them"
            )
        height, width, _ = next(iter(named.values())).shape
        if min(height, width) < LEAST:  # Mitsuba would take it once, and then no other one
            raise ValueError(
                f"photo_loss: the size of the fit is {width}x{height}; a bitmap of Mitsuba has at "
                f"least {LEAST}x{LEAST} texels"
            )
        return {key: texels_of(self.known, key, named[name]) for name, key in self.keys.items()}


def _add_slopes(
    scene: mi.Scene,
    sensor: mi.Sensor,
    integrator: mi.Integrator,
    spp: int,
    seed: mi.UInt32,
    photo: mi.TensorXf,
) -> mi.TensorXf:
    """Return the squared error of a rendering; parameters of the scene get its derivatives.

    To be frozen, so it leaves the scene as it is: Dr.Jit 1.5 replays a change of a bitmap with the
    memory of the recording, which may be gone.
    """
    shown = mi.render(scene, mi.traverse(scene), sensor, integrator, seed, spp=spp)
    error = _squared_error(shown, photo)
    dr.backward(error)
    return dr.detach(error)


class _Frozen(dr.CustomOp):
    """A number of some arrays that comes with its derivatives."""

    def eval(self, function: Callable, arrays: dict) -> Any:
        value, self.slopes = function(arrays)
        return value

    def forward(self) -> None:
        rates = self.grad_in("arrays")
        self.set_grad_out(
            sum(dr.sum(slope * rates[key], axis=None) for key, slope in self.slopes.items())
        )

    def backward(self) -> None:
        rate = self.grad_out()
        self.set_grad_in("arrays", {key: slope * rate for key, slope in self.slopes.items()})


def _squared_error(shown: Any, photo: mi.TensorXf) -> Any:
    """Return the mean squared difference of a rendering, whose colours come first, to a photo."""
    return dr.mean(dr.square(shown[..., :3] - photo), axis=None)


SEEDS = 1 << 32
"""Number of seeds of renderings; the next one is the first again."""

LEAST = 2
"""Texels of a side from which on Mitsuba takes other bitmaps in place of one."""


def _first_of(seed: int) -> int:
    """Return the seed of the first rendering: those of 65,536 steps differ from seed to seed."""
    low, high = seed % (1 << 16), seed // (1 << 16)
    return (low << 16) + high % (1 << 16)


def _sensors_of(
    scene: mi.Scene, sensors: Sequence[mi.Sensor | int] | None, count: int
) -> list[mi.Sensor]:
    """Return one sensor for each photo: those that were given, or those of the scene."""
    if not count:
        raise ValueError("photo_loss: there are no photos; give one for each sensor")
    known = scene.sensors()
    if sensors is None and count != len(known):
        raise ValueError(
            f"photo_loss: {count} photos, but the scene has {len(known)} sensors; give sensors=, "
            "one for each photo"
        )
    named = known if sensors is None else sensors
    if not hasattr(named, "__len__"):
        raise TypeError(f"photo_loss: sensors is {named!r}; give a list, one for each photo")
    if len(named) != count:
        raise ValueError(f"photo_loss: {count} photos, but {len(named)} sensors")
    return [sensor_of(scene, sensor) for sensor in named]


def _listed(channels: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {number}".strip() for name, number in channels.items())


def _check_known(known: mi.SceneParameters, key: str) -> None:
    """Raise ValueError if a scene has no parameter of this name."""
    if key not in known:
        close = get_close_matches(key, [name for name, _ in known], 1)
        advice = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"photo_loss: the scene has no parameter {key!r}{advice}")


def _data_of(known: mi.SceneParameters, key: str) -> str:
    """Return the name of the texels of a bitmap among the parameters of a scene."""
    if not isinstance(key, str):
        raise TypeError(f"photo_loss: pictures name {key!r}; give the name of a bitmap")
    name = key if key.endswith(".data") else f"{key}.data"
    if name in known:
        if not dr.is_float_v(known[name]):
            raise ValueError(
                f"photo_loss: the bitmap {key!r} holds bytes, which have no derivative; "
                'give it <string name="format" value="variant"/>'
            )
        height, width, channels = known[name].shape
        if mi.is_spectral and channels > 1:
            raise ValueError(
                f"photo_loss: the bitmap {key!r} holds coefficients of spectra in {mi.variant()}; "
                "load the scene in a variant of RGB, such as llvm_ad_rgb"
            )
        if min(height, width) < LEAST:
            raise ValueError(
                f"photo_loss: the bitmap {key!r} has {width}x{height} texels, and Mitsuba takes no "
                f"others in their place; give it {LEAST}x{LEAST} or more"
            )
        return name
    bitmaps = [k.removesuffix(".data") for k, _ in known if k.endswith(".data")]
    close = get_close_matches(key, bitmaps, 1) or bitmaps
    raise ValueError(
        f"photo_loss: the scene has no bitmap {key!r}; "
        + (f"it has {', '.join(close)}" if close else "it has none")
    )


def _space_for(known: mi.SceneParameters, name: str, key: str) -> str:
    """Return the space of a map: logarithms for an ``envmap``, normals by name, light or data."""
    if isinstance(known.properties[key][2], mi.Emitter):
        return "log"
    if known[key].shape[2] != 3:
        return "data"
    return "normal" if usual_space(name) == "normal" else "linear"


def _bounds_for(spaces: set[str]) -> tuple[float, float] | None:
    """Return the bounds of maps of some spaces: those of textures, and none for an ``envmap``."""
    bounded = {space_of(space).bounded for space in spaces}
    if len(bounded) > 1:
        raise ValueError(
            "photo_loss: bounds hold for all maps, and light of an envmap has none; give "
            "bounds=None, or recover them one after another"
        )
    return (0.0, 1.0) if bounded == {True} else None


def _check_photo(number: int, photo: Any, size: Sequence[int], encoding: str | None) -> mi.TensorXf:
    """Return a photo as a tensor of linear light, of the size of its film."""
    is_file = isinstance(photo, (str, os.PathLike))
    name = f"photo {number} ({os.fspath(photo)})" if is_file else f"photo {number}"
    try:
        image = read_photo(photo, encoding)
    except (ValueError, OSError, TypeError, RuntimeError) as error:  # PyTorch: the last two
        reason = reason_of(error).removeprefix("image: ").removeprefix(f"{photo}: ")
        raise ImageError(f"photo_loss: {name}: {reason}") from error
    pixels = to_linear(image.pixels) if image.encoding == "srgb" else image.pixels
    width, height = size
    if pixels.shape != (height, width, 3):
        raise ImageError(
            f"photo_loss: {name} has shape {pixels.shape}, but its film has "
            f"{width}x{height} pixels; give ({height}, {width}, 3)"
        )
    return mi.TensorXf(pixels)
