"""Renderings of a scene by its cameras: in passes, with the names of their channels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.interrupts import defer_interrupts
from ..backend.recording import collector_off
from ..backend.types import Record
from ..plugins.cone import follow_where_asked

Progress = Callable[[int, int, Record], None]
"""``progress(done, total, row)``; the row names the ``stage``."""


@contextmanager
def stages(progress: Progress | None) -> Iterator[Progress]:
    """Defer Ctrl-C and SIGTERM in a block to where it tells its progress.

    Yields
    ------
    callable
        ``tell(done, total, row)`` calls `progress`. After a signal it raises `KeyboardInterrupt`.
    """
    with defer_interrupts() as interrupted:

        def tell(done: int, total: int, row: Record) -> None:
            if progress:
                progress(done, total, row)
            if interrupted():
                raise KeyboardInterrupt

        yield tell


SAMPLES_PER_PASS = 1 << 24
"""Largest number of samples in one pass. The state of a sample takes about 20 bytes; progress and
Ctrl-C wait for the end of a pass."""


class Rendering(NamedTuple):
    """What a camera sees.

    Attributes
    ----------
    pixels : ndarray of float32, shape (H, W, C)
        Linear light, and the channels of AOVs.
    channels : tuple of C str
        Their names, as in an EXR file: R, G, B and A or Y and A, then those of layers and AOVs,
        such as "direct.R" and "distance.T".
    spp : int
        Samples per pixel.
    """

    pixels: NDArray[np.float32]
    channels: tuple[str, ...]
    spp: int

    def picture(self, names: str = "RGBA") -> NDArray[np.float32]:
        """Return colours, shape (H, W, 1 to 4): those of the names, or Y for R, G and B.

        A depth is not alpha: a channel is identified by its name, not by its place.
        """
        colors = [*names] if "R" in self.channels else ["Y", *names[3:]]
        kept = [self.channels.index(name) for name in colors if name in self.channels]
        return np.ascontiguousarray(self.pixels[..., kept])


def render_in_passes(
    scene: mi.Scene,
    camera: int,
    spp: int | None,
    show: Callable[[int, int], None] = lambda *_: None,
    integrator: mi.Integrator | None = None,
    seed: int = 0,
) -> Rendering:
    """Render a scene from one of its cameras; each pass has its own seed.

    Textures whose prefilter is ``true`` follow the camera.

    Parameters
    ----------
    scene : mitsuba.Scene
    camera : int
    spp : int or None
        Samples per pixel, by default those of the camera.
    show : callable, optional
        ``show(done, total)`` after each pass, in samples per pixel.
    integrator : mitsuba.Integrator, optional
        By default that of the scene.
    seed : int, optional
        Seed of the first pass.

    Warns
    -----
    UserWarning
        If the prefilter of a texture is a number that does not fit the camera.
    """
    sensor = scene.sensors()[camera]
    follow_where_asked(scene, sensor)
    for emitter in scene.emitters():
        if hasattr(emitter, "importance"):  # of this package: Mitsuba 3.9 tells it no bounds
            emitter.set_scene(scene)
    width, height = sensor.film().crop_size()
    usual = sensor.sampler().sample_count()
    total, done = spp or usual, 0
    max_count = max(1, SAMPLES_PER_PASS // (width * height))
    pixels: NDArray[np.float64] = np.zeros(())
    try:
        while done < total:
            count = min(max_count, total - done)
            with collector_off():  # also between the lookups, whose entry points make objects
                part = mi.render(
                    scene, sensor=camera, integrator=integrator, spp=count, seed=seed + done
                )
            pixels = pixels + count * np.array(part, np.float64)
            done += count
            show(done, total)
    finally:
        sensor.sampler().set_sample_count(usual)  # integrators in C++ leave that of the last pass
    names = _channels(sensor.film(), integrator or scene.integrator(), pixels.shape[-1])
    return Rendering((pixels / total).astype(np.float32), tuple(names), total)


def _channels(film: mi.Film, integrator: mi.Integrator, count: int) -> list[str]:
    """Name the channels of a rendering.

    Mitsuba's integrator ``aov`` returns the channels of the film once for each integrator inside,
    then the AOVs; its names have four channels for each, after those of the film. The first layer
    is the picture, and has the names of the film.
    """
    names, aovs = [field.name for field in film.bitmap().struct_()], integrator.aov_names()
    if len(names) == count:
        return names
    plain = names[: len(names) - len(aovs)]
    inside = {name[:-2]: None for name in aovs if name.endswith(".A")}
    layers = [f"{layer}.{name}" for layer in inside for name in plain]
    others = [name for name in aovs if name[:-2] not in inside]
    channels = [*(plain if inside else []), *layers[len(plain) :], *others]
    return channels if len(channels) == count else [f"channel.{k}" for k in range(count)]
