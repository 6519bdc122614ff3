"""The command ``eigengs-dr info``: show the contents of a file."""

from __future__ import annotations

import json
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

import click

import eigengs_dr as eg

from ..backend.messages import printable
from ..backend.selection import select
from ..backend.types import Record
from ..codec.egs import is_packed, read_egs_head, section_counts
from ..gaussian.file import SetData, read_figures
from ..storage import npz
from . import options
from .console import exit_if_failed, for_each, table
from .outputs import check_outputs, name_pictures
from .scene import load_mitsuba, scene_errors


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="NAME|FILE|FOLDER")
@options.as_json
@options.value("--preview", "FILE", options.path, "Picture of the contents.")
@click.option("--texture", is_flag=True, help="Also show the memory of a Mitsuba texture.")
def info(file: Path, as_json: bool, preview: Path | None, texture: bool) -> None:
    """Show the contents of a fitted image, a material or a model.

    NAME is a basis of the package, such as natural. PSNR, steps and source are those of the fit;
    bpp is the size of the file in bits per pixel, for all maps together.

    Of a model, a table shows the first components by variance: their share of it, and the PSNR of
    PCA with them, for training and held-out images. Of a model of lights, the command shows the
    number of planes, and the PSNR of left-out lights.

    With --texture, texture_bytes is the memory of a gaussian_texture for lookups at points,
    prefilter_bytes with a prefilter, and small_bytes with memory = small.

    The preview shows the image, or the mean image, some components and the outlines of a model.

    Of a folder, a table has a row for each .npz and .egs file. There psnr is psnr_rgb of a fit,
    psnr_ycbcr if it has none, or that of left-out lights. --preview names a folder.

    \b
    Examples:
      eigengs-dr info natural
      eigengs-dr info photo.npz --texture
      eigengs-dr info model.npz --preview components.png
      eigengs-dr info fits/ --json
    """
    select()
    file = options.file_of(file)
    files, in_folder = options.sets_in(file), file.is_dir()
    pictures = name_pictures(files, preview, in_folder)
    check_outputs(pictures, files)
    facts = for_each(in_folder, partial(_facts_of, texture=texture), files, pictures)
    found = [known for known in facts if known]
    if as_json:
        click.echo(json.dumps(found if in_folder else found[0], indent=2))
    elif in_folder and found:
        columns = ["file", "kind", "size", "gaussians", "bytes", "psnr"]
        columns += TEXTURE_COLUMNS if texture else ()
        click.echo("\n".join(table([columns, *(_row(**known) for known in found)])))
    elif found:
        click.echo(_text(**found[0]))
    exit_if_failed(facts)


def _facts_of(file: Path, picture: Path | None, texture: bool) -> Record:
    """Return what a file holds, and draw it."""
    content, packed = eg.load(file), is_packed(file)
    if isinstance(content, eg.Eigenbasis):
        raise ValueError(f"{file}: is a basis, which EigenGS.fit takes; give a model")
    if isinstance(content, eg.EigenGS):
        kind, found = "model", _describe_model(content)
    elif isinstance(content, eg.Relightable):
        kind, found = "lights", _describe_lights(content)
    else:
        kind, found = "material" if content.maps else "image", _describe_set(content.data())
        found |= _packing_of(file) if packed else _fit_of(file) if not content.maps else {}
    facts: Record = {"file": str(file), "kind": kind, "bytes": file.stat().st_size} | found
    if kind != "model":
        facts["bpp"] = round(8 * facts["bytes"] / (facts["width"] * facts["height"]), 4)
    if texture:
        key = "model" if kind in ("model", "lights") else "filename"
        facts |= _load_textures(key, **facts)
    if not packed:
        facts["ledger"] = npz.sizes_of(file)
    if picture:
        options.check_pixels(facts["width"], facts["height"])
        _draw(content, picture)
    return facts


def _describe_set(data: SetData) -> Record:
    """Describe a set; each map has its own space."""
    count, channels = data.arrays["color"].shape
    facts: Record = {"gaussians": count, "width": data.size[0], "height": data.size[1]}
    facts |= {"channels": channels, "cutoff": data.cutoff}
    if data.maps:
        return facts | {"maps": [m._asdict() for m in data.maps]}
    return facts | {"space": data.space}


def _fit_of(file: Path) -> Record:
    """Describe the fit of a set, if its file does."""
    figures = read_figures(file)
    if figures is None:
        return {}
    facts: Record = {}
    for name in ("psnr_ycbcr", "psnr_rgb"):  # JSON has no infinity
        if (value := getattr(figures, name)) is not None:
            facts[name] = round(value, 2) if isfinite(value) else str(value)
    facts |= {"iterations": figures.iterations, "source": figures.source}
    return {name: value for name, value in facts.items() if value is not None}


def _packing_of(file: Path) -> Record:
    """Describe a packed set: the Gaussians of each section, and the quantisation steps."""
    head = read_egs_head(file)
    steps = {f"{name}_step": float(f"{x:.4g}") for name, x in head.steps._asdict().items()}
    facts = {"sections": section_counts(file)} | steps
    return facts | ({"psnr": round(head.psnr, 2)} if isfinite(head.psnr) else {})


