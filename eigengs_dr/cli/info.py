"""The command ``eigengs-dr info``: show the contents of a file."""

import json
from math import isfinite
from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from . import options
from .console import table
from .outputs import check_outputs, name_pictures


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="NAME|FILE")
@options.json_option
@click.option("--preview", type=options.ANY_PATH, help="Picture of the contents.")
def info(file: Path, as_json: bool, preview: Path | None) -> None:
    """Show the contents of a fitted image, a material or a model.

    NAME is a basis of the package, such as natural. For a fitted image, bpp is the size of the
    file in bits per pixel, and a table shows what each array takes. The PSNR, the steps and the
    source are those of the fit. For a packed image, the command also shows the steps of the
    quantisation.

    For a material, a table shows its maps; bpp is for all of them together.

    For a model, a table shows the first components of all channels in order of variance: their
    share of the variance, and the PSNR of PCA with them, for the training images and for the
    images held out.

    The preview shows the rendered image, or the mean image, some components and the outlines of
    the Gaussians of a model.

    \b
    Examples:
      eigengs-dr info photo.npz
      eigengs-dr info photo.egs --json
      eigengs-dr info natural
      eigengs-dr info model.npz --preview components.png
    """
    [picture] = name_pictures([file], preview)
    check_outputs([picture], [file])
    select()
    from ..codec import egs
    from ..eigenbasis import model_file
    from ..eigenbasis.eigengs import SHIPPED, EigenGS
    from ..gaussian import file as set_file
    from ..gaussian.gaussians import Gaussians
    from ..storage import npz
    from ..storage.atomic import reader_of

    file = SHIPPED.get(str(file), file)
    packed = bool(reader_of(file))
    kinds = {
        set_file.FORMAT: "image",
        set_file.MATERIAL: "material",
        model_file.FORMAT: "model",
    }
    found = set_file.FORMAT if packed else npz.format_of(file)
    if found not in kinds:
        raise ValueError(f"{file}: format is {found[:40]!r}, expected one of {', '.join(kinds)}")
    kind = "material" if packed and set_file.maps_of(file) else kinds[found]
    facts: dict[str, Any] = {"file": str(file), "kind": kind, "bytes": file.stat().st_size}
    if kind == "model":
        facts |= _describe_model(EigenGS.load(file))
    elif packed:
        gaussians = Gaussians.load(file)
        size = gaussians.width, gaussians.height
        facts |= _describe_set(gaussians, len(gaussians), size)
    else:  # the head alone: a large set takes gigabytes
        head = set_file.read_head(file)
        facts |= _describe_set(head, head.gaussians, head.size)
        if kind == "image" and (figures := set_file.read_figures(file)):
            facts |= _describe_figures(figures)
    if kind != "model":
        facts["bpp"] = round(8 * facts["bytes"] / (facts["width"] * facts["height"]), 4)
    if packed:
        facts |= _describe_packed(egs.read(file))
    else:
        facts["ledger"] = npz.sizes_of(file)
    if picture:
        _draw(file, kind, picture)
    click.echo(json.dumps(facts, indent=2) if as_json else _text(**facts))


def _describe_set(found: Any, count: int, size: tuple[int, int]) -> dict[str, Any]:
    """Describe a set, or the head of its file; maps have spaces of their own."""
    facts = {"gaussians": count, "width": size[0], "height": size[1], "channels": found.channels}
    if found.maps:
        return facts | {"cutoff": found.cutoff, "maps": [m._asdict() for m in found.maps]}
    return facts | {"space": found.space, "cutoff": found.cutoff}


def _describe_figures(figures: Any) -> dict[str, Any]:
    """Describe the fit of a set; JSON has no infinity."""
    psnr = {"psnr_ycbcr": figures.psnr_ycbcr, "psnr_rgb": figures.psnr_rgb}
    shown = {name: round(v, 2) if isfinite(v) else str(v) for name, v in psnr.items()}
    return {**shown, "iterations": figures.iterations, "source": figures.source}


def _describe_packed(content: Any) -> dict[str, Any]:
    """Return the Gaussians of each section and the quantisation steps."""
    steps = {f"{name}_step": float(f"{x:.4g}") for name, x in content.steps._asdict().items()}
    return {"sections": [len(section.cell) for section in content.sections], **steps}


def _describe_model(model: Any) -> dict[str, Any]:
    size = model.gaussians.width, model.gaussians.height
    facts = _describe_set(model.gaussians, len(model.gaussians), size)
    facts |= {"components": list(model.components), "frequency_aware": model.low > 0}
    if model.low:
        facts["low_gaussians"] = model.low
        facts["high_gaussians"] = len(model.gaussians) - model.low
        facts["low_components"] = model.low_components
    if curve := model.truncation_curve():
        facts["truncation"] = _rows(curve, model.held_out)
    return facts


def _rows(curve: Any, held_out: Any) -> list[dict[str, Any]]:
    """Return the truncation curve at 0, 1, 2, 5, 10, ... and all components."""
    last = len(curve.psnr) - 1
    round_numbers = [m * 10**e for e in range(len(str(last))) for m in (1, 2, 5)]
    share = curve.explained_variance_ratio()
    return [
        {
            "components": curve.counts[n].tolist(),
            "variance": round(float(share[n]), 6),
            "psnr_training": round(float(curve.psnr[n]), 3),
        }
        | ({"psnr_held_out": round(float(held_out[n]), 3)} if len(held_out) else {})
        for n in sorted({0, *(n for n in round_numbers if n < last), last})
    ]


def _text(truncation: Any = (), maps: Any = (), ledger: Any = (), **facts: Any) -> str:
    """Format facts as lines, and maps, arrays and the truncation curve as tables below."""
    width = max(map(len, facts)) + 1
    lines = [f"{key:{width}} {value}" for key, value in facts.items()]
    if maps:
        rows = [(m["name"], str(m["channels"]), m["space"], f"{m['weight']:.3g}") for m in maps]
        lines += ["", *table([("map", "channels", "space", "weight"), *rows])]
    if ledger:
        sizes = [(name[:16], f"{size:,}") for name, size in ledger.items()]
        lines += ["", *table([("array", "bytes"), *sizes])]
    if truncation:
        rows = [
            (
                f"{sum(row['components'])} = {'+'.join(map(str, row['components']))}",
                f"{row['variance']:.2%}",
                f"{row['psnr_training']:.2f} dB",
                f"{row['psnr_held_out']:.2f} dB" if "psnr_held_out" in row else "-",
            )
            for row in truncation
        ]
        lines += ["", *table([("components", "variance", "training", "held out"), *rows])]
    return "\n".join(lines)


def _draw(file: Path, kind: str, picture: Path) -> None:
    """Write the picture of a set, of its maps side by side, or of a model."""
    from ..blocks.draw import save_region
    from ..eigenbasis.eigengs import EigenGS
    from ..gaussian.file import read
    from ..gaussian.gaussians import Gaussians
    from ..image.io import save_image
    from ..image.resize import join_pictures
    from ..raster.render import picture_of
    from ..viewer.pictures import component_sheet

    if kind == "image":
        data = read(file)
        options.check_pixels(*data.size)
        save_region(picture, data, (0, 0, *data.size), data.size)
    elif kind == "model":
        save_image(picture, component_sheet(EigenGS.load(file)))
    else:
        shown = picture_of(Gaussians.load(file)).values()
        in_rgb = [image.repeat(3 // image.shape[2], axis=2) for image in shown]
        save_image(picture, join_pictures(in_rgb, 1))
