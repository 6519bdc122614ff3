"""Photos of a scene as a loss: which textures of the scene look like them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from os import PathLike
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from eigengs_dr.backend.doors import door
from eigengs_dr.backend.recording import freeze_rendering
from eigengs_dr.fitting.loss import Loss
from eigengs_dr.image.color import to_linear
from eigengs_dr.image.io import read_floats
from eigengs_dr.image.pictures import is_picture
from eigengs_dr.image.pixels import check_encoding

from .environment import texels_of
from .follow import check_scene, sensor_of

JUDGED = 4
"""Photos with held-out pixels, spread over all."""

JUDGE_SAMPLES = 2
"""Samples of a held-out pixel in each of two renderings, as a multiple of those of a step. The
product of the differences of two independent renderings to a photo has the squared error of their
mean as its mean, without the noise of renderings."""


@door
def photo_loss(
    scene: mi.Scene,
    pictures: str | Mapping[str, str],
    photos: Sequence[ArrayLike],
    *,
    sensors: Sequence[mi.Sensor | int] | None = None,
    integrator: mi.Integrator | None = None,
    spp: int = 4,
    held_out: float = 0.0,
    bounds: tuple[float, float] | None = (0.0, 1.0),
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
        The bitmap that is looked for, as `mitsuba.traverse` names it, such as
        ``"ball.bsdf.base_color"``; or the bitmaps of several maps by the names of the maps, which
        are those of the set. Bitmaps need ``raw: true``, and those of files of 8 bits also
        ``format: "variant"``, to hold floats. Their texels are then light or data, so the ``space``
        of a fit is by default "linear" for three channels, and "data" for one. An ``envmap`` counts
        as a bitmap, of the space "log"; its light has no `bounds`.
    photos : sequence of array_like or tensor, shape (H, W, 3), path-like or mitsuba.Bitmap
        Of the size of the film of its sensor each. Floats in arrays, lists and tensors, such as
        those of `mitsuba.render`, are linear light; whole numbers and pictures of Pillow are sRGB,
        and files and bitmaps what they say. `encoding` changes that.
    sensors : sequence of sensors or numbers, optional
        One for each photo, by default those of the scene.
    integrator : mitsuba.Integrator, optional
        By default that of the scene.
    spp : int, optional
        Samples a pixel of a step.
    held_out : float, optional
        Share of the pixels of four photos that no step sees, in [0, 1). Their error is then the
        ``loss`` of the trace, and the number of Gaussians doubles while it falls; by default there
        is one for 16 texels. It takes many photos: with few, a held-out pixel leaves a hole in the
        texture that no other photo sees, and the number that suits holes is far too small.
    bounds : (float, float), optional
        See `eigengs_dr.Loss`.
    parameters : optimiser, optional
        Of other parameters of the scene, by their names there, see `eigengs_dr.Loss`. A
        `mitsuba.ad.Adam` with the key ``"lamp.emitter.radiance.value"`` looks for a light, say.
    seed : int, optional
        Seed of the renderings and of the choice of the pixels, at least 0.
    encoding : {"srgb", "linear"}, optional
        What the pixels of all photos are, such as "srgb" for arrays of `eigengs_dr.load_image`.

    Returns
    -------
    Loss

    Raises
    ------
    ValueError
        If a name is unknown, a bitmap does not hold floats, photos and sensors do not fit
        together, or the variant is spectral or polarized.
    TypeError
        If the scene, a sensor or the integrator is none.

    Notes
    -----
    Fits of equal seeds differ: Mitsuba's threads add up the derivatives of a texel in the order in
    which they come to it. Of 64 x 64 texels, 100 Gaussians and 60 steps on noise, six fits lay up
    to 0.15 apart. With ``drjit.set_thread_count(1)`` they are equal on ``llvm``.

    Renderings of few samples are noisy. `mitsuba.render` gives the derivatives other random numbers
    than the picture, so that their product has the right mean.

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
    _check_variant()
    if not 0 <= held_out < 1:
        raise ValueError(f"photo_loss: held_out is {held_out}; it must be in [0, 1)")
    for name, value, least in (("spp", spp, 1), ("seed", seed, 0)):
        if value < least:
            raise ValueError(f"photo_loss: {name} is {value}; it must be at least {least}")
    if bounds is not None and not np.isfinite(bounds).all():
        raise ValueError(f"photo_loss: bounds are {bounds}; give finite ones, or None")
    known = mi.traverse(scene)
    keys = dict(pictures) if isinstance(pictures, Mapping) else {"": pictures}
    keys = {name: _data_of(known, key) for name, key in keys.items()}
    for key in parameters.keys() if parameters is not None else ():
        _check_known(known, key)
    chosen = _sensors_of(scene, sensors, len(photos))
    integrator = scene.integrator() if integrator is None else integrator
    if not isinstance(integrator, mi.Integrator):
        raise TypeError(
            f"photo_loss: integrator is {integrator!r}; give one by mi.load_dict({{'type': 'prb'}})"
        )
    targets = [
        _check_photo(number, photo, sensor.film().crop_size(), encoding)
        for number, (photo, sensor) in enumerate(zip(photos, chosen, strict=True))
    ]
    judged = sorted({k * len(targets) // JUDGED for k in range(JUDGED)})
    generator = np.random.default_rng(seed)
    shares = [held_out * (number in judged) for number in range(len(targets))]
    hidden = [
        mi.TensorXf(np.float32(generator.random((*target.shape[:2], 1)) < share))
        for target, share in zip(targets, shares, strict=True)
    ]
    for number, mask in enumerate(hidden):
        if shares[number] and not 0 < mask.numpy().mean() < 1:
            raise ValueError(
                f"photo_loss: held_out is {held_out:g}, which keeps no pixel of photo {number} for "
                "the judge or for the steps; a share near 0.2 does"
            )
    drawn = scene, known, keys, chosen, integrator, spp
    first = seed * STEPS_OF_A_SEED + seed // STEPS_OF_A_SEED  # 32 bits count
    taken = _Photos(*drawn, targets, hidden, judged, parameters, first)
    spaces = {name: _space_of(known, key) for name, key in keys.items()}
    space = spaces if isinstance(pictures, Mapping) else spaces[""]
    judge = taken.judge if held_out else None
    return Loss(taken.loss, bounds, parameters, judge, space=space)


@dataclass(repr=False)  # that of a scene takes hundreds of lines
class _Photos:
    """Photos of a scene, and the parts of them that no step sees.

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
    hidden : list of tensor, shape (H, W, 1)
        1 for held-out pixels, else 0.
    judged : list of int
        The photos that have some.
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
    hidden: list[mi.TensorXf]
    judged: list[int]
    parameters: Any
    first: int

    def __post_init__(self) -> None:
        self.channels = {name: self.known[key].shape[2] for name, key in self.keys.items()}
        self.add_slopes = freeze_rendering(_add_slopes)

    def loss(self, picture: Any, step: int) -> Any:
        """Return the squared error of the rendering of one photo."""
        number, texels = step % len(self.photos), self.texels(picture)
        seed = (self.first + step) % SEEDS
        if self.parameters is None and dr.grad_enabled(picture):
            return dr.custom(_Frozen, partial(self.slopes, number, seed), texels)
        self.known.update(texels)
        if self.parameters is not None:
            self.known.update(self.parameters)
        return _mean(dr.square(self.difference(number, seed, self.spp)), 1 - self.hidden[number])

    def slopes(self, number: int, seed: int, texels: dict) -> tuple[Any, dict]:
        """Return the squared error of a photo, and its derivatives by texels; replayed."""
        with dr.resume_grad():
            leaves = {key: dr.detach(t) for key, t in texels.items()}
            dr.enable_grad(leaves)
            # What the user differentiates gets nothing: Mitsuba would add to all derivatives.
            known = ((k, v) for k, v in self.known if k not in texels and dr.grad_enabled(v))
            others = {key: type(value)(value) for key, value in known}
            drawn = self.scene, self.sensors[number], self.integrator, self.spp
            seen = dr.opaque(mi.UInt32, seed), self.photos[number], 1 - self.hidden[number]
            try:
                self.known.update(leaves | {key: dr.detach(value) for key, value in others.items()})
                try:
                    value = self.add_slopes(*drawn, *seen)
                except RuntimeError:  # Dr.Jit cannot record projective integrators, say
                    self.add_slopes = _add_slopes
                    dr.clear_grad(leaves)
                    value = self.add_slopes(*drawn, *seen)
            finally:
                self.known.update(texels | others)
            return value, dr.grad(leaves)

    def judge(self, picture: Any) -> Any:
        """Return the squared error of held-out pixels, see `JUDGE_SAMPLES`."""
        self.known.update(self.texels(picture))
        samples = JUDGE_SAMPLES * self.spp
        means = [
            _mean(
                self.difference(number, self.first % SEEDS, samples)
                * self.difference(number, (self.first + 1) % SEEDS, samples),
                self.hidden[number],
            )
            for number in self.judged
        ]
        return sum(means) / len(means)

    def texels(self, picture: Any) -> dict[str, mi.TensorXf]:
        """Return the texels of each bitmap by its name in the scene."""
        named = picture if isinstance(picture, Mapping) else {"": picture}
        given = {name: p.shape[2] for name, p in named.items()}
        if given != self.channels:
            raise ValueError(
                f"photo_loss: the bitmaps have the channels {_listed(self.channels)}, the pictures "
                f"of the fit {_listed(given)}; the names and spaces of eigengs_dr.fit say them"
            )
        height, width = next(iter(named.values())).shape[:2]
        if min(height, width) < 2:  # Mitsuba takes such a bitmap once, and then no other one
            raise ValueError(
                f"photo_loss: size is {width}x{height}; Mitsuba's bitmaps have at least 2x2 texels"
            )
        return {key: texels_of(self.known, key, named[name]) for name, key in self.keys.items()}

    def difference(self, number: int, seed: int, samples: int) -> Any:
        """Return a rendering less its photo."""
        sensor, integrator = self.sensors[number], self.integrator
        shown = mi.render(self.scene, self.known, sensor, integrator, seed, spp=samples)
        return shown[..., :3] - self.photos[number]


