"""The command ``eigengs-dr info``: show the contents of a file."""

import json
from math import isfinite
from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from .options import ANY_PATH, check_pixels, json_option
from .outputs import check_outputs, name_outputs


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="NAME|FILE")
@json_option
@click.option("--preview", type=ANY_PATH, help="Picture of the contents.")
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
    from ..image.io import SAVE_OPTIONS

    [picture] = name_outputs([file], preview, list(SAVE_OPTIONS)) if preview else [None]
    check_outputs([picture], [file])
    select()
    from ..codec import egs as packed
    from ..eigenbasis import model_file as modelfile
    from ..eigenbasis.eigengs import SHIPPED, EigenGS
    from ..gaussian import file as setfile
    from ..gaussian.gaussians import Gaussians
    from ..storage import npz

    kinds: dict[str, tuple[str, Any, Any, Any]] = {
        setfile.FORMAT: ("image", Gaussians.load, _describe_set, _draw_image),
        setfile.MATERIAL: ("material", Gaussians.load, _describe_set, _draw_maps),
        modelfile.FORMAT: ("model", EigenGS.load, _describe_model, _draw_model),
    }
    file = SHIPPED.get(str(file), file)
    if packed.is_egs(file):
        file_format = setfile.MATERIAL if setfile.maps_of(file) else setfile.FORMAT
    else:
        file_format = npz.format_of(file)
    if file_format not in kinds:
        raise ValueError(
            f"{file}: format is {file_format[:40]!r}, expected one of {', '.join(kinds)}"
        )
    kind, load, describe, draw = kinds[file_format]
    facts: dict[str, Any] = {"file": str(file), "kind": kind, "bytes": file.stat().st_size}
    if kind != "model" and not packed.is_egs(file):
        facts |= _describe_head(setfile.read_head(file))
        figures = setfile.read_figures(file) if kind == "image" else None
        facts |= _describe_figures(figures) if figures else {}
    else:
        facts |= describe(load(file))
    if kind != "model":
        facts["bpp"] = round(8 * facts["bytes"] / (facts["width"] * facts["height"]), 4)
    if packed.is_egs(file):
        facts |= _describe_packed(packed.read(file))
    else:
        facts["ledger"] = npz.sizes_of(file)
    if picture:
        draw(file, picture)
    click.echo(json.dumps(facts, indent=2) if as_json else _text(**facts))


def _describe_set(gaussians: Any) -> dict[str, Any]:
    size = gaussians.width, gaussians.height
    return _facts_of(gaussians, len(gaussians), *size)


def _describe_head(head: Any) -> dict[str, Any]:
    """Describe a set that is not read: a large one takes gigabytes."""
    return _facts_of(head, head.gaussians, *head.size)


def _facts_of(found: Any, count: int, width: int, height: int) -> dict[str, Any]:
    """Describe a set, or the head of its file; maps have spaces of their own."""
    kind: dict[str, Any] = {} if found.maps else {"space": found.space}
    facts = {"gaussians": count, "width": width, "height": height, "channels": found.channels}
    maps = {"maps": [m._asdict() for m in found.maps]} if found.maps else {}
    return facts | kind | {"cutoff": found.cutoff} | maps


def _describe_figures(figures: Any) -> dict[str, Any]:
    """Describe the fit of a set; JSON has no infinity."""
    psnr = {"psnr_ycbcr": figures.psnr_ycbcr, "psnr_rgb": figures.psnr_rgb}
    shown = {name: round(v, 2) if isfinite(v) else str(v) for name, v in psnr.items()}
    return {**shown, "iterations": figures.iterations, "source": figures.source}


def _describe_packed(content: Any) -> dict[str, Any]:
    """Return the Gaussians of each section and the quantisation steps."""
    return {
        "sections": [len(section.cell) for section in content.sections],
        **{f"{name}_step": float(f"{step:.4g}") for name, step in content.steps._asdict().items()},
    }


def _describe_model(model: Any) -> dict[str, Any]:
    facts = _describe_set(model.gaussians) | {
        "components": list(model.components),
        "frequency_aware": model.low > 0,
    }
    if model.split_reason:
        facts["split_reason"] = model.split_reason
    if model.low:
        facts["low_gaussians"] = model.low
        facts["high_gaussians"] = len(model.gaussians) - model.low
        facts["low_components"] = model.low_components
    if fall := model.truncation_curve():
        facts["fall"] = _rows(fall, model.held_out)
    return facts


def _rows(fall: Any, held_out: Any) -> list[dict[str, Any]]:
    """Return the truncation curve at 0, 1, 2, 5, 10, ... and all components."""
    last = len(fall.psnr) - 1
    round_numbers = [m * 10**e for e in range(len(str(last))) for m in (1, 2, 5)]
    rows = []
    for n in sorted({0, *(n for n in round_numbers if n < last), last}):
        row = {
            "components": fall.counts[n].tolist(),
            "variance": round(float(fall.explained_variance_ratio()[n]), 6),
            "psnr_training": round(float(fall.psnr[n]), 3),
        }
        if len(held_out):
            row["psnr_held_out"] = round(float(held_out[n]), 3)
        rows.append(row)
    return rows


def _text(fall: Any = (), maps: Any = (), ledger: Any = (), **facts: Any) -> str:
    """Format facts as lines, and maps and the truncation curve as tables below."""
    width = max(map(len, facts)) + 1
    lines = [f"{key:{width}} {value}" for key, value in facts.items()]
    if maps:
        lines += ["", f"{'map':16} {'channels':>8} {'space':>9} {'weight':>8}"]
    for m in maps:
        row = "{name:16} {channels:8} {space:>9} {weight:8.3g}"
        lines.append(row.format(**m))
    if ledger:
        lines += ["", f"{'array':16} {'bytes':>12}"]
        lines += [f"{name[:16]:16} {size:12,}" for name, size in ledger.items()]
    if fall:
        lines += ["", f"components{'':16} {'variance':>8} {'training':>9} {'held out':>9}"]
    for row in fall:
        each = "+".join(map(str, row["components"]))
        held_out = f"{row['psnr_held_out']:6.2f} dB" if "psnr_held_out" in row else "-"
        lines.append(
            f"{sum(row['components']):10} = {each:13} {row['variance']:8.2%} "
            f"{row['psnr_training']:6.2f} dB {held_out:>9}"
        )
    return "\n".join(lines)


def _draw_image(file: Path, picture: Path) -> None:
    from ..blocks.draw import save_region
    from ..gaussian.file import read

    data = read(file)
    check_pixels(*data.size)
    save_region(picture, data, (0, 0, *data.size), data.size)


def _draw_maps(file: Path, picture: Path) -> None:
    from ..gaussian.gaussians import Gaussians
    from ..image.io import save_image
    from ..image.resize import join_pictures
    from ..raster.render import picture_of

    shown = picture_of(Gaussians.load(file)).values()
    save_image(picture, join_pictures([_as_rgb(image) for image in shown], 1))


def _as_rgb(image: Any) -> Any:
    return image.repeat(3 // image.shape[2], axis=2)


def _draw_model(file: Path, picture: Path) -> None:
    from ..eigenbasis.eigengs import EigenGS
    from ..image.io import save_image
    from ..viewer.sheets import component_sheet

    save_image(picture, component_sheet(EigenGS.load(file)))
