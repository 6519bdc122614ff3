"""The command ``eigengs-dr convert``: replace the bitmaps of a scene by Gaussians."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import progress_bar
from .fit import MISSED
from .options import ANY_PATH, EXISTING, describe_run, quiet_option, report_option
from .outputs import check_outputs
from .report import write_report
from .scene import definitions_option, explain, load_mitsuba

if TYPE_CHECKING:
    from ..scene.convert import ConvertedScene


@click.command()
@click.argument("scene", type=EXISTING, metavar="SCENE.xml")
@click.option(
    "-o", "--output", required=True, type=ANY_PATH, metavar="FOLDER", help="New or empty folder."
)
@click.option(
    "--target-psnr",
    "--psnr",
    "target_psnr",
    type=float,
    default=40.0,
    show_default=True,
    metavar="DB",
    help="With which each camera sees each texture.",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0),
    default=100,
    show_default=True,
    metavar="N",
    help="Steps of optimisation for each number of Gaussians.",
)
@click.option(
    "--spp",
    type=click.IntRange(min=0),
    metavar="N",
    help="Samples per pixel of the renderings; 0 renders nothing.  [default: from the scene]",
)
@click.option("--variant", metavar="NAME", help="Mitsuba variant, as for eigengs-dr scene.")
@definitions_option
@report_option
@quiet_option
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
    they are, and the new scene names them relative to FOLDER.

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
    try:
        with progress_bar(quiet) as show:
            found = convert_scene(
                scene, output, target_psnr, iterations, spp, dict(definitions), progress=show
            )
    except OSError:
        raise
    # Mitsuba raises many types for mistakes in a scene; only the message says what is wrong.
    except Exception as error:
        raise explain(scene, error) from error
    if report:
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
    widest = max([7, *(len(name) for t in found.textures for name in t.names)])
    head = ("texels", "bytes", "Gaussians", "bytes", "PSNR seen")
    lines = [f"{'texture':{widest}}  " + "".join(f"{text:>11}" for text in head)]
    for t in found.textures:
        cells = (
            f"{t.width}x{t.height}",
            f"{t.bytes:,}",
            f"{t.gaussians:,}",
            f"{t.gaussian_bytes:,}",
            f"{t.psnr:.1f} dB",
        )
        lines.append(f"{t.names[0]:{widest}}  " + "".join(f"{cell:>11}" for cell in cells))
        lines += [f"{name:{widest}}  (the same set)" for name in t.names[1:]]
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
