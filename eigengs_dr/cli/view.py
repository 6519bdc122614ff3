"""The command ``eigengs-dr view``: a page for the browser."""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path
from typing import Any

import click

import eigengs_dr as eg

from ..backend.selection import select
from ..backend.types import Record
from ..codec import egs
from ..gaussian import file as set_file
from . import options
from .console import prefix_errors, print_message
from .outputs import check_outputs, lock_outputs, name_outputs

SUFFIXES = (".html", ".htm")


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="NAME|FILE")
@options.output("Page to write.  [default: in the current folder]", "PAGE.html", required=False)
@options.value(
    "--image",
    "IMAGE",
    options.image,
    "Photo to compare with, or for a model to start from.",
)
@options.encoding
@options.value("--light", "X,Y,Z", options.light, "Light at first, or that of the photo.")
@click.option("--map", "name", metavar="NAME", help="Map of a material to show.")
@options.level_counts("Levels, as in fit.  [default: sections of an .egs file]")
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@options.shared("backend", "quiet")
def view(
    run: options.Run,
    file: Path,
    output: Path | None,
    image: Path | None,
    encoding: str | None,
    light: tuple[float, ...] | None,
    name: str | None,
    levels: int | tuple[int, ...] | None,
    opens: bool,
) -> None:
    """Make a page for the browser that draws a fitted image or a model.

    NAME is a basis of the package, such as natural. The page is one file and needs no network. It
    draws the picture of "render" at any zoom, outlines, the first Gaussians, and the parameters of
    the one under the pointer. With --image, a divider wipes to the photo. A model has sliders for
    its first components, and draws random images; the light of a model of lights follows the
    pointer, and a photo of it needs --light.

    \b
    Examples:
      eigengs-dr view photo.npz --image photo.jpg --open
      eigengs-dr view levels.npz --levels 4
      eigengs-dr view natural --image photo.jpg -o natural.html
    """
    if encoding and not image:
        raise ValueError("--encoding needs --image")
    [page] = name_outputs([file], output, SUFFIXES)
    check_outputs([page], [file, *([image] if image else [])])
    lock_outputs(page)
    select(run.backend)
    source, counts = _load(file, name, levels, run.backend)
    is_lit = isinstance(source, eg.Relightable)
    if image and is_lit and light is None:
        raise ValueError(f"{file}: is a model of lights; give --light X,Y,Z, that of {image}")
    if light is not None and not is_lit:
        raise ValueError(f"{file}: is no model of lights; leave out --light")
    choices: Record = {"levels": counts, "title": file.stem, "encoding": encoding, "light": light}
    photo: Any = image
    with prefix_errors(file):
        result = eg.view(source, photo, **choices)
    result.save(page)
    run.tell(f"{file}: wrote {page} ({page.stat().st_size:,} bytes)")
    if opens and click.launch(str(page)):
        print_message(f"note: no program opens {page}; open it in a browser")


def _load(
    file: Path, name: str | None, levels: int | tuple[int, ...] | None, backend: str | None
) -> tuple[Any, list[int]]:
    """Return the set or the model of a file or a name, and the Gaussians up to each level.

    The file need not be trusted: the number of Gaussians is checked before they are read.
    """
    from ..eigenbasis.files import MODEL_FORMAT
    from ..viewer.view import check_count

    file = options.file_of(file)
    options.refuse_folder(file)
    if set_file.kind_of(file) in (MODEL_FORMAT, set_file.LIGHTS):
        if levels is not None or name is not None:
            raise ValueError(f"{file}: is a model; leave out --levels and --map")
        return eg.load(file, backend), []
    sections = egs.section_counts(file) if egs.is_packed(file) else []
    with prefix_errors(file):
        check_count(sum(sections) or set_file.read_head(file)[0])
        gaussians = eg.Gaussians.from_data(set_file.read_map(file, name, "--map"), backend)
        if levels is not None:
            return gaussians, eg.level_counts(len(gaussians), levels)
    return gaussians, list(accumulate(sections)) if len(sections) > 1 else []
