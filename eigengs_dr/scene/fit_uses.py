"""Gaussians for the uses of an image in a scene: pictures as cameras see them, and relief.

Cameras see the slopes of a bump map and the light on a normal map, not their values, and bitmaps
have facets where Gaussians are smooth. So values are fitted texel by texel, more closely than
renderings need, and the renderings decide.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from ..fitting.fit import fit
from ..fitting.options import Goal
from ..gaussian.gaussians import Gaussians
from ..image.metrics import psnr
from ..image.space import DATA
from ..plugins.versions import Properties
from .bitmaps import GAUSSIANS, KEPT, RELIEF, SKY, SKY_KEPT, Parsed, Unsuitable, Use, texture_space
from .fit_scene import FINER, fit_seen, halved, seen_image
from .rendering import Progress, pictures
from .target import MARGIN
from .visibility import visibility

CLOSER = (5.0, 10.0, 15.0, 20.0)
"""PSNR of heights and normals above that required of the renderings, in dB, tried in turn, but for
those that add less than what was missing. Heights of waves and of smooth noise, 128 x 128 texels on
48 x 48 pixels, kept 41 and 43 dB between the renderings where they had 49 and 63 dB themselves."""

FACETS = 1.0
"""Decibels by which renderings of a smooth surface through all texels may miss the goal before a
fit: those of tiles kept 34 dB, since the slopes of a bitmap jump at its texels, and no set of the
tiles kept more."""

LARGEST = 1 << 20
"""Most texels of a bitmap of which a smooth surface is made."""

SPLINES = {"repeat": "grid-wrap", "mirror": "reflect", "clamp": "nearest"}
"""How SciPy continues an image, by the wrap mode of a bitmap."""

NUMBERED = re.compile(r"object_\d+")
"""Name that Mitsuba gives to objects without an id."""

LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)
"""Weights of the colour channels in a height, as in Mitsuba."""


@dataclass
class Original:
    """A scene before its textures are replaced.

    Attributes
    ----------
    source : Parsed
    spp : int or None
        Samples per pixel of renderings, by default those of the cameras.
    parsed : Parsed
        A copy of it, whose references to textures are their instances.
    scene : mitsuba.Scene
    """

    source: Parsed
    spp: int | None
    parsed: Parsed = field(init=False)
    scene: mi.Scene = field(init=False)

    def __post_init__(self) -> None:
        self.parsed = self.source.copied()
        self.scene = mi.parser.instantiate(self.parsed.config, self.parsed.state)

    @cached_property
    def pictures(self) -> list[NDArray[np.float32]]:
        """What each camera sees, in sRGB."""
        return pictures(self.scene, self.spp)

    @cached_property
    def keys(self) -> dict[mi.Object, str]:
        """The names of objects in `mitsuba.traverse`.

        Under shapes without an id there are none: Mitsuba numbers them anew at each loading.
        """
        owners = {
            key.rpartition(".")[0]: owner
            for key, (_, _, owner, _) in mi.traverse(self.scene).properties.items()
        }
        return {owner: key for key, owner in owners.items() if not NUMBERED.match(key)}

    def key_of(self, node: int, slot: str) -> str | None:
        """Return the name of an object in `mitsuba.traverse`, see `keys`."""
        return self.keys.get(self.parsed.state.nodes[node].props[slot])

    def textures(self, uses: list[Use]) -> list[mi.Texture]:
        """Return the instances of bitmaps."""
        return [self.parsed.state.nodes[use.parent].props[use.slot] for use in uses]

    def psnr_with(self, change: Callable[[Properties], None], uses: list[Use]) -> float:
        """Return the lowest PSNR of a camera if only the bitmaps of some uses are changed."""
        other = self.source.copied()
        for use in uses:
            change(other.state.nodes[use.node].props)
        seen = pictures(mi.parser.instantiate(other.config, other.state), self.spp)
        return min(psnr(a, b) for a, b in zip(self.pictures, seen, strict=True))


def replace_bitmap(props: Properties, file: str) -> None:
    """Turn the properties of a bitmap or an ``envmap`` into those of a plugin of Gaussians."""
    plugin, kept = (SKY, SKY_KEPT) if props.plugin_name() == "envmap" else (GAUSSIANS, KEPT)
    for key in list(props.keys()):
        if key not in kept:
            del props[key]
    props.set_plugin_name(plugin)
    props["filename"] = file


def fit_picture(
    original: Original,
    group: list[Use],
    pixels: NDArray[np.float32],
    goal: Goal,
    iterations: int,
    file: Path,
    tell: Progress,
    share: int = 1,
) -> tuple[Gaussians, float]:
    """Fit an image for its uses, and save the set.

    Cameras see it at the PSNR in even light. Lamps may amplify what is dark, and one of several
    images may leave a part of the errors alone, so a first set is rendered in place of the bitmap.

    Returns
    -------
    gaussians : Gaussians
    psnr : float
        Lowest PSNR in dB with which a camera sees the image.

    Raises
    ------
    Unsuitable
        If it must stay a bitmap.
    """

    def aim(gaussians: Gaussians, seen: float) -> float:
        gaussians.save(file)
        lost = seen - original.psnr_with(partial(replace_bitmap, file=str(file)), group)
        needed = goal.psnr + 10 * math.log10(share) + lost
        return min(max(needed, goal.psnr), goal.psnr + MARGIN)

    # Raw colours are still colours; pixels in memory are usually raw.
    space = texture_space(pixels, group[0].raw and pixels.shape[2] == 1)
    tell(0, 1, {"stage": "rays"})
    textures, wraps = original.textures(group), [use.wrap for use in group]
    seen = seen_image(original.scene, textures, pixels, space, wraps, "linear")
    result = fit_seen(seen, goal, iterations, tell, None if original.spp == 0 else aim)
    result.gaussians.save(file)
    return result.gaussians, min(result.psnr)


def fit_relief(
    original: Original,
    group: list[Use],
    pixels: NDArray[np.float32],
    goal: Goal,
    iterations: int,
    file: Path,
    tell: Progress,
) -> tuple[Gaussians, float]:
    """Fit the heights of bump maps or the vectors of normal maps, and save the set.

    Returns
    -------
    gaussians : Gaussians
        Of one channel, or of three.
    psnr : float
        Lowest PSNR in dB between the renderings of a camera.

    Raises
    ------
    Unsuitable
        If no set keeps the PSNR between the renderings, or nothing is to be rendered.
    """
    use = group[0]
    if original.spp == 0:
        raise Unsuitable(f"{use.relief}: renderings decide, and none was asked for")
    is_height = use.relief == RELIEF["bumpmap"]
    values = (pixels @ LUMINANCE)[..., None] if is_height and pixels.shape[2] == 3 else pixels
    texture_space(values, True)  # it raises where Gaussians cannot hold them
    height, width, _ = values.shape
    wraps = [use.wrap for use in group]
    tell(0, 1, {"stage": "rays"})
    seen = visibility(original.scene, original.textures(group), width, height, wraps)
    fitted, weight = (halved(v, seen) for v in (values, np.float32(seen.seen)[..., None]))
    if fitted.shape == values.shape and height * width <= LARGEST:
        tell(0, 1, {"stage": "trial"})
        kept = original.psnr_with(partial(_make_smooth, values), group)
        if kept < goal.psnr - FACETS:
            raise Unsuitable(
                f"{use.relief}: the renderings keep {kept:.1f} dB if they are only made smooth"
            )
    reached, least = list[str](), 0.0
    for more in CLOSER:
        if more < least:
            continue
        result = fit(
            fitted,
            target_psnr=replace(goal, psnr=min(goal.psnr + more, 99.0)),
            iterations=iterations,
            space=DATA,
            weight=weight[..., 0],
            progress=lambda step, steps, row: tell(step, steps, row | {"stage": "search"}),
        )
        gaussians = result.gaussians.scaled(width, height)
        gaussians.save(file)
        kept = original.psnr_with(partial(replace_bitmap, file=str(file)), group)
        if kept >= goal.psnr:
            return gaussians, kept
        file.unlink()
        reached.append(f"{kept:.1f} dB with {len(gaussians):,} Gaussians")
        if result.stopped == "out of reach":
            reached[-1] += ", the most that are allowed"
            break
        least = more + goal.psnr - kept
    raise Unsuitable(f"{use.relief}: the renderings keep {', '.join(reached)}")


def _make_smooth(values: NDArray[np.float32], props: Properties) -> None:
    """Turn the properties of a bitmap into those of a smooth surface through its texels."""
    mode = SPLINES[str(props.get("wrap_mode", "repeat"))]
    finer = zoom(values, (FINER, FINER, 1), order=3, mode=mode, grid_mode=True)
    for key in ("filename", "bitmap", "data"):
        if key in props:
            del props[key]
    props["data"], props["raw"] = mi.TensorXf(finer.clip(0, 1)), True
