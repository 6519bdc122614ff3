"""The command ``eigengs-dr scene``, which renders Mitsuba scenes that use the plugins."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import click

from ..backend.selection import backend_of, name_of, select
from ..backend.types import Record
from ..storage.atomic import atomic_write
from . import options
from .console import bar
from .outputs import check_outputs, lock_outputs, name_outputs

if TYPE_CHECKING:
    from ..scene.rendering import Rendering


SUFFIXES = (".png", ".exr")
"""Suffixes of pictures: PNG is clamped sRGB, EXR is linear."""


def definition(text: str) -> tuple[str, str]:
    """Parse a parameter of a scene and its value, such as "spp=16"."""
    key, sign, value = text.partition("=")
    if not (key and sign):
        raise click.BadParameter(f"{text}: expected a name and a value, such as spp=16")
    return key, value


def integrator(text: str) -> Record:
    """Parse the type of an integrator and its parameters, such as "path,max_depth=4"."""
    kind, *settings = text.split(",")
    return {"type": kind, **{key: _value(value) for key, value in map(definition, settings)}}


def _value(text: str) -> object:
    """Parse a number or a boolean; other text is returned unchanged."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


variant_option = options.value(
    "--variant",
    "NAME",
    str,
    "Variant of Mitsuba.  [default: cuda_ad_rgb with a GPU, else llvm_ad_rgb]",
)
many: Record = {"multiple": True, "callback": lambda context, option, given: dict(given)}
definitions_option = click.option(
    "-D",
    "definitions",
    type=definition,
    metavar="KEY=VALUE",
    help="Set a <default> of the scene.",
    **many,
)


@click.command()
@click.argument("scenes", nargs=-1, required=True, type=options.EXISTING, metavar="SCENE.xml...")
@options.output(".png or .exr file, or a folder.", "OUT")
@variant_option
@options.number("--spp", "Samples per pixel.  [default: from the scene]", minimum=1)
@options.value(
    "--camera", "ID|N|all", str, "Camera to render; all writes OUT-ID for each.  [default: 1]"
)
@options.value(
    "--integrator", "TYPE[,KEY=VALUE...]", integrator, "Instead of the scene's integrator."
)
@definitions_option
@options.shared("quiet")
def scene(
    run: options.Run,
    scenes: tuple[Path, ...],
    output: Path,
    variant: str | None,
    spp: int | None,
    camera: str | None,
    integrator: Record | None,
    definitions: dict[str, str],
) -> None:
    """Render Mitsuba scenes with Gaussian textures.

    The mitsuba executable does not know plugins in Python; this command does. For several scenes,
    -o names a folder, and pictures are named after scenes. An EXR file has all AOVs and layers, a
    PNG file the colours. Textures whose prefilter is true follow the camera.

    \b
    Examples:
      eigengs-dr scene scenes/plane.xml -o plane.png -D prefilter=0 --spp 64
      eigengs-dr scene scenes/*.xml -o build/scenes/
      eigengs-dr scene room.xml -o room.png --camera all       writes room-1.png, room-2.png, ...
      eigengs-dr scene room.xml -o room.exr --integrator aov,aovs=distance:depth
    """
    outputs = name_outputs(scenes, output, SUFFIXES)
    check_outputs(outputs, scenes)
    lock_outputs(*outputs)
    mi = load_mitsuba(variant, run.quiet)
    from ..scene.rendering import render_in_passes

    for path, target in zip(scenes, outputs, strict=True):
        with scene_errors(path):
            loaded = mi.load_file(str(path), **definitions)
            if not isinstance(loaded, mi.Scene):
                raise ValueError("it holds no scene; its root must be <scene version='3.0.0'>")
            if not loaded.sensors():
                raise ValueError("the scene has no sensor; add one")
            cameras = _cameras([sensor.id() for sensor in loaded.sensors()], camera)
            renderer = mi.load_dict(integrator) if integrator else None
        files = _files(target, cameras, scenes) if camera == "all" else [target]
        for (number, name), file in zip(cameras.items(), files, strict=True):
            started = time.perf_counter()
            with scene_errors(path), bar(run.quiet) as show:
                rendering = render_in_passes(
                    loaded, number, spp, partial(show, str(path)), renderer
                )
                left_out = _write(mi, file, rendering)
            height, width = rendering.pixels.shape[:2]
            label = f", camera {name}" if len(loaded.sensors()) > 1 else ""
            run.tell(
                f"{path}{label}: {width}x{height}, samples per pixel: {rendering.spp}, "
                f"{time.perf_counter() - started:.1f} s",
                f"  wrote {file}" + f", without {', '.join(left_out)}" * bool(left_out),
            )
        if camera is None and len(loaded.sensors()) > 1:
            run.tell(f"  the first of {len(loaded.sensors())} cameras; --camera all renders each")


