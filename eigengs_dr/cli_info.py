"""``eigengs-dr info``: what a file holds."""

import json
from pathlib import Path
from typing import Any

import click

from .backend import select
from .cli_shared import ANY_PATH, EXISTING, checked_pixels, json_option
from .outputs import check_outputs, name_outputs


@click.command()
@click.argument("file", type=EXISTING, metavar="FILE")
@json_option
@click.option("--preview", type=ANY_PATH, help="Picture of what the file holds.")
def info(file: Path, as_json: bool, preview: Path | None) -> None:
    """Show what a fitted image or a model holds.

    The preview of a fitted image is its rendering. That of a model shows the mean image, some
    components and the outlines of the Gaussians.

    \b
    Examples:
      eigengs-dr info photo.npz
      eigengs-dr info photo.npz --json
      eigengs-dr info model.npz --preview components.png
    """
    from .images import SAVE_OPTIONS, save_image

    [picture] = name_outputs([file], preview, list(SAVE_OPTIONS)) if preview else [None]
    check_outputs([picture], [file])
    select()
    from . import archive, gaussians, modelfile
    from .eigengs import EigenGS
    from .pictures import component_sheet

    kinds: dict[str, tuple[str, Any, Any, Any]] = {
        gaussians.FORMAT: ("image", gaussians.Gaussians.load, _describe_image, _rendered),
        modelfile.FORMAT: ("model", EigenGS.load, _describe_model, component_sheet),
    }
    found = archive.format_of(file)
    if found not in kinds:
        raise ValueError(f"{file}: format is {found[:40]!r}, expected one of {', '.join(kinds)}")
    kind, load, describe, draw = kinds[found]
    content = load(file)
    facts = {"file": str(file), "kind": kind, "bytes": file.stat().st_size, **describe(content)}
    if picture:
        save_image(picture, draw(content))
    width = max(map(len, facts)) + 1
    text = "\n".join(f"{key:{width}} {value}" for key, value in facts.items())
    click.echo(json.dumps(facts, indent=2) if as_json else text)


def _describe_image(gaussians: Any) -> dict[str, Any]:
    return {
        "gaussians": len(gaussians),
        "width": gaussians.width,
        "height": gaussians.height,
        "channels": gaussians.channels,
        "space": gaussians.space,
    }


def _describe_model(model: Any) -> dict[str, Any]:
    facts = _describe_image(model.gaussians) | {
        "components": list(model.components),
        "frequency_aware": model.low > 0,
    }
    if model.low:
        facts["low_gaussians"] = model.low
        facts["high_gaussians"] = len(model.gaussians) - model.low
        facts["low_components"] = model.low_components
    return facts


def _rendered(gaussians: Any) -> Any:
    from .rendering import picture_of

    checked_pixels(gaussians.width, gaussians.height)
    return picture_of(gaussians)
