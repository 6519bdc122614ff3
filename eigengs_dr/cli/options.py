"""Options that several commands share, and the types of their values."""

import glob
import json
import re
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple

import click

from ..backend.messages import printable
from ..backend.selection import BACKENDS
from ..backend.types import Record
from ..image.pixels import ENCODINGS, local_path
from ..image.space import SPACES
from ..storage.atomic import atomic_write, refuse_url
from .outputs import describe_run, plain

EXISTING = click.Path(exists=True, dir_okay=False, path_type=Path)

FILE_OR_FOLDER = click.Path(exists=True, path_type=Path)

MAX_PIXELS = 1 << 29
"""Largest number of pixels of a rendered picture, except in TIFF files; it takes 3 bytes per
pixel."""

MAX_RENDERED_SIDE = 1 << 17
"""Largest side in pixels of a picture that is rendered into a TIFF file."""

Command = Callable[..., object]

Kind = click.ParamType | type | Callable[[str], object]
"""The type of an option's value."""

Option = Callable[[Command], Command]
"""A decorator that adds an option to a command."""

# Each function below parses the text of an option or an argument; click shows its name in errors.


def path(text: str) -> Path:
    """Parse a file or a folder to write; reject URLs, which would become local folders."""
    refuse_url(text)
    return Path(text)


def image(text: str) -> Path:
    """Parse an image file."""
    return EXISTING.convert(local_path(text), None, None)


def images(text: str) -> Path:
    """Parse an image file, a folder of images, or a pattern such as "a/*.png"."""
    file = local_path(text)
    pattern = glob.has_magic(text) and not file.exists()
    return click.Path(exists=not pattern, path_type=Path).convert(text, None, None)


def folder(text: str) -> Path:
    """Parse an existing folder."""
    kind = click.Path(exists=True, file_okay=False, path_type=Path)
    return kind.convert(local_path(text), None, None)


def sets_in(path: Path, suffixes: tuple[str, ...] = (".npz", ".egs")) -> list[Path]:
    """Return the sets in a folder, sorted by name; of a file, the file."""
    if not path.is_dir():
        return [path]
    files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in suffixes]
    files = [file for file in files if file.name[0] != "." and file.is_file()]
    if not files:
        raise ValueError(f"{path}: holds no files ending in {' or '.join(suffixes)}")
    return files


def file_of(name: Path) -> Path:
    """Return the path of a file or of a basis of the package; raise ValueError if it is neither."""
    from ..eigenbasis.eigengs import SHIPPED

    path = SHIPPED.get(str(name), name)
    if not path.exists():
        raise ValueError(f"{name}: is neither a file nor one of: {', '.join(SHIPPED)}")
    return path


def refuse_folder(path: Path) -> None:
    """Raise ValueError for a folder where one set belongs, with the names of the sets in it."""
    if path.is_dir():
        names = [file.name for file in sets_in(path)]
        several = ", ".join(names[:3]) + ", ..." * (len(names) > 3)
        raise ValueError(f"{path}: is a folder; give one of its files (.npz, .egs): {several}")


def size(text: str) -> tuple[int, int]:
    """Parse width and height in pixels, such as "1024x768"."""
    width, height = _numbers(text, r"\d+x\d+", "width and height, such as 1024x768")
    return check_pixels(width, height, by_parts=True)


def width_or_size(text: str) -> tuple[int, int | None]:
    """Parse a width in pixels, such as "1024", or width and height, such as "1024x768"."""
    expected = "a width, or width and height, such as 1024 or 1024x768"
    width, *rest = _numbers(text, r"\d+(x\d+)?", expected)
    height = rest[0] if rest else None
    check_pixels(width, 1 if height is None else height, by_parts=True)
    return width, height


def scale(text: str) -> float:
    """Parse the factor of a size."""
    if not 0 < (factor := float(text)) <= MAX_RENDERED_SIDE:
        raise click.BadParameter(f"{text}: expected a number above 0, such as 2 or 0.5")
    return factor


def region(text: str) -> tuple[int, ...]:
    """Parse a region of an image, in pixels."""
    expected = "left, top, width and height, such as 100,50,640,480"
    return _numbers(text, r"\d+,\d+,0*[1-9]\d*,0*[1-9]\d*", expected)


