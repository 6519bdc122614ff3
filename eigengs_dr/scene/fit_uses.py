"""Gaussians for the uses of an image in a scene: pictures as cameras see them, and heights.

Cameras see the slopes of a bump map, not its heights, and bitmaps have facets where Gaussians are
smooth. So heights are fitted texel by texel, more closely than renderings need, and the renderings
decide.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..fitting.fit import fit
from ..gaussian.gaussians import Gaussians
from ..image.metrics import psnr
from ..plugins.versions import Properties
from .bitmaps import GAUSSIANS, KEPT, SKY, SKY_KEPT, Parsed, Unsuitable, Use, space_of
from .fit_scene import fit_for_scene, halved
from .rendering import pictures
from .visibility import visibility

CLOSER = (10.0, 15.0, 20.0)
"""PSNR of the heights above that required of the renderings, in dB, tried in turn. Heights of waves
and of smooth noise, 128 x 128 texels on 48 x 48 pixels, kept 41 and 43 dB between the renderings
where they had 49 and 63 dB themselves, and those of tiles 34 where they had 57: the slopes of a
bitmap jump at its texels."""

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

    def psnr_with(self, file: Path, uses: list[Use]) -> float:
        """Return the lowest PSNR of a camera if only this set replaces its bitmap."""
        other = self.source.copied()
        for use in uses:
            replace_bitmap(other.state.nodes[use.node].props, str(file))
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
    target_psnr: float,
    iterations: int,
) -> tuple[Gaussians, float]:
    """Fit an image for its uses.

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
    use = group[0]
    # Raw colours are still colours; pixels in memory are usually raw.
    plugin = original.parsed.state.nodes[use.parent].props.plugin_name()
    is_data = pixels.shape[2] == 1 or plugin == "normalmap"
    result = fit_for_scene(
        original.scene,
        original.textures(group),
        pixels,
        target_psnr,
        space_of(pixels, use.raw and is_data),
        iterations=iterations,
        wrap_mode=[use.wrap for use in group],
        encoding="linear",
    )
    return result.gaussians, min(result.psnr)


def fit_heights(
    original: Original,
    group: list[Use],
    pixels: NDArray[np.float32],
    target_psnr: float,
    iterations: int,
    file: Path,
) -> tuple[Gaussians, float]:
    """Fit the heights of bump maps, and save the set.

    Returns
    -------
    gaussians : Gaussians
        Of one channel.
    psnr : float
        Lowest PSNR in dB between the renderings of a camera.

    Raises
    ------
    Unsuitable
        If no set keeps the PSNR between the renderings, or nothing is to be rendered.
    """
    if original.spp == 0:
        raise Unsuitable("heights of a bump map: renderings decide, and none was asked for")
    heights = pixels if pixels.shape[2] == 1 else (pixels @ LUMINANCE)[..., None]
    space_of(heights, True)  # it raises where Gaussians cannot hold them
    height, width, _ = heights.shape
    wraps = [use.wrap for use in group]
    seen = visibility(original.scene, original.textures(group), width, height, wraps)
    heights, weight = (halved(v, seen) for v in (heights, np.float32(seen.seen)[..., None]))
    reached = list[str]()
    for more in CLOSER:
        result = fit(
            heights,
            target_psnr=min(target_psnr + more, 99.0),
            iterations=iterations,
            space="data",
            weight=weight[..., 0],
            progress=False,
        )
        gaussians = result.gaussians.scaled(width, height)
        gaussians.save(file)
        kept = original.psnr_with(file, group)
        if kept >= target_psnr:
            return gaussians, kept
        file.unlink()
        reached.append(f"{kept:.1f} dB with {len(gaussians):,} Gaussians")
    raise Unsuitable(f"heights of a bump map: the renderings keep {', '.join(reached)}")