def _add_slopes(
    scene: mi.Scene,
    sensor: mi.Sensor,
    integrator: mi.Integrator,
    spp: int,
    seed: mi.UInt32,
    photo: mi.TensorXf,
    weight: mi.TensorXf,
) -> mi.TensorXf:
    """Return the squared error of a rendering; parameters of the scene get its derivatives.

    To be frozen, so it leaves the scene as it is: Dr.Jit 1.5 replays a change of a bitmap with the
    memory of the recording, which may be gone.
    """
    shown = mi.render(scene, mi.traverse(scene), sensor, integrator, seed, spp=spp)
    error = _mean(dr.square(shown[..., :3] - photo), weight)
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


def _mean(values: Any, weight: Any) -> Any:
    """Return the mean of pixels (H, W, 3) by weights (H, W, 1)."""
    return dr.sum(values * weight, axis=None) / (3 * dr.sum(weight, axis=None))


STEPS_OF_A_SEED = 1 << 16
"""Random numbers of two seeds differ if steps are fewer."""

SEEDS = 1 << 32
"""Number of seeds of Mitsuba."""


def _check_variant() -> None:
    """Raise ValueError if texels of the current variant are no light, or have no derivatives."""
    if mi.is_spectral or mi.is_polarized or not dr.is_diff_v(mi.Float):
        raise ValueError(
            f"photo_loss: the variant {mi.variant()} has spectra, polarized light or no "
            "derivatives; load the scene in llvm_ad_rgb, cuda_ad_rgb, or one of mono"
        )


