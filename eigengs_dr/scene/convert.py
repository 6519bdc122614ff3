"""The function `convert_scene`, which replaces the bitmaps of a scene by Gaussians."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.doors import door, shows_progress
from ..backend.interrupts import Interrupted
from ..backend.messages import warn
from ..backend.types import PathLike, Record
from ..fitting.options import Goal
from ..gaussian.file import CUTOFF
from ..gaussian.gaussians import FIELDS, Gaussians
from ..image.io import ImageError
from ..image.metrics import psnr
from ..plugins import resident_bytes
from ..plugins.properties import check_rotation, source_of, to_uv
from ..storage.atomic import atomic_folder, lock_output, refuse_url, remove_stale
from .bitmaps import (
    GAUSSIANS,
    SKY,
    Parsed,
    Unsuitable,
    Use,
    file_keys,
    is_bitmap,
    label,
    parse,
    read_pixels,
    references,
    uses_of,
)
from .fit_environment import BYTES, fit_environment
from .fit_scene import check_asked
from .fit_uses import Group, Original, fit_picture, fit_relief, replace_bitmap
from .rendering import Progress, compare, pictures, stages

SCENE = "scene.xml"
"""Name of the new scene in its folder."""

NEGLIGIBLE = 1 << 14
"""Bytes that are not worth saving: the smallest images take less."""

MOST_OVERLAP = 32.0
"""Mean number of Gaussians at a point from which on the bitmap is better: a lookup then takes eight
times as long as in a bitmap (4 times with the 15 of a usual fit, 15 with 96; llvm, CPU time). Time
itself would decide otherwise on a busy machine. Lookups are a small part of a rendering: the
picture of a coated ball takes 1.1 times as long where they take two to three times as long."""

NO_SHAPE = "no shape outside of groups has it, so that no camera sees it directly"


class ConvertedTexture(NamedTuple):
    """An image as bitmaps and as Gaussians.

    Attributes
    ----------
    names : tuple of str
        Its uses: the file, and in brackets its name in `mitsuba.traverse`; under a shape without an
        id, which has none that lasts, the plugin and the slot.
    file : str
        The new file, relative to the folder; "" if the bitmap stayed.
    width, height, channels : int
    bytes : int
        Memory of its bitmaps in the scene, see `eigengs_dr.plugins.resident_bytes`.
    gaussians : int
    gaussian_bytes : int
        Memory of the textures of Gaussians in the scene. Those of one wrap mode share it.
    overlap : float
        Mean number of Gaussians at a point of the image: what a lookup sums.
    psnr : float
        Lowest PSNR in dB with which a camera sees it, see `eigengs_dr.fit_for_scene`; of a bump
        or normal map, lowest PSNR between the renderings with and without this set alone; of an
        environment map, the lower PSNR of its picture and of the light that it gives to surfaces.
    """

    names: tuple[str, ...]
    file: str
    width: int
    height: int
    channels: int
    bytes: int
    gaussians: int
    gaussian_bytes: int
    overlap: float
    psnr: float


class ConvertedScene(NamedTuple):
    """Result of `eigengs_dr.convert_scene`.

    Attributes
    ----------
    scene : Path
        The new XML file. Beside it are the sets of Gaussians, and for each camera the pictures
        before-1.png, after-1.png and difference-1.png, 8 times louder.
    textures : list of ConvertedTexture
        Bitmaps that became Gaussians.
    better : list of ConvertedTexture
        Bitmaps that stayed, since they take less memory than Gaussians, or many overlap.
    left : list of (str, str)
        What else stayed, and why.
    psnr : list of float
        psnr_rgb in dB between the renderings of each camera; both have the same random numbers.
    noise : list of float
        psnr_rgb between two renderings of the original scene with different random numbers. Empty
        if its environment map stays, since only a new one is sampled differently.
    """

    scene: Path
    textures: list[ConvertedTexture]
    better: list[ConvertedTexture]
    left: list[tuple[str, str]]
    psnr: list[float]
    noise: list[float]

    def missed(self, target_psnr: float) -> list[int]:
        """Return the cameras, from 1, whose renderings differ by more than a goal and noise."""
        noise = self.noise or [math.inf] * len(self.psnr)
        goals = [min(target_psnr, n - NOISE) for n in noise]
        return [
            k for k, pair in enumerate(zip(self.psnr, goals, strict=True), 1) if pair[0] < pair[1]
        ]


NOISE = 0.5
"""Decibels by which renderings with other random numbers may vary."""


@shows_progress
@door
def convert_scene(
    scene: PathLike | Record,
    output: str | os.PathLike[str],
    target_psnr: float = 40.0,
    iterations: int = 400,
    spp: int | None = None,
    parameters: Mapping[str, str] | None = None,
    replace_all: bool = False,
    progress: Any = None,
) -> ConvertedScene:
    """Replace the bitmaps of a scene by as many Gaussians as its cameras resolve.

    Uses of one image share a set. A bitmap that takes less memory than its Gaussians, or where many
    of them overlap, is better and stays. The function leaves alone what Gaussians would spoil or
    cannot replace: bump and normal maps with which the renderings would miss the PSNR, images of
    two values such as masks, data beyond 0 and 1, and images of no shape or that no camera sees.

    Parameters
    ----------
    scene : path-like or dict
        XML file, or dictionary as for `mitsuba.load_dict`, with meshes in files.
    output : path-like
        Folder to write; it must not exist, or be empty. It is written as a whole, or not at all.
    target_psnr : float, optional
        Lowest PSNR in dB with which a camera sees a texture, see `eigengs_dr.fit_for_scene`, and
        the goal of the renderings: where they need more, a texture gets up to 6 dB more.
    iterations : int, optional
        Steps of refinement for each number of Gaussians.
    spp : int, optional
        Samples per pixel of the renderings, by default those of the scene; 0 renders nothing.
    parameters : mapping of str to str, optional
        Values for the defaults of an XML file.
    replace_all : bool, optional
        Whether to replace better bitmaps too: Gaussians are differentiable, and have no texels.
    progress : bool or callable, optional
        By default a bar, in a terminal or a notebook, after two seconds; False shows none.
        A function is called as ``progress(done, total, row)``; the ``stage`` of the row is "scene",
        "rays", "target", "trial", "search" or "renderings". In the stages of an image the row also
        has the ``image``, such as "1/3 photo.png", and a search adds the last row of its trace. The
        function may raise `KeyboardInterrupt` to end the call.

    Returns
    -------
    ConvertedScene

    Raises
    ------
    ValueError
        If no variant of Mitsuba is set, an argument is out of range, the folder has files in it, or
        the scene cannot be written as XML.
    TypeError
        If the scene is loaded already.
    RuntimeError
        Mitsuba's error, if the scene does not parse.
    OSError
        If the folder cannot be written.
    Interrupted
        After Ctrl-C, SIGTERM, or a `KeyboardInterrupt` of `progress`; its ``result`` is a
        ConvertedScene with the images that were decided. Nothing is written.

    Warns
    -----
    UserWarning
        If a rendering after the conversion misses `target_psnr` against the one before.

    Examples
    --------
    After ``mi.set_variant("llvm_ad_rgb")``::

        result = eg.convert_scene("room.xml", "room-gaussians/", target_psnr=40)
        image = mi.render(mi.load_file(str(result.scene)))
    """
    if not mi.variant():
        raise ValueError("no variant is set; call mi.set_variant('llvm_ad_rgb') first")
    if isinstance(scene, mi.Scene):
        raise TypeError("convert_scene: scene is loaded; give its XML file or its dictionary")
    check_asked(target_psnr, iterations)
    if parameters and isinstance(scene, Mapping):
        raise ValueError("parameters are those of an XML file, and the scene is a dictionary")
    if spp is not None and spp < 0:
        raise ValueError(f"spp is {spp}; it must be at least 0")
    refuse_url(output)
    target = Path(os.path.realpath(output))  # of a link, the folder that it names
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ValueError(f"{output}: exists and is not empty; choose another folder")
    settings = Settings(target_psnr, iterations, spp, replace_all)
    result = ConvertedScene(Path(output) / SCENE, [], [], [], [], [])
    with lock_output(output), stages(progress) as tell:
        remove_stale(target.parent)
        try:
            with atomic_folder(output) as work:
                _convert_into(work, target, parse(scene, parameters), settings, result, tell)
        except KeyboardInterrupt:
            raise Interrupted(
                result, "the conversion was interrupted, and nothing is written; .result holds "
                "the images that were decided"
            ) from None  # fmt: skip
    for camera in result.missed(target_psnr):
        warn(
            f"{output}: camera {camera} sees psnr_rgb {result.psnr[camera - 1]:.1f} dB between the "
            f"renderings, below the goal of {target_psnr:g}; look at difference-{camera}.png"
        )
    return result


class Settings(NamedTuple):
    """Arguments of `convert_scene`."""

    target_psnr: float
    iterations: int
    spp: int | None
    replace_all: bool


def _convert_into(
    work: Path,
    target: Path,
    parsed: Parsed,
    settings: Settings,
    result: ConvertedScene,
    tell: Progress,
) -> None:
    """Write a scene and its files into a folder that becomes the target, and fill in the result."""
    tell(0, 1, {"stage": "scene"})
    original = Original(parsed, settings.spp)
    uses, left = uses_of(parsed, original.key_of)
    result.left.extend(left)
    replacements = dict[int, str]()
    groups: dict[tuple[str, bool, str], list[Use]] = {}
    on_shapes = [mi.traverse(shape).hierarchy for shape in original.scene.shapes()]
    for use in uses:
        if any(original.texture(use) in hierarchy for hierarchy in on_shapes):
            groups.setdefault((use.file, use.raw, use.relief), []).append(use)
        else:
            result.left.append((use.name, NO_SHAPE))
    plugins = [node.props.plugin_name() for node in parsed.state.nodes]
    sky = plugins.index("envmap") if "envmap" in plugins else None  # a scene has at most one
    total = len(groups) + (sky is not None)

    def add(outcome: ConvertedTexture | str, nodes: dict[int, str]) -> None:
        """Record the outcome for an image, with the names of its nodes."""
        if isinstance(outcome, str):
            result.left.extend((name, outcome) for name in nodes.values())
        elif not outcome.file:
            result.better.append(outcome)
        else:
            result.textures.append(outcome)
            replacements.update(dict.fromkeys(nodes, outcome.file))

    def told_of(number: int, name: str) -> Progress:
        """Return what tells the stages of one of the images."""
        image = {"image": f"{number}/{total} {name}"}
        return lambda done, steps, row: tell(done, steps, row | image)

    for number, group in enumerate(groups.values(), 1):
        used = {texture.file for texture in result.textures}
        file = work / _file_name(group[0].file, group[0].raw, used)
        told = told_of(number, Path(group[0].file).name)
        outcome = _convert(Group(original, group, file, told), settings, len(groups))
        add(outcome, {use.node: use.name for use in group})
    if sky is not None:
        props = parsed.state.nodes[sky].props
        name = label(props, original.keys.get(original.scene.environment(), "environment"))
        path = str(props["filename"]) if "filename" in props else "sky"
        file = work / _file_name(path, False, {texture.file for texture in result.textures})
        told = told_of(total, Path(path).name)
        add(_convert_sky(original, name, read_pixels(props), file, settings, told), {sky: name})
    _mark_integrator(original, parsed)
    _rewrite(parsed, replacements, work, target)
    (work / SCENE).write_text(_to_xml(parsed), encoding="utf-8")
    if settings.spp != 0:
        tell(0, 2, {"stage": "renderings"})
        after = pictures(mi.load_file(str(work / SCENE)), settings.spp)
        tell(1, 2, {"stage": "renderings"})
        result.psnr.extend(compare(original.pictures, after, work))
        if sky in replacements:
            others = pictures(original.scene, settings.spp, seed=1 << 16)
            result.noise.extend(map(psnr, original.pictures, others))
        tell(2, 2, {"stage": "renderings"})


# --- The textures --------------------------------------------------------------------------------


def _convert(group: Group, settings: Settings, share: int) -> ConvertedTexture | str:
    """Fit the image of some uses and save the set, or return why it must stay.

    Of the errors that renderings may have, it gets one of so many shares. If the bitmap is better,
    there is no file.
    """
    held, file = sum(map(resident_bytes, group.textures)), group.file
    try:
        if group.uses[0].relief:
            most = None if settings.replace_all else (held + NEGLIGIBLE) // BYTES
            needed = settings.target_psnr + 10 * math.log10(share)
            goal = Goal(needed, max_gaussians=most)
            g, seen = fit_relief(group, goal, settings.iterations)
        else:
            goal = Goal(settings.target_psnr)
            g, seen = fit_picture(group, goal, settings.iterations, share)
    except (Unsuitable, ImageError) as error:
        file.unlink(missing_ok=True)
        return str(error)
    saved = {"type": GAUSSIANS, "filename": str(file)}
    sets = [mi.load_dict({**saved, "wrap_mode": wrap}) for wrap in sorted({*group.wraps})]
    both = [held, sum(map(resident_bytes, sets))]
    return _chosen(tuple(use.name for use in group.uses), file, g, seen, both, settings)


def _convert_sky(
    original: Original,
    name: str,
    pixels: NDArray[np.float32],
    file: Path,
    settings: Settings,
    tell: Progress,
) -> ConvertedTexture | str:
    """Fit an environment map and save the set, or return why it must stay."""
    sky = original.scene.environment()
    try:
        check_rotation(sky.world_transform())
    except ValueError:
        return "an environment map that its to_world scales or shears"
    try:
        asked = settings.target_psnr, settings.iterations, resident_bytes(sky)
        g, seen = fit_environment(original.scene, pixels, *asked, tell)
    except (Unsuitable, ImageError) as error:
        return str(error)
    g.save(file)
    held = list(map(resident_bytes, (sky, mi.load_dict({"type": SKY, "filename": str(file)}))))
    return _chosen((name,), file, g, seen, held, settings)


def _chosen(
    names: tuple[str, ...],
    file: Path,
    g: Gaussians,
    seen: float,
    held: list[int],
    settings: Settings,
) -> ConvertedTexture:
    """Report an image, and remove the file of its set if the bitmap is better.

    `held` are the bytes of the bitmaps, and of the Gaussians.
    """
    overlap = overlap_of(g)
    is_better = held[1] - held[0] > NEGLIGIBLE or overlap > MOST_OVERLAP
    stays = is_better and not settings.replace_all
    if stays:
        file.unlink()
    return ConvertedTexture(
        names=names,
        file="" if stays else file.name,
        width=g.width,
        height=g.height,
        channels=g.channels,
        bytes=held[0],
        gaussians=len(g),
        gaussian_bytes=held[1],
        overlap=overlap,
        psnr=seen,
    )


def overlap_of(g: Gaussians) -> float:
    """Return the mean number of Gaussians at a point of the image: their areas by its own."""
    a, _, c = g.to_arrays()["factor"].T
    return float(np.minimum(math.pi * CUTOFF**2 / (a * c) / (g.width * g.height), 1).sum())


def _file_name(image: str, raw: bool, used: set[str]) -> str:
    """Name the file of a set after its image."""
    stem = Path(image).stem
    data = [f"{stem}-data.npz"] if raw else []
    names = chain([f"{stem}.npz"], data, (f"{stem}-{k}.npz" for k in count(2)))
    return next(name for name in names if name not in used)


# --- The scene -----------------------------------------------------------------------------------


def _mark_integrator(original: Original, parsed: Parsed) -> None:
    """Give the integrator its type, which Mitsuba's writer does not know of one in Python: prb."""
    instances, nodes = original.parsed.state.root.props, parsed.state.nodes
    for slot in instances.keys():  # noqa: SIM118  it is no mapping
        if isinstance(instances[slot], mi.Integrator):
            nodes[parsed.state.root.props[slot].index()].type = mi.ObjectType.Integrator


