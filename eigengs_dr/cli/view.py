"""The command ``eigengs-dr view``: a page for the browser."""

from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from ..fitting.options import Levels
from . import options
from .outputs import check_outputs, name_outputs

SUFFIXES = (".html", ".htm")


@click.command()
@click.argument("file", type=click.Path(path_type=Path), metavar="NAME|FILE")
@click.option(
    "-o",
    "--output",
    type=options.ANY_PATH,
    metavar="PAGE.html",
    help="Page.  [default: in this folder]",
)
@click.option(
    "--image",
    type=options.IMAGE,
    help="The photo, to compare with; a model encodes it and moves it.",
)
@options.encoding_option
@click.option("--map", "name", metavar="NAME", help="The map of a material to show.")
@click.option(
    "--levels",
    type=options.LEVEL_COUNTS,
    help="Levels of the fit, as for fit.  [default: the sections of an .egs file]",
)
@click.option("--open", "opens", is_flag=True, help="Open the page in the browser.")
@options.backend_option
@options.quiet_option
def view(
    file: Path,
    output: Path | None,
    image: Path | str | None,
    encoding: str | None,
    name: str | None,
    levels: Levels | None,
    opens: bool,
    backend: str | None,
    quiet: bool,
) -> None:
    """Make a page for the browser that draws a fitted image or a model.

    NAME is a basis of the package, such as natural. The page is one file and needs no network. It
    draws as "render" does, at any zoom. It shows outlines, the first Gaussians alone, and the
    parameters of the one under the pointer. With --image, a divider wipes between the Gaussians
    and the photo. For a model, it has sliders for the first components, and draws random images.

    \b
    Examples:
      eigengs-dr view photo.npz --open
      eigengs-dr view photo.npz --image photo.jpg -o photo.html
      eigengs-dr view levels.npz --levels 4
      eigengs-dr view bark.npz --map roughness
      eigengs-dr view natural --image photo.jpg -o natural.html
    """
    [page] = name_outputs([file], output, SUFFIXES)
    check_outputs([page], [file, *([image] if image else [])])
    select(backend)
    from ..image.color import rendered_as
    from ..image.io import read_file
    from ..viewer.view import view as make_page

    source, counts = _load(file, name, levels, backend)
    grey = rendered_as(getattr(source, "space", "rgb")) is None
    pixels: Any = read_file(image, grey, encoding) if image else None
    try:
        made = make_page(source, pixels, levels=counts, title=file.stem)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    made.save(page)
    if not quiet:
        click.echo(f"{file}: wrote {page} ({len(made.html):,} bytes)")
    if opens:
        click.launch(str(page))


def _load(
    file: Path, name: str | None, levels: Levels | None, backend: str | None
) -> tuple[Any, list[int]]:
    """Return the set or the model of a file or a name, and the Gaussians up to each level.

    The file may be hostile: a set is counted before it is read.
    """
    from itertools import accumulate

    from ..codec import egs
    from ..eigenbasis import model_file
    from ..eigenbasis.eigengs import SHIPPED, EigenGS
    from ..fitting.options import level_counts
    from ..gaussian import file as set_file
    from ..gaussian.gaussians import Gaussians
    from ..storage import npz
    from ..storage.atomic import reader_of
    from ..viewer.view import check_count

    file = SHIPPED.get(str(file), file)
    sections = egs.section_counts(file) if reader_of(file) else []
    if not sections and npz.format_of(file) == model_file.FORMAT:
        for option, value in (("--levels", levels), ("--map", name)):
            if value is not None:
                raise ValueError(f"{file}: is a model; leave {option} out")
        return EigenGS.load(file, backend), []
    try:
        check_count(sum(sections) or set_file.read_head(file).gaussians)
        gaussians = Gaussians.from_data(set_file.read_map(file, name, "--map"), backend)
        if levels is not None:
            return gaussians, level_counts(len(gaussians), levels)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(file)) else f"{file}: {error}") from None
    is_whole = len(sections) < 2 or set_file.maps_of(file)
    return gaussians, [] if is_whole else list(accumulate(sections))
