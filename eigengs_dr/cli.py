"""The command line, ``eigengs-dr``: thin, every command calls one function of the package.

What the commands need is imported inside them, so that ``--help`` and mistakes answer at once.
"""

import json
import math
import re
import shlex
from itertools import zip_longest
from pathlib import Path
from typing import Any

import click

from .backend import describe, select
from .console import INTERRUPTED, NAME, Program, progress_bar, say
from .outputs import check_outputs, name_outputs
from .report import write_report

EXISTING = click.Path(exists=True, dir_okay=False, path_type=Path)
ANY_PATH = click.Path(path_type=Path)

MOST_PIXELS = 1 << 26
"""Largest picture that is rendered, thin ones counted in whole tiles: it takes some 6 GiB."""

backend_option = click.option(
    "--backend",
    type=click.Choice(["llvm", "cuda"]),
    help="Where to compute; by default cuda where there is a GPU.",
)
report_option = click.option("--report", type=ANY_PATH, help="JSON file for all figures.")
quiet_option = click.option("--quiet", is_flag=True, help="No progress and no summary.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def choice(name: str, values: list[str], text: str) -> Any:
    """Make an option that takes one of some words, by default the first."""
    kind = click.Choice(values)
    return click.option(name, type=kind, default=values[0], show_default=True, help=text)


@click.group(cls=Program)
@click.version_option(package_name="eigengs-dr")
def main() -> None:
    """Fit images with 2D Gaussians and render them at any size.

    \b
    Examples:
      eigengs-dr fit photo.jpg -o photo.npz --preview photo-fit.png
      eigengs-dr render photo.npz -o large.png --scale 2
      eigengs-dr doctor
    """


@main.command()
@click.argument("images", nargs=-1, required=True, type=EXISTING, metavar="IMAGE...")
@click.option("-o", "--output", required=True, type=ANY_PATH, help=".npz file; or a folder.")
@click.option(
    "--gaussians",
    type=click.IntRange(min=1),
    help="How many; by default 5000, or one a pixel where the image has fewer pixels.",
)
@click.option("--iterations", type=click.IntRange(min=0), default=1000, show_default=True)
@choice("--init", ["auto", "random", "grid", "adaptive"], "Where the Gaussians start.")
@choice("--preset", ["default", "gaussianimage"], "The method.")
@choice("--color", ["ycbcr", "rgb"], "Where errors are measured and colours are stored.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--preview", type=ANY_PATH, help="Picture of photo and fit; or a folder.")
@backend_option
@report_option
@quiet_option
@click.pass_context
def fit(
    context: click.Context,
    /,
    images: tuple[Path, ...],
    output: Path,
    backend: str | None,
    preview: Path | None,
    report: Path | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Fit images by sums of Gaussians.

    For several images OUT and the preview are folders, and the files are named like the images.
    Ctrl-C keeps the best fit so far: it is written before the command ends with exit code 130.

    \b
    Examples:
      eigengs-dr fit photo.jpg -o photo.npz
      eigengs-dr fit photo.jpg -o photo.npz --gaussians 20000 --report photo.json
      eigengs-dr fit *.png -o fits/ --preview previews/ --iterations 300
    """
    from .images import SAVE_OPTIONS

    outputs = name_outputs(images, output, [".npz"])
    previews = name_outputs(images, preview, list(SAVE_OPTIONS)) if preview else []
    check_outputs([*outputs, *previews, report], images)
    select(backend)

    records: list[dict[str, Any]] = []
    for image, target, picture in zip_longest(images, outputs, previews):
        records.append(_fit_one(image, target, picture, quiet, backend=backend, **settings))
        if records[-1]["stopped"] == "interrupted":
            break
    if report:
        figures = records[0] if len(images) == 1 else {"images": records}
        write_report(report, {**_run(context, backend), **settings, **figures})
    if records[-1]["stopped"] == "interrupted":
        say(f"interrupted; the best fit so far is in {records[-1]['output']}")
        context.exit(INTERRUPTED)


@main.command()
@click.argument("file", type=EXISTING, metavar="X.npz")
@click.option("-o", "--output", required=True, type=ANY_PATH, metavar="Y.png")
@click.option("--scale", type=float, metavar="S", help="Times the native size, such as 2 or 0.5.")
@click.option("--size", metavar="WxH", help="Width and height in pixels, such as 1024x768.")
@backend_option
def render(
    file: Path, output: Path, scale: float | None, size: str | None, backend: str | None
) -> None:
    """Render a fitted image, at its native size or at any other.

    \b
    Examples:
      eigengs-dr render photo.npz -o photo.png
      eigengs-dr render photo.npz -o large.png --scale 4
      eigengs-dr render photo.npz -o icon.png --size 64x48
    """
    if scale is not None and size is not None:
        raise click.UsageError("--scale and --size exclude each other; give one of them")
    from .images import SAVE_OPTIONS

    [output] = name_outputs([file], output, list(SAVE_OPTIONS))
    check_outputs([output], [file])
    select(backend)
    import eigengs_dr as eg

    gaussians = eg.Gaussians.load(file, backend=backend)
    width, height = _render_size(gaussians.width, gaussians.height, scale, size)
    eg.save_image(output, eg.render(gaussians, width=width, height=height).numpy())


@main.command()
@click.argument("file", type=EXISTING, metavar="FILE")
@json_option
def info(file: Path, as_json: bool) -> None:
    """Show what a fitted image holds.

    \b
    Examples:
      eigengs-dr info photo.npz
      eigengs-dr info photo.npz --json
    """
    select()
    import eigengs_dr as eg

    gaussians = eg.Gaussians.load(file)
    found = {
        "file": str(file),
        "bytes": file.stat().st_size,
        "gaussians": len(gaussians),
        "width": gaussians.width,
        "height": gaussians.height,
        "channels": gaussians.channels,
        "space": gaussians.space,
    }
    text = "\n".join(f"{key:10} {value}" for key, value in found.items())
    click.echo(json.dumps(found, indent=2) if as_json else text)


@main.command()
@json_option
@click.pass_context
def doctor(context: click.Context, as_json: bool) -> None:
    """Show what works on this machine and what to install.

    Ends with exit code 1 where no backend works.

    \b
    Example:
      eigengs-dr doctor
    """
    from . import doctor as doctor_module

    found = doctor_module.report()
    click.echo(json.dumps(found, indent=2) if as_json else doctor_module.describe(found))
    context.exit(0 if found["llvm"]["works"] or found["cuda"]["works"] else 1)


@main.group()
def bench() -> None:
    """Measure speed and accuracy.

    \b
    Example:
      eigengs-dr bench kernels --report kernels.json
    """


@bench.command()
@click.option(
    "--image",
    type=EXISTING,
    help="What is refined, 512x512 or larger; by default a photo of scikit-image.",
)
@backend_option
@report_option
@quiet_option
@click.pass_context
def kernels(
    context: click.Context,
    image: Path | None,
    backend: str | None,
    report: Path | None,
    quiet: bool,
) -> None:
    """Time the renderer and its derivatives against plain Dr.Jit and the machine's peak.

    \b
    Example:
      eigengs-dr bench kernels --report kernels.json
    """
    check_outputs([report], [])
    select(backend)
    import eigengs_dr as eg

    from .bench import kernels as benchmark

    picture = eg.load_image(image) if image else None
    with progress_bar("kernels", quiet) as progress:
        figures = benchmark.run(picture, backend=backend, progress=progress)
    if report:
        write_report(report, {**_run(context, backend), **figures})
    if not quiet:
        click.echo("\n".join(f"{key:24} {value:.4g}" for key, value in figures.items()))


def _fit_one(
    path: Path, output: Path, preview: Path | None, quiet: bool, **settings: Any
) -> dict[str, Any]:
    """Fit one image, write what was asked for, and return its figures."""
    import numpy as np

    import eigengs_dr as eg

    image = eg.load_image(path)
    height, width = image.shape[:2]
    settings["gaussians"] = settings["gaussians"] or min(5000, width * height)
    with progress_bar(path.name, quiet) as progress:
        try:
            result = eg.fit(image, progress=progress, **settings)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    result.gaussians.save(output)
    if preview:
        eg.save_image(preview, np.concatenate([image, result.image], axis=1))
    record = {
        "input": str(path),
        "output": str(output),
        "width": width,
        "height": height,
        "gaussians": len(result.gaussians),
        "iterations": result.iterations,
        "stopped": result.stopped,
        "seconds": result.seconds,
        "seconds_init": result.seconds_init,
        "psnr_ycbcr": eg.psnr(image, result.image, space="ycbcr"),
        "psnr_rgb": eg.psnr(image, result.image, space="rgb"),
        "ssim": eg.ssim(image, result.image),
        "ms_ssim": eg.ms_ssim(image, result.image),
        "trace": result.trace,
    }
    if not quiet:
        click.echo(_summary(record, preview))
    return record


def _summary(record: dict[str, Any], preview: Path | None) -> str:
    """What a fit came to, for a terminal."""
    text = (
        "{input}: {width}x{height}, {gaussians} Gaussians, {iterations} iterations "
        "in {seconds:.1f} s\n  psnr_ycbcr {psnr_ycbcr:.2f} dB, psnr_rgb {psnr_rgb:.2f} dB, "
        "SSIM {ssim:.4f}, MS-SSIM {ms_ssim:.4f}\n  wrote {output}"
    ).format(**record)
    return f"{text}\n  wrote {preview} (photo and fit side by side)" if preview else text


def _render_size(width: int, height: int, scale: float | None, size: str | None) -> tuple[int, int]:
    """Width and height in pixels that the options ask for."""
    if size is not None:
        match = re.fullmatch(r"(\d+)x(\d+)", size)
        if not match:
            raise click.UsageError(f"--size {size}: expected width and height, such as 1024x768")
        width, height = int(match[1]), int(match[2])
    elif scale is not None:
        if not (math.isfinite(scale) and scale > 0):
            raise click.UsageError(f"--scale {scale}: expected a number above 0, such as 2 or 0.5")
        scale = min(scale, MOST_PIXELS)
        width, height = max(1, round(width * scale)), max(1, round(height * scale))
    if width < 1 or height < 1 or (width + 3) * (height + 3) > MOST_PIXELS:
        raise click.UsageError(f"{width}x{height}: expected 1 to {MOST_PIXELS:,} pixels")
    return width, height


def _run(context: click.Context, backend: str | None) -> dict[str, Any]:
    """What every report says of its run: the command as it was typed, and the machine."""
    return {"command": shlex.join([NAME, *context.obj]), **describe(backend)}