def _sensors_of(
    scene: mi.Scene, sensors: Sequence[mi.Sensor | int] | None, count: int
) -> list[mi.Sensor]:
    """Return one sensor for each photo: those that were given, or those of the scene."""
    if not count:
        raise ValueError("photo_loss: there are no photos; give one for each sensor")
    known = scene.sensors()
    if sensors is not None and len(sensors) != count:
        raise ValueError(f"photo_loss: {count} photos, but {len(sensors)} sensors")
    if sensors is None and count != len(known):
        raise ValueError(
            f"photo_loss: {count} photos, but the scene has {len(known)} sensors; give sensors=, "
            "one for each photo"
        )
    named = range(count) if sensors is None else sensors
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
    name = key if key.endswith(".data") else f"{key}.data"
    if name in known:
        if not dr.is_float_v(known[name]):
            raise ValueError(
                f"photo_loss: the bitmap {key!r} holds bytes, which have no derivative; "
                'give it <string name="format" value="variant"/>'
            )
        return name
    bitmaps = [k.removesuffix(".data") for k, _ in known if k.endswith(".data")]
    close = get_close_matches(key, bitmaps, 1) or bitmaps
    raise ValueError(
        f"photo_loss: the scene has no bitmap {key!r}; "
        + (f"it has {', '.join(close)}" if close else "it has none")
    )


def _space_of(known: mi.SceneParameters, key: str) -> str:
    """Return the space of the sums of texels: logarithms for an ``envmap``, else light or data."""
    if isinstance(known.properties[key][2], mi.Emitter):
        return "log"
    return "linear" if known[key].shape[2] == 3 else "data"


def _check_photo(number: int, photo: Any, size: Sequence[int], encoding: str | None) -> mi.TensorXf:
    """Return a photo as a tensor of linear light, of the size of its film."""
    try:
        if not isinstance(photo, str | PathLike | mi.Bitmap) and not is_picture(photo):
            photo = np.asarray(photo)  # also of Dr.Jit, of torch, or a list
            is_light = np.issubdtype(photo.dtype, np.floating)
            encoding = encoding or ("linear" if is_light else None)
        image = read_floats(photo, encoding=encoding)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"photo_loss: photo {number}: {error}") from None
    pixels = to_linear(image.pixels) if image.encoding == "srgb" else np.asarray(image.pixels)
    pixels = pixels[..., :3]
    width, height = size
    if pixels.shape != (height, width, 3):
        raise ValueError(
            f"photo_loss: photo {number} has shape {pixels.shape}, but its film has "
            f"{width}x{height} pixels; give ({height}, {width}, 3)"
        )
    if not np.isfinite(pixels).all():
        raise ValueError(f"photo_loss: photo {number} has values that are not finite")
    return mi.TensorXf(pixels)
