"""Options of several commands, and what their texts may be."""

import glob
import re
from pathlib import Path
from typing import Any, NamedTuple

import click

from ..image.color import SPACES
from ..image.pixels import ENCODINGS
from ..image.remote import is_url
from ..storage.atomic import refuse_url

EXISTING = click.Path(exists=True, dir_okay=False, path_type=Path)

MAX_PIXELS = 1 << 29
"""Pixels of the largest picture to render, except into TIFF files; it takes 3 bytes a pixel."""

MAX_SIDE = 1 << 17
"""Longest side of a picture to render into a TIFF file."""


class PathOrUrl(click.Path):
    """A path, or a URL, which is passed as text."""

    def convert(self, value: Any, parameter: Any, context: Any) -> Any:
        """Return a `Path`, or the text of a URL."""
        return value if is_url(value) else super().convert(value, parameter, context)


class ImageSource(PathOrUrl):
    """An image file, a folder of images, a pattern such as "a/*.png", or a URL of one of them."""

    def convert(self, value: Any, parameter: Any, context: Any) -> Any:
        """Return a `Path`, or the text of a URL; a pattern need not exist."""
        pattern = glob.has_magic(str(value)) and not (is_url(value) or Path(value).exists())
        return Path(value) if pattern else super().convert(value, parameter, context)


class OutputPath(click.Path):
    """A file or a folder to write, which is no URL."""

    def convert(self, value: Any, parameter: Any, context: Any) -> Any:
        """Return a Path; a URL would become a strange folder of this one."""
        try:
            refuse_url(value)
        except OSError as error:
            self.fail(str(error), parameter, context)
        return super().convert(value, parameter, context)


IMAGE = PathOrUrl(exists=True, dir_okay=False, path_type=Path)
IMAGES = ImageSource(exists=True, path_type=Path)
FOLDER = PathOrUrl(exists=True, file_okay=False, path_type=Path)
ANY_PATH = OutputPath(path_type=Path)


class Numbers(click.ParamType):
    """Whole numbers with a sign between them, whose text matches a pattern."""

    def __init__(self, name: str, pattern: str, expected: str) -> None:
        self.name, self._pattern, self._expected = name, pattern, expected

    def convert(self, value: Any, parameter: Any, context: Any) -> Any:
        """Parse the text of an option as one number or several."""
        if not isinstance(value, str):  # the default
            return value
        if not re.fullmatch(self._pattern, value):
            self.fail(f"{value}: expected {self._expected}", parameter)
        numbers = tuple(map(int, re.split("[,x]", value)))
        return numbers if len(numbers) > 1 else numbers[0]


class Size(Numbers):
    """Width and height in pixels, as in "1024x768"."""

    def __init__(self) -> None:
        super().__init__("WxH", r"\d+x\d+", "width and height, such as 1024x768")

    def convert(self, value: Any, parameter: Any, context: Any) -> tuple[int, int]:
        """Parse the text of an option as two numbers."""
        return check_pixels(*super().convert(value, parameter, context))


COUNTS = Numbers("K", r"(?=.*[1-9])\d+(,\d+,\d+)?", "a number above 0, or three such as 230,60,60")
"""One number for all channels, or three."""

LEVEL_COUNTS = Numbers(
    "N|N,N,...", r"\d{1,18}(,\d{1,18})*", "a number, or several such as 5000,7000,9000"
)
"""A number of levels, or the numbers of Gaussians up to each."""

REGION = Numbers(
    "X,Y,W,H",
    r"\d+,\d+,0*[1-9]\d*,0*[1-9]\d*",
    "left, top, width and height, such as 100,50,640,480",
)
"""A part of an image, in pixels."""


class MapFile(NamedTuple):
    """The image file of a map, and its space if it is not the usual one."""

    name: str
    path: Path | str
    space: str | None


class MapOption(click.ParamType):
    """A name and a file, as in "albedo=bark.jpg", or a name, a space and a file."""

    name = "NAME[:SPACE]=FILE"

    def convert(self, value: Any, parameter: Any, context: Any) -> MapFile:
        """Parse the text of an option."""
        from ..gaussian.channels import NAME

        left, sign, file = value.partition("=")
        name, colon, space = left.partition(":")
        if not (sign and file and NAME.fullmatch(name)):
            self.fail(f"{value}: expected a name and a file, such as albedo=bark.jpg", parameter)
        if colon and space not in SPACES:
            self.fail(f"{value}: space {space!r} is not in {', '.join(SPACES)}", parameter)
        if not is_url(file) and not Path(file).is_file():
            self.fail(f"{file}: no such file", parameter)
        return MapFile(name, file if is_url(file) else Path(file), space or None)


def by_name(
    context: click.Context, parameter: click.Parameter, maps: tuple[MapFile, ...]
) -> dict[str, MapFile]:
    """Return maps by their names; a name may occur once."""
    found = {item.name: item for item in maps}
    names = [item.name for item in maps]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise click.UsageError(f"--map {twice} is given twice; give each name once")
    return found


def check_pixels(width: int, height: int, by_parts: bool = False) -> tuple[int, int]:
    """Return the width and height of a picture; refuse one that is too large to render.

    A picture that is written by parts may be larger than one that is held in memory.
    """
    if by_parts:
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise click.UsageError(f"{width}x{height}: expected sides of 1 to {MAX_SIDE:,} pixels")
    elif width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise click.UsageError(
            f"{width}x{height}: expected 1 to {MAX_PIXELS:,} pixels, or a .tif file"
        )
    return width, height


def choice(name: str, values: list[str], text: str) -> Any:
    """Make an option that takes one of several words; the first is the default."""
    return click.option(name, type=click.Choice(values), default=values[0], help=text)


def number(name: str, text: str, default: float | None = None, least: int | None = None) -> Any:
    """Make an option that takes a whole number, from `least` on if that is given."""
    kind = int if least is None else click.IntRange(min=least)
    return click.option(name, type=kind, metavar="N", default=default, help=text)


def output(text: str, metavar: str | None = None) -> Any:
    """Make the option of the file or folder to write."""
    kind: Any = {"type": ANY_PATH, "metavar": metavar, "help": text}
    return click.option("-o", "--output", required=True, **kind)


backend_option = click.option(
    "--backend",
    type=click.Choice(["llvm", "cuda"]),
    help="Processor.  [default: cuda if present]",
)
seed_option = number("--seed", "Seed of random numbers.", 0, 0)
report_option = click.option("--report", type=ANY_PATH, help="JSON file of all figures.")
quiet_option = click.option("--quiet", is_flag=True, help="Show no progress and no summary.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
cluster_option = click.option(
    "--cluster",
    metavar="local[:N]|tcp://HOST:PORT|FILE",
    help="Work on N processes here, or on a Dask cluster.",
)
encoding_option = click.option(
    "--encoding",
    type=click.Choice(ENCODINGS),
    help="What the pixels are.  [default: linear in files of floats, else srgb]",
)


def maps_option(text: str) -> Any:
    """Make the option that names image files of maps."""
    return click.option(
        "--map", "maps", multiple=True, type=MapOption(), callback=by_name, help=text
    )
