"""The commands of Mitsuba scenes.

``eigengs-dr scene`` renders scenes that use the plugins, and ``eigengs-dr convert`` replaces the
bitmaps of a scene by Gaussians.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..backend.selection import select
from ..storage.atomic import atomic_write
from . import options
from .console import MISSED, bar, table
from .outputs import check_outputs, describe_run, name_outputs, write_report

if TYPE_CHECKING:
    from ..scene.convert import ConvertedScene


SUFFIXES = (".png", ".exr")
"""Suffixes of pictures: PNG is clamped sRGB, EXR is linear."""

MADE = "build/scenes/"
"""Folder of the sets that the scenes of the repository use."""

RESERVED = ("path", "parallel", "optimize")
"""Names of arguments of `mitsuba.load_file`, which no scene parameter can have."""


class Definition(click.ParamType):
    """A parameter of a scene and its value, as in "spp=16"."""

    name = "KEY=VALUE"

    def convert(self, value: Any, param: Any, context: Any) -> tuple[str, str]:
        """Parse the text of an option as a name and a value."""
        key, sign, text = value.partition("=")
        if not (key and sign):
            self.fail(f"{value}: expected a name and a value, such as spp=16", param, context)
        if key in RESERVED:
            self.fail(f"{key}: Mitsuba reserves this name; rename it in the scene", param)
        return key, text


definitions_option = click.option(
    "-D",
    "definitions",
    multiple=True,
    type=Definition(),
    help="Set a <default> of the scene; repeat for more.",
)


@click.command()
@click.argument("scenes", nargs=-1, required=True, type=options.EXISTING, metavar="SCENE.xml...")
@options.output(".png or .exr file, or a folder.")
@click.option(
    "--variant",
    metavar="NAME",
    help="Mitsuba variant.  [default: cuda_ad_rgb if there is a GPU, else llvm_ad_rgb]",
)
@options.number("--spp", "Samples per pixel.  [default: from the scene]", least=1)
@definitions_option
@options.quiet_option
def scene(
    scenes: tuple[Path, ...],
    output: Path,
    variant: str | None,
    spp: int | None,
    definitions: tuple[tuple[str, str], ...],
    quiet: bool,
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
    mi = load_mitsuba(variant, quiet)
    for path, target in zip(scenes, outputs, strict=True):
        started = time.perf_counter()
        with explained(path), bar(quiet) as show:
            pixels, samples = _render(mi, path, spp, dict(definitions), partial(show, str(path)))
        _write(mi, target, pixels)
        if not quiet:
            height, width = pixels.shape[:2]
            click.echo(
                f"{path}: {width}x{height}, samples per pixel: {samples}, "
                f"{time.perf_counter() - started:.1f} s\n  wrote {target}"
            )


def load_mitsuba(variant: str | None, quiet: bool) -> Any:
    """Import Mitsuba, set a variant and register the plugins."""
    backend = variant.partition("_")[0] if variant else None
    module = select(backend if backend in ("llvm", "cuda") else None)
    try:
        import mitsuba as mi
    except ImportError as error:
        advice = "install it: pip install 'mitsuba==3.9.*'"
        raise ValueError(f"scenes need Mitsuba ({error}); {advice}") from error
    from ..plugins import register_plugins

    if variant is None:
        variant = "cuda_ad_rgb" if "cuda" in module.__name__ else "llvm_ad_rgb"
    if variant not in mi.variants():
        known = ", ".join(mi.variants())
        raise click.UsageError(f"--variant {variant}: unknown; use one of {known}")
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error if quiet else mi.LogLevel.Warn)
    register_plugins()
    return mi


def _render(
    mi: Any, path: Path, spp: int | None, parameters: dict[str, str], show: Callable[..., None]
) -> tuple[Any, int]:
    """Render a scene in passes; return its pixels, shape (H, W, C), and the samples per pixel."""
    from ..scene.convert import render_in_passes

    scene = mi.load_file(str(path), **parameters)
    if not isinstance(scene, mi.Scene):
        raise ValueError("the file holds no scene; its root must be <scene version='3.0.0'>")
    if not scene.sensors():
        raise ValueError("the scene has no sensor; add one")
    return render_in_passes(scene, 0, spp, show)


def _write(mi: Any, path: Path, pixels: Any) -> None:
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
            raise click.Abort from error
        text = re.sub(r"\[\w+\.cpp:\d+\] ", "", str(cause))
        # For an error in a plugin, Mitsuba prints the whole traceback; its last line says why.
        where, _, trace = text.partition("Traceback (most recent call last):")
        if trace:
            text = where + re.sub(r"^\w+: (\[Errno \d+\] )?", "", trace.strip().splitlines()[-1])
        if MADE in text:
            text += "; run 'make scenes' first, which makes the sets of these scenes"
        raise ValueError(f"{path}: {text or type(cause).__name__}") from error


@click.command()
@click.argument("scene", type=options.EXISTING, metavar="SCENE.xml")
@options.output("New or empty folder.", "FOLDER")
@click.option(
    "--target-psnr",
    "--psnr",
    "target_psnr",
    type=float,
    default=40.0,
    metavar="DB",
    help="With which each camera sees each texture.",
)
@options.number("--iterations", "Steps of optimisation for each number of Gaussians.", 100, 0)
@options.number(
    "--spp", "Samples per pixel; 0 renders nothing.  [default: from the scene]", least=0
)
@click.option("--variant", metavar="NAME", help="Mitsuba variant, as for eigengs-dr scene.")
@definitions_option
@options.report_option
@options.quiet_option
@click.pass_context
def convert(
    context: click.Context,
    scene: Path,
    output: Path,
    target_psnr: float,
    iterations: int,
    spp: int | None,
    variant: str | None,
    definitions: tuple[tuple[str, str], ...],
    report: Path | None,
    quiet: bool,
) -> None:
    """Replace every bitmap of a Mitsuba scene by as many Gaussians as its cameras resolve.

    FOLDER gets scene.xml, a set for each image, and for each camera the renderings before and
    after, and 8 times their difference. If a rendering misses the PSNR, the command says so and
    exits with code 1. Environment maps, alpha masks, bump maps, images of two values, values above
    1 and images that no camera sees stay as they are; the command says why. Other files stay where
    they are, and the new scene names them relative to options.FOLDER.

    \b
    Examples:
      eigengs-dr convert room.xml -o room-gaussians/
      eigengs-dr convert room.xml -o room-gaussians/ --target-psnr 36 --spp 64
      eigengs-dr scene room-gaussians/scene.xml -o room.png
    """
    check_outputs([report], [scene])
    mi = load_mitsuba(variant, quiet)
    from ..scene.convert import convert_scene

    started = time.perf_counter()
    with explained(scene), bar(quiet) as show:
        found = convert_scene(
            scene, output, target_psnr, iterations, spp, dict(definitions), progress=show
        )
    run = describe_run(context, mi.variant().partition("_")[0])
    write_report(report, run | _figures(found))
    if not quiet:
        click.echo(_table(found))
        click.echo(f"wrote {found.scene} in {time.perf_counter() - started:.1f} s")
    if any(psnr < target_psnr for psnr in found.psnr):
        context.exit(MISSED)


def _figures(found: ConvertedScene) -> dict[str, Any]:
    return {
        "output": str(found.scene),
        "textures": [texture._asdict() for texture in found.textures],
        "left": [{"name": name, "reason": reason} for name, reason in found.left],
        "bytes_before": sum(texture.bytes for texture in found.textures),
        "bytes": sum(texture.gaussian_bytes for texture in found.textures),
        "psnr_rgb": found.psnr,
    }


def _table(found: ConvertedScene) -> str:
    """Lay out the textures, what stayed, and how close the renderings are."""
    rows = [("texture", "texels", "bytes", "Gaussians", "bytes", "PSNR seen")]
    for t in found.textures:
        size, psnr = f"{t.width}x{t.height}", f"{t.psnr:.1f} dB"
        cells = size, f"{t.bytes:,}", f"{t.gaussians:,}", f"{t.gaussian_bytes:,}", psnr
        rows.append((t.names[0], *cells))
        rows += [(name, "(the same set)", "", "", "", "") for name in t.names[1:]]
    lines = table(rows)
    if found.textures:
        before = sum(t.bytes for t in found.textures)
        after = sum(t.gaussian_bytes for t in found.textures)
        lines.append(f"memory: {after:,} of {before:,} bytes ({after / before:.3f})")
    lines += [f"left alone: {name}: {reason}" for name, reason in found.left]
    lines += [
        f"camera {k}: psnr_rgb {psnr:.1f} dB between the renderings"
        for k, psnr in enumerate(found.psnr, 1)
    ]
    return "\n".join(lines)
