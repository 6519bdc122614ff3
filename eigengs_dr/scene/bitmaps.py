"""The bitmaps of a scene: where they are, what they hold, and which ones must stay bitmaps."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.types import PathLike, Record
from ..image.color import to_coded
from ..image.space import DATA, LINEAR, RADIANCE, Space
from ..plugins import register_plugins  # first: its error says what to install

# isort: split
import mitsuba as mi

TWO_VALUES = 0.95
"""Share of black or white pixels from which on an image counts as a mask."""

KEPT = ("to_uv", "wrap_mode")
"""Properties of a bitmap that a ``gaussian_texture`` has too."""

SKY_KEPT = ("to_world", "scale", "sampling_weight")
"""Properties of an ``envmap`` that a ``gaussian_environment`` has too."""

GAUSSIANS, SKY, RELIT = "gaussian_texture", "gaussian_environment", "gaussian_relightable"
"""Names of the plugins in scenes."""

RELIEF = {"bumpmap": "heights of a bump map", "normalmap": "vectors of a normal map"}
"""What turns the light on a surface, by the material that uses it: renderings judge it."""

UDIM = re.compile(r"<udim>|<uvtile>|%\(udim\)d", re.IGNORECASE)
"""Placeholders of Mari, Mudbox and Houdini for the number of a tile in file names."""


class Use(NamedTuple):
    """A bitmap in a scene.

    Attributes
    ----------
    node : int
        Its index among the nodes of the parsed scene.
    parent : int
        Index of the node that uses it.
    slot : str
        Property of that node.
    file : str
        Absolute path of the image; for pixels in memory, a unique name.
    raw : bool
        Whether the values are data.
    wrap : str
        Wrap mode.
    relief : str
        Whether it is the `RELIEF` of a surface, or "".
    name : str
        Its name in reports.
    """

    node: int
    parent: int
    slot: str
    file: str
    raw: bool
    wrap: str
    relief: str
    name: str


class Parsed(NamedTuple):
    """A scene that is parsed but not instantiated: all nodes, with absolute names of files."""

    config: mi.parser.ParserConfig
    state: mi.parser.ParserState

    def copied(self) -> Parsed:
        """Return a copy to instantiate: a scene that was instantiated cannot be written."""
        state = mi.parser.ParserState(self.state)
        for node in state.nodes:
            if "data" in node.props and is_bitmap(node):  # an instance takes the tensor away
                node.props["data"] = mi.TensorXf(np.array(node.props["data"], np.float32))
        return Parsed(self.config, state)


def parse(scene: PathLike | Record, parameters: Mapping[str, str] | None = None) -> Parsed:
    """Parse a scene, and make the names of its files absolute.

    Parameters
    ----------
    scene : path-like or dict
        An XML file, or a dictionary as for `mitsuba.load_dict`.
    parameters : mapping of str to str, optional
        Values for the defaults of an XML file.

    Raises
    ------
    ValueError
        If the root is not a scene, or a file name stands for UDIM tiles.
    RuntimeError
        Mitsuba's error, if the scene does not parse.
    """
    register_plugins()
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = config.parallel = False
    with _own_resolver() as resolver:  # parsing adds the folders of <path> to it
        if isinstance(scene, Mapping):
            state = mi.parser.parse_dict(config, dict(scene))
        else:
            for path in (Path(scene).resolve(), Path(scene).absolute()):  # the scene may be a link
                resolver.prepend(str(path.parent))
            state = mi.parser.parse_file(config, str(scene), **dict(parameters or {}))
        mi.parser.transform_all(config, state)
        if state.root.props.plugin_name() != "scene":
            raise ValueError("holds no scene; its root must be <scene version='3.0.0'>")
        for node in state.nodes:
            _make_absolute(node.props)
    for node in state.nodes:
        kinds = {
            GAUSSIANS: mi.ObjectType.Texture,
            SKY: mi.ObjectType.Emitter,
            RELIT: mi.ObjectType.BSDF,
        }
        if kind := kinds.get(node.props.plugin_name()):  # Mitsuba does not know plugins in Python
            node.type = kind
    return Parsed(config, state)


@contextmanager
def _own_resolver() -> Iterator[mi.FileResolver]:
    """Use a copy of Mitsuba's file resolver in a block."""
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    mi.set_file_resolver(resolver)
    try:
        yield resolver
    finally:
        mi.set_file_resolver(before)


def _make_absolute(props: mi.Properties) -> None:
    """Look up files as Mitsuba does: in the folders of ``<path>``, then beside the scene."""
    for key in file_keys(props):
        path = Path(str(mi.file_resolver().resolve(props[key])))
        if path.exists():
            props[key] = str(path.absolute())
        elif UDIM.search(props[key]):
            raise ValueError(
                f"{props[key]} stands for UDIM tiles, and Mitsuba reads one image a bitmap; split "
                "the mesh by tiles, and give each part the bitmap of its tile"
            )


