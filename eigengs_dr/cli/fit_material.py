"""The command ``eigengs-dr fit --map``: several maps by one set of shapes."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from ..backend.selection import select
from ..image.remote import is_url
from .console import INTERRUPTED, progress_bar, say
from .fit_images import course_of
from .options import describe_run
from .outputs import check_outputs, keeps_result, name_outputs, write_report

if TYPE_CHECKING:
    from ..fitting.fit import Fit
    from ..fitting.options import FitOptions

Record = dict[str, Any]

MISSED = 1
"""Exit code if the target PSNR cannot be reached."""

ELSEWHERE = ("init", "basis", "preset", "space", "seed", "blocks", "cluster")
"""Options of the command that materials do not take."""


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
        from ..gaussian.maps import NAME
        from ..image.color import SPACES

        left, sign, file = value.partition("=")
        name, colon, space = left.partition(":")
        if not (sign and file and NAME.fullmatch(name)):
            self.fail(f"{value}: expected a name and a file, such as albedo=bark.jpg", parameter)
        if colon and space not in SPACES:
            self.fail(f"{value}: space {space!r} is not in {', '.join(SPACES)}", parameter)
        path = file if is_url(file) else Path(file)
        if isinstance(path, Path) and not path.is_file():
            self.fail(f"{path}: no such file", parameter)
        return MapFile(name, path, space or None)


def run_maps(
    context: click.Context,
    images: tuple[Any, ...],
    maps: tuple[MapFile, ...],
    files: tuple[Path | None, Path | None, Path | None],
    options: FitOptions,
    overwrite: bool,
    quiet: bool,
) -> int:
    """Fit a material, write the set, the preview and the report, and return the exit code."""
    from ..gaussian.file import MATERIAL
    from ..image.io import SAVE_OPTIONS

    output, preview, report = files
    named = _check(context, maps, images)
    if output is None:
        raise ValueError("--map needs -o, the .npz file to write")
    inputs = [item.path for item in maps]
    [output] = name_outputs(inputs[:1], output, [".npz"])
    if preview:
        [preview] = name_outputs(inputs[:1], preview, list(SAVE_OPTIONS))
    check_outputs([output, preview, report], inputs)
    if keeps_result(output, overwrite, quiet, MATERIAL, "material"):
        return 0
    select(options.backend)
    record = fit_maps(named, output, preview, quiet, options)
    if report:
        write_report(
            report, describe_run(context, options.backend) | {"levels": options.levels} | record
        )
    if record["stopped"] == "interrupted":
        say(f"interrupted; the best fit so far is in {output}")
        return INTERRUPTED
    if record["stopped"] != "out of reach":
        return 0
    maps_of = [(m["name"], *_figure(m, options.target_space)) for m in record["maps"]]
    name, figure, least = min(maps_of, key=lambda found: found[2])
    say(
        f"{output}: {options.target_psnr:g} dB are out of reach: with {record['gaussians']} "
        f"Gaussians {name} has {figure} {least:.2f} dB; lower --target-psnr, or raise "
        "--max-gaussians or --iterations"
    )
    return MISSED


def _check(
    context: click.Context, maps: tuple[MapFile, ...], images: tuple[Any, ...]
) -> dict[str, MapFile]:
    """Return the maps by name; refuse options and images that do not go with them."""
    if images:
        raise ValueError(f"{images[0]}: an image without a name; with --map give names to all")
    given = click.core.ParameterSource.DEFAULT
    for name in ELSEWHERE:
        if context.get_parameter_source(name) is not given:
            raise ValueError(
                f"--{name} and --map exclude each other; --map NAME:SPACE=FILE sets a space"
            )
    return by_name(maps)


def by_name(maps: tuple[MapFile, ...]) -> dict[str, MapFile]:
    """Return maps by their names; raise ValueError if a name occurs twice."""
    found: dict[str, MapFile] = {}
    for item in maps:
        if item.name in found:
            raise ValueError(f"--map {item.name} is given twice; give each name once")
        found[item.name] = item
    return found


def fit_maps(
    maps: dict[str, MapFile],
    output: Path,
    preview: Path | None,
    quiet: bool,
    options: FitOptions,
) -> Record:
    """Fit the maps of a material, write its files, and return its figures."""
    import eigengs_dr as eg

    from ..fitting.fit import FitInterrupted

    started = time.perf_counter()
    with progress_bar(quiet) as show:
        show(f"{output.name}: load", 0, 1)
        images = {name: load_map(item, options.encoding) for name, item in maps.items()}
        loaded = time.perf_counter()
        try:
            result = eg.fit(
                images,
                gaussians=options.gaussians,
                iterations=options.iterations,
                space={name: item.space for name, item in maps.items() if item.space},
                target_psnr=options.target_psnr,
                target_space=options.target_space,
                max_gaussians=options.max_gaussians,
                levels=options.levels,
                backend=options.backend,
                cutoff=options.cutoff,
                encoding=options.encoding,
                progress=partial(show, output.name),
            )
        except FitInterrupted as interrupt:
            result = interrupt.result
        result.save(output)
        if preview:
            eg.save_image(preview, _preview(images, result))
    width, height = result.gaussians.width, result.gaussians.height
    record = {
        "input": {name: str(item.path) for name, item in maps.items()},
        "output": str(output),
        "width": width,
        "height": height,
        "gaussians": len(result.gaussians),
        **course_of(result, started, loaded),
        "psnr_ycbcr": result.psnr_ycbcr,
        "psnr_rgb": result.psnr_rgb,
        "maps": [
            {"name": m.name, "space": m.space, "channels": m.channels, **result.maps[m.name]}
            for m in result.gaussians.maps
        ],
        "trace": result.trace,
    }
    if not quiet:
        click.echo(_summary(record, preview, options.target_space))
    return record


def load_map(item: MapFile, encoding: str | None) -> Any:
    """Read the image of a map; grey data keep one channel."""
    import eigengs_dr as eg

    from ..gaussian.maps import usual_space
    from ..image.color import rendered_as

    data = rendered_as(item.space or usual_space(item.name)) is None
    return eg.load_image(item.path, data, None if data else encoding)


def _preview(images: dict[str, Any], result: Fit) -> Any:
    """Show a row of image, fit and outlines for each map."""
    import numpy as np

    from ..viewer.pictures import comparison, displayed

    rows = []
    for m in result.gaussians.maps:
        image = displayed(images[m.name], m.space)[..., : m.channels]
        rows.append(comparison(image, result.image[m.name], result.gaussians[m.name]))
    return np.concatenate(rows)


def _figure(record: Record, target_space: str) -> tuple[str, float]:
    """Return the name and the value of the PSNR of a map that a target means."""
    from ..image.metrics import float_space, target_key

    key = target_key(record["space"], target_space)
    return "psnr_rgb" if key == "psnr_rgb" else f"psnr_{float_space(record['space'])}", record[key]


def _summary(record: Record, preview: Path | None, target_space: str) -> str:
    """Describe a fit for a terminal."""
    lines = [
        "{width}x{height}, {gaussians} Gaussians, {iterations} iterations "
        "in {seconds:.1f} s ({seconds_total:.1f} s with loading)".format(**record)
    ]
    for m in record["maps"]:
        figure, value = _figure(m, target_space)
        lines.append(
            "  {name} in {space} (channels: {channels}), ".format(**m) + f"{figure} {value:.2f} dB"
        )
    lines.append(f"  wrote {record['output']}")
    if preview:
        lines.append(f"  wrote {preview} (image, fit and outlines of each map)")
    return "\n".join(lines)