def _rewrite(parsed: Parsed, replacements: dict[int, str], work: Path, target: Path) -> None:
    """Put the sets in the place of the bitmaps, and name other files relative to the folder.

    `replacements` holds the new file for the index of each node that was a bitmap. Bitmaps that
    stay, and sets that were there already, become files too if they are in memory.
    """
    for index, node in enumerate(parsed.state.nodes):
        props = node.props
        if index in replacements:
            replace_bitmap(props, replacements[index])
            continue
        if props.plugin_name() == GAUSSIANS and "to_uv" in props:
            props["to_uv"] = to_uv(props)  # it may be a transform of arrays, which XML cannot hold
        is_set = props.plugin_name() in (GAUSSIANS, SKY)
        if is_set and ("mean" in props or "coefficients" in props):
            _save_set(props, work, f"gaussians-{index}.npz")
            continue
        if (is_bitmap(node) or props.plugin_name() == "envmap") and "filename" not in props:
            file = f"bitmap-{index}.exr"
            mi.Bitmap(read_pixels(props)).write(str(work / file))
            del props["data" if "data" in props else "bitmap"]
            props["filename"] = file
        for key in file_keys(props):
            path = Path(props[key])
            if path.is_absolute() and path.exists():
                props[key] = os.path.relpath(path, target)