def light(text: str) -> tuple[float, ...]:
    """Parse the direction of a light, such as "0.3,0.2,0.9"."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text}: expected x,y,z, such as 0.3,0.2,0.9") from None
    return x, y, z


def counts(text: str) -> int | tuple[int, ...]:
    """Parse one number for all channels, or one for each of three."""
    expected = "a number above 0, or three such as 230,60,60"
    return _one_or_more(_numbers(text, r"(?=.*[1-9])\d+(,\d+,\d+)?", expected))


def levels(text: str) -> int | tuple[int, ...]:
    """Parse the number of levels, or the number of Gaussians up to each."""
    expected = "a number, or several such as 5000,7000,9000"
    return _one_or_more(_numbers(text, r"\d{1,18}(,\d{1,18})*", expected))


def _numbers(text: str, pattern: str, expected: str) -> tuple[int, ...]:
    """Parse whole numbers separated by "," or "x", if the text matches a pattern."""
    if not re.fullmatch(pattern, text):
        raise click.BadParameter(f"{text}: expected {expected}")
    return tuple(map(int, re.split("[,x]", text)))


def _one_or_more(numbers: tuple[int, ...]) -> int | tuple[int, ...]:
    return numbers if len(numbers) > 1 else numbers[0]


class MapFile(NamedTuple):
    """The image file of a map, and its space if it is not the default of its name."""

    name: str
    path: Path
    space: str | None


def map_file(text: str) -> MapFile:
    """Parse a name and a file, such as "albedo=bark.jpg", optionally with a space."""
    from ..gaussian.channels import NAME

    left, sign, file = text.partition("=")
    name, colon, space = left.partition(":")
    if not (sign and file and NAME.fullmatch(name)):
        raise click.BadParameter(f"{text}: expected a name and a file, such as albedo=bark.jpg")
    if colon and space not in SPACES:
        raise click.BadParameter(f"{text}: space {space!r} is not in {', '.join(SPACES)}")
    if not local_path(file).is_file():
        raise click.BadParameter(f"{file}: no such file")
    return MapFile(name, Path(file), space or None)


def by_name(
    context: click.Context, parameter: click.Parameter, maps: tuple[MapFile, ...]
) -> dict[str, MapFile]:
    """Return maps by name; each name may occur once."""
    names = [item.name for item in maps]
    if twice := [name for name in names if names.count(name) > 1]:
        raise click.UsageError(f"--map {twice[0]} is given twice; give each name once")
    return dict(zip(names, maps, strict=True))


def check_pixels(width: int, height: int, by_parts: bool = False) -> tuple[int, int]:
    """Return the width and height of a picture; reject one that is too large to render.

    A picture that is written in parts may be larger than one that is held in memory.
    """
    if not (1 <= width <= MAX_RENDERED_SIDE and 1 <= height <= MAX_RENDERED_SIDE):
        raise click.UsageError(
            f"{width}x{height}: expected sides of 1 to {MAX_RENDERED_SIDE:,} pixels"
        )
    if width * height > MAX_PIXELS and not by_parts:
        limit = f"at most {MAX_PIXELS:,} pixels, or a .tif file"
        raise click.UsageError(f"{width}x{height}: expected {limit}")
    return width, height


def value(name: str, metavar: str | None, kind: Kind, text: str, default: object = None) -> Option:
    """Make an option whose value has a type of click or is parsed by a function."""
    return click.option(name, metavar=metavar, type=kind, help=text, default=default)


def choice(name: str, values: Iterable[str], text: str, optional: bool = False) -> Option:
    """Make an option that takes one of several words; the default is the first, or None."""
    words = list(values)
    return value(name, None, click.Choice(words), text, None if optional else words[0])


def number(name: str, text: str, default: int | None = None, minimum: int | None = None) -> Option:
    """Make an option that takes a whole number, optionally with a minimum."""
    return value(name, "N", int if minimum is None else click.IntRange(min=minimum), text, default)


def output(text: str, metavar: str, required: bool = True) -> Option:
    """Make the option for the file or folder to write."""
    return click.option("-o", "--output", required=required, type=path, metavar=metavar, help=text)


def maps(text: str) -> Option:
    """Make the option for the image files of maps."""
    many: Record = {"multiple": True, "type": map_file, "callback": by_name}
    return click.option("--map", "maps", metavar="NAME[:SPACE]=FILE", help=text, **many)


def level_counts(text: str) -> Option:
    """Make the option for the levels of detail."""
    return value("--levels", "N|N,N,...", levels, text)


as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
encoding = choice(
    "--encoding",
    ENCODINGS,
    "Encoding of the pixels.  [default: linear for floats, else srgb]",
    True,
)

SHARED: dict[str, Option] = {
    "cluster": value(
        "--cluster",
        "local[:N]|tcp://HOST:PORT|FILE",
        str,
        "Run on N local processes or a Dask cluster.",
    ),
    "backend": choice(
        "--backend", BACKENDS, "Backend of Dr.Jit.  [default: cuda if present]", True
    ),
    "report": value("--report", "FILE", path, "Write all figures as JSON."),
    "quiet": click.option("--quiet", is_flag=True, help="Show no progress or summary."),
}
"""Options that become fields of a `Run`."""


class Run(NamedTuple):
    """One run of a command: its context, and the options that commands share."""

    context: click.Context
    quiet: bool
    backend: str | None = None
    report: Path | None = None
    cluster: str | None = None

    def tell(self, *lines: str) -> None:
        """Print the summary of a command, unless it is quiet."""
        if not self.quiet:
            click.echo("\n".join(map(printable, lines)))

    def write_report(self, figures: dict[str, object]) -> None:
        """Write figures, the command and the machine as JSON."""
        if self.report:
            content = plain(describe_run(self.context, self.backend) | figures)
            with atomic_write(self.report) as temporary:
                temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def shared(*names: str) -> Option:
    """Add options of `SHARED` to a command, which receives them in a `Run`, its first argument."""

    def decorate(command: Command) -> Command:
        @click.pass_context
        @wraps(command)
        def call(context: click.Context, /, **given: Any) -> object:
            return command(Run(context, **{name: given.pop(name) for name in names}), **given)

        for name in reversed(names):
            call = SHARED[name](call)
        return call

    return decorate