def _cameras(ids: list[str], wanted: str | None) -> dict[int, str]:
    """Choose cameras by an id or a number from 1, all of them, or the first.

    Returns
    -------
    dict of int to str
        Index and name of each: its id if that is valid in a file name, else its number.
    """
    names = [name if re.fullmatch(r"[\w.-]+", name) else f"{k}" for k, name in enumerate(ids, 1)]
    if wanted is None or wanted == "all":
        return dict(enumerate(names if wanted else names[:1]))
    numbers = [f"{k}" for k in range(1, len(ids) + 1)]
    for known in (ids, names, numbers):
        if wanted in known:
            return {known.index(wanted): names[known.index(wanted)]}
    raise ValueError(f"it has no camera {wanted}; use all, or one of {', '.join(names)}")


def _files(target: Path, cameras: dict[int, str], scenes: Sequence[Path]) -> list[Path]:
    """Name a picture for each camera, and lock it."""
    files = [target.with_stem(f"{target.stem}-{name}") for name in cameras.values()]
    check_outputs(files, scenes)
    lock_outputs(*files)
    return files


def load_mitsuba(variant: str | None, quiet: bool) -> ModuleType:
    """Import Mitsuba, set a variant and register the plugins."""
    module = select(backend_of(variant) if variant else None)
    from ..plugins import register_plugins  # first, because its error names what to install

    # isort: split
    import mitsuba as mi

    if variant is None:
        variant = f"{name_of(module)}_ad_rgb"
    if variant not in mi.variants():
        known = ", ".join(mi.variants())
        raise click.UsageError(f"--variant {variant}: unknown; use one of {known}")
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error if quiet else mi.LogLevel.Warn)
    register_plugins()
    return mi


def _write(mi: ModuleType, path: Path, rendering: Rendering) -> list[str]:
    """Write a picture atomically; return the names of channels that it leaves out."""
    left_out = []
    if path.suffix.lower() == ".png":
        colors = rendering.picture()
        if not colors.size:
            channels = ", ".join(rendering.channels)
            raise ValueError(f"it has no colours, only {channels}; write an .exr file")
        left_out = [name for name in rendering.channels if name not in {*"RGBAY"}]
        bitmap = mi.Bitmap(colors)
        bitmap = bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)
    else:
        kind = mi.Bitmap.PixelFormat.MultiChannel  # otherwise four AOVs would be taken for RGBA
        bitmap = mi.Bitmap(rendering.pixels, kind, list(rendering.channels))
    with atomic_write(path) as temporary:
        bitmap.write(str(temporary))
    return left_out


@contextmanager
def scene_errors(path: Path) -> Iterator[None]:
    """Convert errors of Mitsuba in a block to a `ValueError` of one line.

    Mitsuba raises many types for mistakes in a scene; only the messages differ.
    """
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        cause: BaseException = error
        while cause.__cause__:  # the outer error of Dr.Jit only says "see above"
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        text = re.sub(r"\[\w+\.cpp:\d+\] ", "", str(cause))
        text = re.sub(r"(?<=: )\w+Error: (\[Errno \d+\] )?", "", text)  # of Python, in a plugin
        raise ValueError(f"{path}: {text or type(cause).__name__}") from error