def _save_set(props: mi.Properties, folder: Path, file: str) -> None:
    """Write the arrays of a plugin of Gaussians, or a model with its coefficients, to a file."""
    source = source_of(props)
    source.gaussians(source.tensors).save(folder / file)
    for key in (*FIELDS, "width", "height", "space", "model", "coefficients"):
        if key in props:
            del props[key]
    props["filename"] = file


def _to_xml(parsed: Parsed) -> str:
    """Write a parsed scene as XML, with the ids of all objects.

    Cameras are chosen by ids and `mitsuba.traverse` makes names of them, but Mitsuba's writer drops
    those that nothing refers to.
    """
    nodes, owners = parsed.state.nodes, dict[str, int]()
    for index in [*references(parsed.state.root.props).values(), *range(len(nodes))]:
        props = nodes[index].props
        if owners.setdefault(props.id(), index) != index:
            props.set_id("")  # of a dictionary, where slots without an id are all called "bsdf"
    try:
        root = ElementTree.fromstring(mi.parser.write_string(parsed.state))
    except RuntimeError as error:
        reason = str(error).partition("] ")[2] or str(error)
        raise ValueError(
            f"the scene cannot be written as XML ({reason}); give meshes and volumes by files"
        ) from None
    _write_ids(root, parsed.state.root.props, nodes)
    return ElementTree.tostring(root, encoding="unicode")


def _write_ids(
    element: ElementTree.Element, props: mi.Properties, nodes: list[mi.parser.SceneNode]
) -> None:
    """Give an element and those in it the ids of their nodes, which the writer visits in turn."""
    if props.id():
        element.set("id", props.id())
    children = [child for child in element if child.tag == "ref" or "type" in child.attrib]
    for child, index in zip(children, references(props).values(), strict=True):
        if child.tag != "ref":  # what is written already
            _write_ids(child, nodes[index].props, nodes)