def _describe_model(model: eg.EigenGS) -> Record:
    facts = _describe_set(model.gaussians.data())
    facts |= {"components": list(model.components), "frequency_aware": model.low > 0}
    if model.low:
        facts |= {"low_gaussians": model.low, "high_gaussians": len(model.gaussians) - model.low}
        facts["low_components"] = model.low_components
    if truncation := _truncation(model):
        facts["truncation"] = truncation
    return facts


def _describe_lights(model: eg.Relightable) -> Record:
    facts = _describe_set(model.planes.data()) | {"planes": model.planes.channels}
    facts |= {"lights": len(model.lights), "table": model.table.kind}
    known = isfinite(model.psnr_held_out)
    return facts | ({"psnr_held_out": round(model.psnr_held_out, 2)} if known else {})


def _truncation(model: eg.EigenGS) -> list[Record]:
    """Return the truncation curve at 0, 1, 2, 5, 10, ... and all components."""
    curve = model.truncation_curve()
    if curve is None:
        return []
    last, share = len(curve.psnr) - 1, curve.explained_variance_ratio()
    round_numbers = [m * 10**e for e in range(len(str(last))) for m in (1, 2, 5)]
    rows = []
    for n in sorted({0, *(n for n in round_numbers if n < last), last}):
        row = {"components": curve.counts[n].tolist(), "variance": round(float(share[n]), 6)}
        row["psnr_training"] = round(float(curve.psnr[n]), 3)
        if len(model.held_out):
            row["psnr_held_out"] = round(float(model.held_out[n]), 3)
        rows.append(row)
    return rows


def _load_textures(key: str, file: str, maps: Any = (), **_: Any) -> Record:
    """Return the memory of textures of a file in bytes, by some of their properties."""
    mi = load_mitsuba(None, quiet=True)
    from ..plugins import resident_bytes

    source = {"type": "gaussian_texture", key: file} | ({"map": maps[0]["name"]} if maps else {})
    with scene_errors(Path(file)):  # one at a time: textures of a file share memory
        return {
            name: resident_bytes(mi.load_dict(source | kind))
            for name, kind in TEXTURE_COLUMNS.items()
        }


TEXTURE_COLUMNS: dict[str, Record] = {
    "texture_bytes": {},
    "prefilter_bytes": {"prefilter": 1e-3},
    "small_bytes": {"memory": "small"},
}
"""Figures of textures, and the properties that each is for."""


def _row(
    file: str, kind: str, width: int, height: int, gaussians: int, bytes: int, **facts: Any
) -> list[str]:
    """Format facts as a row, with the first PSNR that the file holds."""
    names = ("psnr_rgb", "psnr_ycbcr", "psnr", "psnr_held_out")
    known = [float(facts[name]) for name in names if facts.get(name, "nan") != "nan"]
    cells = [Path(file).name, kind, f"{width}x{height}", f"{gaussians:,}", f"{bytes:,}"]
    cells.append(f"{known[0]:.2f}" if known else "-")
    return cells + [f"{facts[name]:,}" for name in TEXTURE_COLUMNS if name in facts]


def _text(truncation: Any = (), maps: Any = (), ledger: Any = (), **facts: Any) -> str:
    """Format facts as lines, and maps, arrays and the truncation curve as tables below."""
    width = max(map(len, facts)) + 1
    lines = [f"{key:{width}} {printable(str(value))}" for key, value in facts.items()]
    if maps:
        rows = [(m["name"], str(m["channels"]), m["space"], f"{m['weight']:.3g}") for m in maps]
        lines += ["", *table([("map", "channels", "space", "weight"), *rows])]
    if ledger:
        sizes = [(printable(name[:16]), f"{size:,}") for name, size in ledger.items()]
        lines += ["", *table([("array", "bytes"), *sizes])]
    if truncation:
        rows = [("components", "variance", "training", "held out")]
        for row in truncation:
            counts = row["components"]
            name = f"{sum(counts)} = {'+'.join(map(str, counts))}"
            psnrs = [row["psnr_training"], row.get("psnr_held_out")]
            cells = ["-" if value is None else f"{value:.2f} dB" for value in psnrs]
            rows.append((name, f"{row['variance']:.2%}", cells[0], cells[1]))
        lines += ["", *table(rows)]
    return "\n".join(lines)


def _draw(content: Any, picture: Path) -> None:
    """Write the picture of a set, of its maps side by side, or of a model."""
    from ..image.sheet import join_pictures
    from ..viewer.pictures import component_sheet

    pixels: Any
    if isinstance(content, eg.EigenGS):
        pixels = component_sheet(content)
    elif isinstance(content, eg.Relightable):
        pixels = eg.picture_of(content.relight((0, 0, 1)))
    else:
        pixels = eg.picture_of(content)
    if isinstance(pixels, dict):
        in_rgb = [image.repeat(3 // image.shape[2], axis=2) for image in pixels.values()]
        pixels = join_pictures(in_rgb, 1)
    eg.save_image(picture, pixels)