def file_keys(props: mi.Properties) -> list[str]:
    """Return the properties that name files."""
    has_model = props.plugin_name() in (GAUSSIANS, SKY, RELIT)
    named = ("filename", "model") if has_model else ("filename",)
    return [key for key in props.keys() if key in named or key.endswith("_filename")]  # noqa: SIM118


def references(props: mi.Properties) -> dict[str, int]:
    """Return the indices of the nodes that a parsed node has in its slots."""
    kind = mi.Properties.Type.ResolvedReference
    slots = (slot for slot in props.keys() if props.type(slot) == kind)  # noqa: SIM118
    return {slot: props[slot].index() for slot in slots}


def uses_of(
    parsed: Parsed, key_of: Callable[[int, str], str | None]
) -> tuple[list[Use], list[tuple[str, str]]]:
    """Find the bitmaps of a scene that may become Gaussians.

    Parameters
    ----------
    parsed : Parsed
    key_of : callable
        Returns the name in `mitsuba.traverse` of what a slot of a node holds, if it has one.

    Returns
    -------
    list of Use
    list of (str, str)
        Names of the bitmaps that stay, and the reasons.
    """
    nodes = parsed.state.nodes
    parents: dict[int, list[tuple[int, str]]] = {}
    for index, node in enumerate(nodes):
        for slot, child in references(node.props).items():
            parents.setdefault(child, []).append((index, slot))
    uses, left = [], list[tuple[str, str]]()
    for index, node in enumerate(nodes):
        props = node.props
        if not is_bitmap(node):
            continue
        # A texture with an id is a child of the scene too, where it has no use.
        above = [(p, s) for p, s in parents.get(index, []) if nodes[p].type != mi.ObjectType.Scene]
        parent, slot = above[0] if above else (0, "")
        owner = nodes[parent].props
        key = key_of(parent, slot) if above else None
        name = label(props, key or f"{owner.id() or owner.plugin_name()}.{slot}")
        parents_of = [nodes[p].props.plugin_name() for p, _ in above]
        if reason := _reason(props, parents_of):
            left.append((name, reason))
            continue
        file = os.path.realpath(props["filename"]) if "filename" in props else f"{slot}-{index}"
        raw, wrap = bool(props.get("raw", False)), str(props.get("wrap_mode", "repeat"))
        relief = RELIEF.get(parents_of[0], "")
        uses.append(Use(index, parent, slot, file, raw, wrap, relief, name))
    return uses, left


def is_bitmap(node: mi.parser.SceneNode) -> bool:
    """Return whether a node of a parsed scene is a bitmap texture."""
    return node.type == mi.ObjectType.Texture and node.props.plugin_name() == "bitmap"


def label(props: mi.Properties, place: str) -> str:
    """Name a bitmap by its file and where it is."""
    file = Path(str(props["filename"])).name if "filename" in props else "a bitmap in memory"
    return f"{file} ({place})"


def _reason(props: mi.Properties, parents: list[str]) -> str:
    """Return why the properties or users of a bitmap require a bitmap, or nothing."""
    if not parents:
        return "nothing uses it"
    if len(set(parents)) > 1 and (relief := {*parents} & {*RELIEF}):
        return f"{RELIEF[min(relief)]} that are something else too"
    if (kind := str(props.get("filter_type", "bilinear"))) != "bilinear":
        return f"its filter is {kind}, not bilinear"
    return ""


def read_pixels(props: mi.Properties) -> NDArray[np.float32]:
    """Return the pixels of a bitmap or an environment map as Mitsuba reads them.

    Returns
    -------
    ndarray of float32, shape (H, W, 3) or (H, W, 1)
        Linear light, or values as they are if the bitmap is raw; without alpha.
    """
    if "data" in props:
        return np.array(props["data"], np.float32)
    kinds = mi.Bitmap.PixelFormat
    bitmap = mi.Bitmap(props["filename"] if "filename" in props else props["bitmap"])
    if props.get("raw", False):
        bitmap.set_srgb_gamma(False)
    grey = bitmap.pixel_format() in (kinds.Y, kinds.YA)
    converted = bitmap.convert(kinds.Y if grey else kinds.RGB, mi.Struct.Type.Float32, False)
    return np.array(converted).reshape(bitmap.height(), bitmap.width(), -1)


class Unsuitable(ValueError):
    """Pixels that must stay a bitmap; the message says why."""


def texture_space(pixels: NDArray[np.float32], data: bool) -> Space:
    """Return the space of the Gaussians for pixels.

    Raises
    ------
    Unsuitable
        If the pixels must stay a bitmap.
    """
    low, high = pixels.min(), pixels.max()
    if low < -0.001 or (data and high > 1.001):
        raise Unsuitable(f"values from {low:g} to {high:g}, beyond 0 and 1")
    if high > 1.001:
        return RADIANCE
    display = pixels if data else to_coded(pixels)
    extreme = float(((display <= 0.02) | (display >= 0.98)).all(axis=2).mean())
    if extreme >= TWO_VALUES and np.ptp(display) > 0.5:
        raise Unsuitable("a mask of two values: Gaussians would soften its edges")
    return DATA if data else LINEAR
