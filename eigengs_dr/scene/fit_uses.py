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
from .bitmaps import (
    GAUSSIANS,
    KEPT,
    RELIEF,
    SKY,
    SKY_KEPT,
    Parsed,
    Unsuitable,
    Use,
    read_pixels,
    texture_space,
)
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

    def texture(self, use: Use) -> mi.Texture:
        """Return the instance of a bitmap."""
        return self.parsed.state.nodes[use.parent].props[use.slot]


@dataclass(frozen=True)
class Group:
    """The uses of one image in a scene.

    Attributes
    ----------
    original : Original
    uses : list of Use
    file : Path
        Where a set that replaces the image is saved.
    tell : callable
        Is told the stages of the fit.
    """

    original: Original
    uses: list[Use]
    file: Path
    tell: Progress

    @cached_property
    def pixels(self) -> NDArray[np.float32]:
        """The image, see `eigengs_dr.scene.bitmaps.read_pixels`."""
        return read_pixels(self.original.source.state.nodes[self.uses[0].node].props)

    @property
    def textures(self) -> list[mi.Texture]:
        """The instances of the bitmaps."""
        return [self.original.texture(use) for use in self.uses]

    @property
    def wraps(self) -> list[str]:
        """Their wrap modes."""
        return [use.wrap for use in self.uses]

    def psnr_with(self, change: Callable[[mi.Properties], None]) -> float:
        """Return the lowest PSNR of a camera if only the bitmaps of these uses are changed."""
        other = self.original.source.copied()
        for use in self.uses:
            change(other.state.nodes[use.node].props)
        seen = pictures(mi.parser.instantiate(other.config, other.state), self.original.spp)
        return min(psnr(a, b) for a, b in zip(self.original.pictures, seen, strict=True))

    def psnr_with_set(self, gaussians: Gaussians) -> float:
        """Save a set; return the lowest PSNR of a camera if it replaces the bitmaps."""
        gaussians.save(self.file)
        return self.psnr_with(partial(replace_bitmap, file=str(self.file)))


def replace_bitmap(props: mi.Properties, file: str) -> None:
    """Turn the properties of a bitmap or an ``envmap`` into those of a plugin of Gaussians."""
    plugin, kept = (SKY, SKY_KEPT) if props.plugin_name() == "envmap" else (GAUSSIANS, KEPT)
    for key in list(props.keys()):
        if key not in kept:
            del props[key]
    props.set_plugin_name(plugin)
    props["filename"] = file


def fit_picture(group: Group, goal: Goal, iterations: int, share: int) -> tuple[Gaussians, float]:
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
        lost = seen - group.psnr_with_set(gaussians)
        needed = goal.psnr + 10 * math.log10(share) + lost
        return min(max(needed, goal.psnr), goal.psnr + MARGIN)

    # Raw colours are still colours; pixels in memory are usually raw.
    space = texture_space(group.pixels, group.uses[0].raw and group.pixels.shape[2] == 1)
    group.tell(0, 1, {"stage": "rays"})
    scene, textures = group.original.scene, group.textures
    seen = seen_image(scene, textures, group.pixels, space, group.wraps, "linear")
    by_renderings = None if group.original.spp == 0 else aim
    result = fit_seen(seen, goal, iterations, group.tell, by_renderings)
    result.gaussians.save(group.file)
    return result.gaussians, min(result.psnr)


def fit_relief(group: Group, goal: Goal, iterations: int) -> tuple[Gaussians, float]:
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
    relief, pixels, tell = group.uses[0].relief, group.pixels, group.tell
    if group.original.spp == 0:
        raise Unsuitable(f"{relief}: renderings decide, and none was asked for")
    is_height = relief == RELIEF["bumpmap"]
    values = (pixels @ LUMINANCE)[..., None] if is_height and pixels.shape[2] == 3 else pixels
    texture_space(values, True)  # it raises where Gaussians cannot hold them
    height, width, _ = values.shape
    tell(0, 1, {"stage": "rays"})
    seen = visibility(group.original.scene, group.textures, width, height, group.wraps)
    fitted, weight = (halved(v, seen) for v in (values, np.float32(seen.seen)[..., None]))
    if fitted.shape == values.shape and height * width <= LARGEST:
        tell(0, 1, {"stage": "trial"})
        kept = group.psnr_with(partial(_make_smooth, values))
        if kept < goal.psnr - FACETS:
            raise Unsuitable(
                f"{relief}: the renderings keep {kept:.1f} dB if they are only made smooth"
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
        kept = group.psnr_with_set(gaussians)
        if kept >= goal.psnr:
            return gaussians, kept
        group.file.unlink()
        reached.append(f"{kept:.1f} dB with {len(gaussians):,} Gaussians")
        if result.stopped == "out of reach":
            reached[-1] += ", the most that are allowed"
            break
        least = more + goal.psnr - kept
    raise Unsuitable(f"{relief}: the renderings keep {', '.join(reached)}")


def _make_smooth(values: NDArray[np.float32], props: mi.Properties) -> None:
    """Turn the properties of a bitmap into those of a smooth surface through its texels."""
    mode = SPLINES[str(props.get("wrap_mode", "repeat"))]
    finer = zoom(values, (FINER, FINER, 1), order=3, mode=mode, grid_mode=True)
    for key in ("filename", "bitmap", "data"):
        if key in props:
            del props[key]
    props["data"], props["raw"] = mi.TensorXf(finer.clip(0, 1)), True
