"""The commands of Mitsuba scenes.

``eigengs-dr scene`` renders scenes that use the plugins, and ``eigengs-dr convert`` replaces the
bitmaps of a scene by Gaussians.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
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
from .console import MISSED, bar, table
from .outputs import check_outputs, claim, name_outputs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..scene.convert import ConvertedScene


SUFFIXES = (".png", ".exr")
"""Suffixes of pictures: PNG is clamped sRGB, EXR is linear."""


def definition(text: str) -> tuple[str, str]:
    """Parse a parameter of a scene and its value, as in "spp=16"."""
    key, sign, value = text.partition("=")
    if not (key and sign):
        raise click.BadParameter(f"{text}: expected a name and a value, such as spp=16")
    return key, value


variant_option = options.value(
    "--variant", "NAME", str, "Of Mitsuba.  [default: cuda_ad_rgb with a GPU, else llvm_ad_rgb]"
)
many: Record = {"multiple": True, "callback": lambda context, option, given: dict(given)}
definitions_option = click.option(
    "-D", "definitions", type=definition, metavar="KEY=VALUE", help="Set a <default>.", **many
)


@click.command()
@click.argument("scenes", nargs=-1, required=True, type=options.EXISTING, metavar="SCENE.xml...")
@options.output(".png or .exr file, or a folder.", "OUT")
@variant_option
@options.number("--spp", "Samples per pixel.  [default: from the scene]", least=1)
@definitions_option
@options.shared("quiet")
def scene(
    run: options.Run,
    scenes: tuple[Path, ...],
    output: Path,
    variant: str | None,
    spp: int | None,
    definitions: dict[str, str],
) -> None:
    """Render Mitsuba scenes with Gaussian textures.

    The mitsuba executable does not know the texture gaussian_texture, because it is a plugin in
    Python; this command does. For several scenes, -o names a folder, and the pictures have the
    names of the scenes.

    \b
    Examples:
      eigengs-dr scene scenes/plane.xml -o plane.png
      eigengs-dr scene scenes/plane.xml -o plane.png -D prefilter=0 --spp 64
      eigengs-dr scene scenes/*.xml -o build/scenes/
      eigengs-dr scene scenes/ball.xml -o ball.exr --variant llvm_ad_spectral
    """
    outputs = name_outputs(scenes, output, SUFFIXES)
    check_outputs(outputs, scenes)
    claim(*outputs)
    mi = load_mitsuba(variant, run.quiet)
    from ..scene.convert import render_in_passes

    for path, target in zip(scenes, outputs, strict=True):
        started = time.perf_counter()
        with explained(path), bar(run.quiet) as show:
            found = mi.load_file(str(path), **definitions)
            if not isinstance(found, mi.Scene):
                raise ValueError("it holds no scene; its root must be <scene version='3.0.0'>")
            if not found.sensors():
                raise ValueError("the scene has no sensor; add one")
            pixels, samples = render_in_passes(found, 0, spp, partial(show, str(path)))
        _write(mi, target, pixels)
        height, width = pixels.shape[:2]
        run.tell(
            f"{path}: {width}x{height}, samples per pixel: {samples}, "
            f"{time.perf_counter() - started:.1f} s",
            f"  wrote {target}",
        )


def load_mitsuba(variant: str | None, quiet: bool) -> ModuleType:
    """Import Mitsuba, set a variant and register the plugins."""
    module = select(backend_of(variant) if variant else None)
    from ..plugins import register_plugins  # first: its error says what to install

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


def _write(mi: ModuleType, path: Path, pixels: NDArray[np.float32]) -> None:
    """Write a picture, all or nothing."""
    if path.suffix.lower() == ".png":
        channels = pixels.shape[2] if pixels.shape[2] <= 4 else 3  # AOVs follow the colours
        bitmap = mi.Bitmap(pixels[..., :channels].copy())
        bitmap = bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)
    else:
        bitmap = mi.Bitmap(pixels)
    with atomic_write(path) as temporary:
        bitmap.write(str(temporary))


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Reduce an error of Mitsuba in a block to one line that says what is wrong.

    Mitsuba raises many types for mistakes in a scene; only the message tells them apart.
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
        # For an error in a plugin, Mitsuba prints the whole traceback; its last line says why.
        where, _, trace = text.partition("Traceback (most recent call last):")
        if trace:
            text = where + re.sub(r"^\w+: (\[Errno \d+\] )?", "", trace.strip().splitlines()[-1])
        raise ValueError(f"{path}: {text or type(cause).__name__}") from error


@click.command()
@click.argument("scene", type=options.EXISTING, metavar="SCENE.xml")
@options.output("New or empty folder.", "FOLDER")
@click.option(
    "--target-psnr", "--psnr", "target_psnr", metavar="DB", default=40.0, help="As cameras see it."
)
@options.number("--iterations", "Steps of optimisation for each number of Gaussians.", 100, 0)
@options.number("--spp", "Samples a pixel; 0 renders nothing.  [default: from the scene]", least=0)
@variant_option
@definitions_option
@options.shared("report", "quiet")
def convert(
    run: options.Run,
    scene: Path,
    output: Path,
    target_psnr: float,
    iterations: int,
    spp: int | None,
    variant: str | None,
    definitions: dict[str, str],
) -> None:
    """Replace every bitmap of a Mitsuba scene by as many Gaussians as its cameras resolve.

    FOLDER gets scene.xml, a set for each image, and for each camera the renderings before and
    after, and 8 times their difference. If a rendering misses the PSNR, the command says so and
    exits with code 1. Environment maps, bump maps, images of two values such as masks, data beyond
    0 and 1, and images that no camera sees stay as they are; the command says why. Other files stay
    where they are, and the new scene names them relative to FOLDER.

    \b
    Examples:
      eigengs-dr convert room.xml -o room-gaussians/
      eigengs-dr convert room.xml -o room-gaussians/ --target-psnr 36 --spp 64
      eigengs-dr scene room-gaussians/scene.xml -o room.png
    """
    check_outputs([run.report], [scene])
    mi = load_mitsuba(variant, run.quiet)
    from ..scene.convert import convert_scene

    started = time.perf_counter()
    with explained(scene), bar(run.quiet) as show:
        found = convert_scene(
            scene, output, target_psnr, iterations, spp, definitions, progress=show
        )
    before = sum(texture.bytes for texture in found.textures)
    after = sum(texture.gaussian_bytes for texture in found.textures)
    figures: dict[str, object] = {"output": found.scene, "bytes_before": before, "bytes": after}
    figures["textures"] = [texture._asdict() for texture in found.textures]
    figures["left"] = [{"name": name, "reason": reason} for name, reason in found.left]
    figures["psnr_rgb"] = found.psnr
    run.write_report(figures, mi.variant().partition("_")[0])
    seconds = time.perf_counter() - started
    run.tell(*_table(found, before, after), f"wrote {found.scene} in {seconds:.1f} s")
    if any(psnr < target_psnr for psnr in found.psnr):
        run.context.exit(MISSED)


def _table(found: ConvertedScene, before: int, after: int) -> list[str]:
    """Lay out the textures, what stayed, and how close the renderings are."""
    rows = [("texture", "texels", "bytes", "Gaussians", "bytes", "PSNR seen")]
    for t in found.textures:
        figures = f"{t.bytes:,}", f"{t.gaussians:,}", f"{t.gaussian_bytes:,}", f"{t.psnr:.1f} dB"
        rows.append((t.names[0], f"{t.width}x{t.height}", *figures))
        rows += [(name, "(the same set)", "", "", "", "") for name in t.names[1:]]
    lines = table(rows)
    if before:
        lines.append(f"memory: {after:,} of {before:,} bytes ({after / before:.3f})")
    lines += [f"left alone: {name}: {reason}" for name, reason in found.left]
    psnrs = enumerate(found.psnr, 1)
    lines += [f"camera {k}: psnr_rgb {psnr:.1f} dB between the renderings" for k, psnr in psnrs]
    return lines
