"""The command ``eigengs-dr pack``: compress a fitted image or a material."""

from __future__ import annotations

from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

import click

import eigengs_dr as eg

from ..backend.selection import select
from ..backend.types import Record
from . import options
from .console import exit_if_failed, for_each
from .outputs import check_outputs, lock_outputs, name_outputs

SUFFIX, BUDGET = ".egs", 0.5
"""Suffix of packed files and default loss in dB, repeated here because `eigengs_dr.codec` imports
Dr.Jit."""


@click.command()
@click.argument("file", type=options.FILE_OR_FOLDER, metavar="X.npz|FOLDER")
@options.output("File or folder.", "Y.egs|FOLDER")
@options.value("--image", "IMAGE", options.image, "The original image, to measure the loss.")
@options.maps("The image of a map of a material; repeatable.")
@options.encoding
@options.value("--max-psnr-drop", "DB", float, "Allowed loss of PSNR.", BUDGET)
@options.level_counts("Levels of the fit; readers may stop after any.")
@options.shared("backend", "report", "quiet")
def pack(
    run: options.Run,
    file: Path,
    output: Path,
    image: Path | None,
    maps: dict[str, options.MapFile],
    encoding: str | None,
    max_psnr_drop: float,
    levels: int | tuple[int, ...] | None,
) -> None:
    """Compress a fitted image or a material.

    Parameters are quantised as coarsely as --max-psnr-drop permits. Commands that read the .npz
    file of an image read .egs files too. Without --image, the fit counts as one of 40 dB. A
    material takes --map instead; a model of lights takes neither: its loss refers to left-out
    lights.

    Of a folder, all .npz files are packed; if one fails, the exit code is 2.

    \b
    Examples:
      eigengs-dr pack photo.npz -o photo.egs --image photo.jpg --max-psnr-drop 0.1
      eigengs-dr pack levels.npz -o levels.egs --levels 4
      eigengs-dr pack bark.npz -o bark.egs --map albedo=a.jpg --map normal=n.jpg
      eigengs-dr pack fits/ -o packed/
    """
    files, in_folder = options.sets_in(file, (".npz",)), file.is_dir()
    if in_folder and (image or maps):
        raise ValueError("--image and --map belong to one set; leave them out for a folder")
    if encoding and not (image or maps):
        raise ValueError("--encoding needs --image or --map")
    targets = name_outputs(files, output, [SUFFIX], in_folder)
    inputs = [*files, *([image] if image else []), *(m.path for m in maps.values())]
    check_outputs([*targets, run.report], inputs)
    lock_outputs(output if in_folder else targets[0])
    select(run.backend)
    work = partial(
        _pack, run=run, image=image, maps=maps, encoding=encoding, drop=max_psnr_drop, levels=levels
    )
    records = for_each(in_folder, work, files, targets)
    figures = {"sets": [r for r in records if r]} if in_folder else records[0] or {}
    run.write_report(figures | {"max_psnr_drop": max_psnr_drop})
    exit_if_failed(records)


def _pack(
    file: Path,
    target: Path,
    *,
    run: options.Run,
    image: Path | None,
    maps: dict[str, options.MapFile],
    encoding: str | None,
    drop: float,
    levels: int | tuple[int, ...] | None,
) -> Record:
    """Pack one set into a file, and return its figures."""
    from ..gaussian.file import LIGHTS, kind_of

    before = file.stat().st_size
    if kind_of(file) == LIGHTS:
        if image or maps or levels:
            raise ValueError(f"{file}: a model of lights takes no --image, --map and --levels")
        model = eg.Relightable.load(file, run.backend)
        gaussians, packed = model.planes, eg.pack(model, target, max_psnr_drop=drop)
        left_out = model.psnr_held_out - packed.psnr_drop
        compared = " of left-out lights" + (f": psnr_rgb {left_out:.2f} dB" * isfinite(left_out))
    else:
        gaussians = eg.Gaussians.load(file, run.backend)
        if maps and not gaussians.maps:
            raise ValueError(f"{file}: holds one image and no maps; give --image instead of --map")
        if image and gaussians.maps:
            raise ValueError(f"{file}: holds a material; give its images with --map NAME=FILE")
        if levels is not None and gaussians.maps:
            raise ValueError(f"{file}: a material has no levels in .egs files; leave out --levels")
        images: Any = {name: m.path for name, m in maps.items()} or image
        counts = eg.level_counts(len(gaussians), 1 if levels is None else levels)
        sections = [n - fewer for fewer, n in zip([0, *counts], counts, strict=False)]
        packed = eg.pack(gaussians, target, images, drop, sections, encoding=encoding)
        against = "the original" if images else "the rendering of the input"
        psnr = packed.psnr if isinstance(packed.psnr, dict) else {"": packed.psnr}
        values = ", ".join(f"{key} {value:.2f} dB".strip() for key, value in psnr.items())
        name = "psnr_rgb" if gaussians.maps else gaussians.space.comparable_name
        compared = f"; {name} against {against}: {values}"
    figures: Record = {"input": file, "output": target, "bytes_before": before, **packed._asdict()}
    figures |= {"gaussians": len(packed.gaussians), "steps": packed.steps._asdict()}
    run.tell(
        f"{file}: {len(gaussians):,} Gaussians, {before:,} bytes",
        f"  wrote {target}: {packed.bytes:,} bytes, {packed.bits_per_pixel:.3f} bits per pixel",
        f"  lost {packed.psnr_drop:.2f} dB{compared}",
    )
    return figures
