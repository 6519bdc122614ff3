"""The command ``eigengs-dr render``: render Gaussians to a picture."""

from functools import partial
from pathlib import Path
from typing import Any

import click

import eigengs_dr as eg

from ..backend.selection import select
from . import options
from .console import bar, exit_if_failed, for_each
from .outputs import check_outputs, lock_outputs, name_outputs


@click.command()
@click.argument("file", type=options.FILE_OR_FOLDER, metavar="X.npz|FOLDER")
@options.output("Picture, or folder of PNG files.", "Y.png|FOLDER", False)
@options.value("--light", "X,Y,Z", options.light, "Light direction for a model of lights.")
@click.option(
    "--planes",
    type=options.path,
    metavar="FOLDER",
    help="Write the planes of a model of lights for relight and OpenLIME, instead of a picture.",
)
@click.option("--map", "name", metavar="NAME", help="Map of a material to render.")
@options.value(
    "--region", "X,Y,W,H", options.region, "Region of the image: left, top, width, height."
)
@options.value("--scale", "S", options.scale, "Factor of the native size.")
@options.value("--size", "W|WxH", options.width_or_size, "Width, or width and height, in pixels.")
@options.number("--first", "Only the first N Gaussians, for fits with --levels.", minimum=1)
@options.choice(
    "--bits",
    ["8", "16", "32"],
    "Bits per value.  [default: 32 in .exr, .hdr, .pfm, else 8]",
    True,
)
@options.shared("backend", "quiet")
def render(
    run: options.Run,
    file: Path,
    output: Path | None,
    planes: Path | None,
    scale: float | None,
    size: tuple[int, int | None] | None,
    bits: str | None,
    **choices: Any,
) -> None:
    """Render a fitted image at any size, or a region of it.

    By default the picture has the native size of the image or of the region; a smaller one is an
    average. Files of 8 and 16 bits hold clamped sRGB, files of floats (.exr, .hdr, .pfm, and .tif
    with --bits 32) linear light. Data are written unchanged, one channel as a grey picture. A .tif
    file takes only the memory of a band.

    A model of lights ('eigengs-dr train --lights') takes --light: a vector towards the light, x to
    the right, y up, z towards the camera.

    Of a folder, all sets are rendered; if one fails, the exit code is 2.

    \b
    Examples:
      eigengs-dr render photo.npz -o photo.png
      eigengs-dr render photo.npz -o icon.png --size 64x48 --first 500
      eigengs-dr render bark.npz -o roughness.png --map roughness
      eigengs-dr render huge.npz -o part.png --region 4000,2500,800,600 --scale 2
      eigengs-dr render fits/ -o pictures/ --size 512
      eigengs-dr render coin.npz -o coin.png --light 0.3,0.2,0.9
      eigengs-dr render coin.npz --planes coin/
    """
    if planes is not None:
        if output or scale or size or bits or any(choices.values()):
            raise click.UsageError("--planes takes no other options but --backend and --quiet")
        return _write_planes(run, file, planes)
    if output is None:
        raise click.UsageError("Missing option '-o' / '--output'.")
    if scale is not None and size is not None:
        raise click.UsageError("--scale and --size exclude each other; give one of them")
    from ..image.io import SUFFIXES, bits_of

    files, in_folder = options.sets_in(file), file.is_dir()
    outputs = name_outputs(files, output, SUFFIXES, in_folder)
    depth = bits_of(outputs[0], int(bits) if bits else None)
    check_outputs(outputs, files)
    lock_outputs(output if in_folder else outputs[0])
    select(run.backend)
    work = partial(_render, run=run, depth=depth, scale=scale, size=size, **choices)
    exit_if_failed(for_each(in_folder, work, files, outputs))


def _write_planes(run: options.Run, file: Path, folder: Path) -> None:
    """Write the planes of a model of lights to a folder."""
    from ..gaussian.file import LIGHTS, kind_of
    from ..relight.model import Relightable
    from ..relight.planes import PixelPlanes

    options.refuse_folder(file)
    if kind_of(file) != LIGHTS:
        raise ValueError(f"{file}: holds no model of lights; leave out --planes")
    select(run.backend)
    planes = PixelPlanes.of(Relightable.load(file, run.backend))
    planes.write(folder)
    height, width, count = planes.images.shape
    run.tell(f"{file}: wrote {count} planes of {width}x{height} pixels to {folder}")


def _render(
    file: Path,
    output: Path,
    *,
    run: options.Run,
    depth: int,
    scale: float | None,
    size: tuple[int, int | None] | None,
    **choices: Any,
) -> Path:
    """Render one set to a file, and return its name."""
    from ..gaussian.file import LIGHTS, check_region, kind_of, read_map
    from ..image.formats import TIFF_SUFFIXES
    from ..many.draw import save_region

    name, region, first = (choices[key] for key in ("name", "region", "first"))
    light = choices["light"]
    lit = kind_of(file) == LIGHTS
    if light is None and lit:
        raise ValueError(f"{file}: holds a model of lights; give --light, such as 0.3,0.2,0.9")
    if light is not None and not lit:
        raise ValueError(f"{file}: holds no model of lights; leave out --light")
    if light is not None and name is not None:
        raise ValueError("--light and --map exclude each other; give one of them")
    if light is not None:
        data = eg.Relightable.load(file, run.backend).relight(light).data()
    else:
        data = read_map(file, name, "--map")
    count = len(data.arrays["mean"])
    if first is not None:
        if first > count:
            raise ValueError(f"{file}: --first is {first}; the file has {count} Gaussians")
        count = first
        parts = {name: data.arrays[name][:first] for name in ("mean", "factor", "color")}
        data = data._replace(arrays=data.arrays | parts)
    region = check_region(f"{file}: --region", region or (0, 0, *data.size), data.size)
    width, height = region[2:]
    columns, rows = size or (max(1, round(width * (scale or 1))), None)
    if rows is None:
        rows = max(1, round(height * (scale or columns / width)))
    options.check_pixels(columns, rows, output.suffix.lower() in TIFF_SUFFIXES)
    with bar(run.quiet) as show:
        step = partial(show, output.name)
        save_region(output, data, region, (columns, rows), run.backend, step, depth)
    run.tell(f"{file}: {count:,} Gaussians", f"  wrote {output} ({columns}x{rows})")
    return output
