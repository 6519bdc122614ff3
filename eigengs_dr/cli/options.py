"""Options of several commands, and the record of a run in a report."""

import glob
import re
import shlex
from pathlib import Path
from typing import Any

import click

from ..backend.selection import describe
from ..image.pixels import ENCODINGS
from ..image.remote import is_url
from ..storage.atomic import refuse_url
from .console import NAME

EXISTING = click.Path(exists=True, dir_okay=False, path_type=Path)


class PathOrUrl(click.Path):
    """A path, or a URL, which is passed as text."""

    def convert(self, value: Any, param: Any, context: Any) -> Any:
        """Return a `Path`, or the text of a URL."""
        return value if is_url(value) else super().convert(value, param, context)


IMAGE = PathOrUrl(exists=True, dir_okay=False, path_type=Path)
FOLDER = PathOrUrl(exists=True, file_okay=False, path_type=Path)


class OutputPath(click.Path):
    """A file or a folder to write, which is no URL."""

    def convert(self, value: Any, parameter: Any, context: Any) -> Any:
        """Return a Path; a URL would become a strange folder of this one."""
        try:
            refuse_url(value)
        except OSError as error:
            self.fail(str(error), parameter, context)
        return super().convert(value, parameter, context)


ANY_PATH = OutputPath(path_type=Path)

MAX_PIXELS = 1 << 29
"""Pixels of the largest picture to render, except into TIFF files; it takes 3 bytes a pixel."""

MAX_SIDE = 1 << 17
"""Longest side of a picture to render into a TIFF file."""

backend_option = click.option(
    "--backend",
    type=click.Choice(["llvm", "cuda"]),
    help="Processor.  [default: cuda if present]",
)
seed_option = click.option(
    "--seed",
    type=click.IntRange(min=0),
    metavar="N",
    default=0,
    show_default=True,
    help="Seed of random numbers.",
)
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


class Size(click.ParamType):
    """Width and height in pixels, as in "1024x768"."""

    name = "WxH"

    def convert(self, value: Any, param: Any, context: Any) -> tuple[int, int]:
        """Parse the text of an option as two numbers."""
        match = re.fullmatch(r"(\d+)x(\d+)", value)
        if not match:
            self.fail(f"{value}: expected width and height, such as 1024x768", param, context)
        return check_pixels(int(match[1]), int(match[2]))


class ImageSource(PathOrUrl):
    """An image file, a folder of images, a pattern such as "a/*.png", or a URL of one of them."""

    def __init__(self) -> None:
        super().__init__(exists=True, path_type=Path)

    def convert(self, value: Any, param: Any, context: Any) -> Any:
        """Return a `Path`, or the text of a URL; a pattern need not exist."""
        pattern = glob.has_magic(str(value)) and not (is_url(value) or Path(value).exists())
        return Path(value) if pattern else super().convert(value, param, context)


class Numbers(click.ParamType):
    """One number, or several with commas, whose text matches a pattern."""

    def __init__(self, name: str, pattern: str, expected: str) -> None:
        self.name, self._pattern, self._expected = name, pattern, expected

    def convert(self, value: Any, param: Any, context: Any) -> int | tuple[int, ...]:
        """Parse the text of an option as one number or several."""
        if isinstance(value, int):  # the default
            return value
        if not re.fullmatch(self._pattern, value):
            self.fail(f"{value}: expected {self._expected}", param)
        numbers = tuple(map(int, value.split(",")))
        return numbers if len(numbers) > 1 else numbers[0]


COUNTS = Numbers("K", r"(?=.*[1-9])\d+(,\d+,\d+)?", "a number above 0, or three such as 230,60,60")
"""One number for all channels, or three."""

LEVEL_COUNTS = Numbers(
    "N|N,N,...", r"\d{1,18}(,\d{1,18})*", "a number, or several such as 5000,7000,9000"
)
"""A number of levels, or the numbers of Gaussians up to each."""


class Region(click.ParamType):
    """Left, top, width and height in pixels, as in "100,50,640,480"."""

    name = "X,Y,W,H"

    def convert(self, value: Any, param: Any, context: Any) -> tuple[int, int, int, int]:
        """Parse the text of an option as four numbers."""
        match = re.fullmatch(r"(\d+),(\d+),(\d+),(\d+)", value)
        if not match or not int(match[3]) or not int(match[4]):
            self.fail(
                f"{value}: expected left, top, width and height, such as 100,50,640,480",
                param,
                context,
            )
        left, top, width, height = (int(number) for number in match.groups())
        return left, top, width, height


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
    kind = click.Choice(values)
    return click.option(name, type=kind, default=values[0], show_default=True, help=text)


def describe_run(context: click.Context, backend: str | None) -> dict[str, Any]:
    """Return the command as typed and the machine, for a report."""
    return {"command": shlex.join([NAME, *context.obj]), **describe(backend)}
