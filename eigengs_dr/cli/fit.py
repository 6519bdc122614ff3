"""The command ``eigengs-dr fit``: one image, several, the maps of a material, or by blocks."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..backend.selection import select
from ..fitting import memory
from ..fitting.options import INITS, PIXELS_PER_FIRST_GAUSSIAN, PRESETS, FitOptions, default_count
from ..image.color import SPACES, rendered_as
from ..image.metrics import float_space, target_key
from .console import FAILED, INTERRUPTED, MISSED, bar, open_cluster, say
from .options import (
    ANY_PATH,
    IMAGES,
    LEVEL_COUNTS,
    MapFile,
    backend_option,
    choice,
    cluster_option,
    encoding_option,
    maps_option,
    number,
    quiet_option,
    report_option,
)
from .outputs import (
    check_outputs,
    describe_run,
    keeps_result,
    name_outputs,
    name_pictures,
    write_report,
)

if TYPE_CHECKING:
    from ..eigenbasis.eigengs import EigenGS
    from ..fitting.fit import Fit

Record = dict[str, Any]
"""The figures of one image, for its line and for the report."""

DEFAULT_BASIS = "natural"
"""Name of the model from which the preset "eigengs" starts by default."""

NOT_OF_MAPS = ("init", "basis", "preset", "space", "seed", "blocks", "cluster")
"""Options of the command that maps do not take."""

FIGURES = ("gaussians", "iterations", "stopped", "seconds", "psnr_ycbcr", "psnr_rgb")
"""Figures that every fit has."""


@click.command()
@click.argument("images", nargs=-1, type=IMAGES, metavar="IMAGE...")
@click.option(
    "-o", "--output", type=ANY_PATH, help=".npz file or folder.  [default: the current folder]"
)
@maps_option("A map of a material by name, instead of IMAGE; repeat for more.")
@number("--gaussians", "Number of Gaussians.  [default: 5000]")
@click.option("--target-psnr", type=float, metavar="DB", help="Find the fewest for this PSNR.")
@choice("--target-space", ["rgb", "ycbcr"], "Space of --target-psnr for images.")
@number("--max-gaussians", "Limit for --target-psnr.")
@click.option(
    "--blocks",
    type=int,
    metavar="SIZE",
    help="Fit by blocks of so many pixels a side.  [default: where memory needs it, of 1024]",
)
@click.option(
    "--levels",
    type=LEVEL_COUNTS,
    help="Levels of detail, each 4 times larger, or the Gaussians up to each: 5000,7000,9000.",
)
@number("--iterations", "Steps of optimisation.", 1000)
@choice("--init", list(INITS), "Initial placement of the Gaussians.")
@click.option(
    "--basis",
    metavar="NAME|FILE",
    help="Start from a model: one of the package, such as natural, or its file.",
)
@choice("--preset", list(PRESETS), "Our method, or that of a paper.")
@choice(
    "--space",
    list(SPACES),
    "Colour space; linear for textures, log for light above 1, normal for normal maps, data for "
    "other values.",
)
@encoding_option
@number("--seed", "Seed of --init random.", 0)
@click.option("--preview", type=ANY_PATH, help="Picture (or folder) of photo, fit and outlines.")
@click.option("--overwrite", is_flag=True, help="Fit images whose results exist again.")
@cluster_option
@backend_option
@report_option
@quiet_option
@click.pass_context
def fit(
    context: click.Context,
    /,
    images: tuple[Path | str, ...],
    output: Path | None,
    maps: dict[str, MapFile],
    basis: str | None,
    blocks: int | None,
    preview: Path | None,
    overwrite: bool,
    cluster: str | None,
    report: Path | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Fit images by sums of Gaussians.

    An IMAGE may be a folder of images, a pattern in quotes, or a URL. For several images, -o and
    --preview name folders, and the files in them have the names of the images; manifest.jsonl has a
    row for each. An image that cannot be fitted is left out; the exit code is then 2. With
    --cluster the processes of a Dask cluster fit the images, with the same results.

    An image whose result exists is skipped, so that the same command continues a run; --overwrite
    fits it again. A file that is no set of Gaussians is never replaced.

    Ctrl-C writes the best fit so far of one image, or ends after the last complete one of several,
    and exits with code 130. If --target-psnr cannot be reached, the command says so, writes the
    best fit and exits with code 1.

    An image that is too large for this machine is fitted by blocks, with one Gaussian for 20 pixels
    by default. Ctrl-C then keeps the blocks that are done, and the same command goes on.

    With --map, several maps of one size, such as albedo, roughness and normal, share one set of
    shapes; -o names the file. Maps named albedo, color and the like are fitted in linear light,
    normal as normals, and others as data; --map height:data=FILE says the space. --target-psnr then
    holds for each map.

    \b
    Examples:
      eigengs-dr fit photo.jpg
      eigengs-dr fit photo.jpg -o photo.npz --gaussians 20000 --report photo.json
      eigengs-dr fit photo.jpg -o photo.npz --target-psnr 38
      eigengs-dr fit photo.jpg -o photo.npz --basis natural --iterations 100
      eigengs-dr fit photo.jpg -o levels.npz --levels 5000,7000,9000
      eigengs-dr fit photos/ -o fits/ --iterations 300 --report fits.json
      eigengs-dr fit photos/ extra.png -o fits/ --overwrite --preview previews/
      eigengs-dr fit "photos/**/*.jpg" -o fits/ --cluster local:4
      eigengs-dr fit s3://bucket/photos/ -o /shared/fits/ --cluster tcp://node1:8786
      eigengs-dr fit roughness.png -o roughness.npz --space data
      eigengs-dr fit sky.exr -o sky.npz --space log --gaussians 20000
      eigengs-dr fit huge.tif -o huge.npz --blocks 1024
      eigengs-dr fit --map albedo=a.jpg --map roughness=r.jpg --map normal=n.jpg -o bark.npz
    """
    options = FitOptions(**settings, start=_model(settings, basis))
    if maps:
        _check_maps(context, images, output)
    elif not images:
        raise click.UsageError("no image is given; name image files, or maps with --map")
    inputs = [m.path for m in maps.values()] or [f for source in images for f in _expand(source)]
    several = not maps and (len(inputs) > 1 or inputs != list(images))
    if cluster and (preview or not (several or blocks)):
        raise ValueError("--cluster takes several images, or --blocks, and no --preview")
    named = inputs if several else inputs[:1]
    outputs = name_outputs(named, output, [".npz"], several)
    pictures = name_pictures(named, preview, several)
    models = [Path(basis)] if basis and Path(basis).is_file() else []
    check_outputs([*outputs, *pictures, report], [*inputs, *models])
    if not several and keeps_result(outputs[0], overwrite, quiet, bool(maps)):
        return
    if not (several or maps):
        blocks = blocks or _plan_memory(inputs[0], options, preview, quiet)
    if blocks and (reason := _refuse_blocks(options, preview, several)):
        raise ValueError(reason)
    if not cluster:
        select(options.backend)
    if options.method.mean == "dense":
        say("note: the file holds the Gaussians alone; the mean image stays in the basis")
    with open_cluster(cluster) as client:
        if several:
            measured = report is not None
            records, interrupted = _fit_several(
                inputs, outputs, pictures, options, overwrite, quiet, measured, client
            )
        else:
            if blocks:
                record = _fit_by_blocks(inputs[0], outputs[0], blocks, options, quiet, client)
            else:
                record = _fit_one(maps or inputs[0], outputs[0], pictures[0], options, quiet)
            records, interrupted = [record], record["stopped"] == "interrupted"
    if report:
        figures = {"images": records} if several else records[0]
        choices = _decisive(options, basis) | {"block": blocks}
        write_report(report, describe_run(context, options.backend) | choices | figures)
    context.exit(INTERRUPTED if interrupted else _exit_code(records, options))


def _expand(source: Path | str) -> Sequence[Path | str]:
    """Replace a folder, a pattern or a URL by the images that it stands for."""
    from ..image.folder import list_images

    return [source] if isinstance(source, Path) and source.is_file() else list_images(source)


def _model(settings: dict[str, Any], basis: str | None) -> EigenGS | None:
    """Return the model to start from: that of --basis, or what the preset of the paper needs."""
    paper = PRESETS[settings["preset"]].mean == "dense"
    if basis is None and not paper:
        return None
    from ..eigenbasis.eigengs import EigenGS

    return EigenGS.load(basis or DEFAULT_BASIS, settings["backend"])


def _check_maps(context: click.Context, images: Sequence[Any], output: Path | None) -> None:
    """Refuse images and options that do not go with maps."""
    if images:
        raise ValueError(f"{images[0]}: an image without a name; with --map give names to all")
    default = click.core.ParameterSource.DEFAULT
    for name in NOT_OF_MAPS:
        if context.get_parameter_source(name) is not default:
            raise ValueError(
                f"--{name} and --map exclude each other; --map NAME:SPACE=FILE sets a space"
            )
    if output is None:
        raise ValueError("--map needs -o, the .npz file to write")


def _decisive(options: FitOptions, basis: str | None) -> dict[str, Any]:
    """Return the settings for a report."""
    settings = dict(vars(options))
    del settings["backend"]  # the report names the backend that was used
    if settings.pop("start") is not None:
        settings["basis"] = basis or DEFAULT_BASIS
    return settings


# ---------------------------------------------------------------------------------------------
#  One image, or maps on one set of shapes
# ---------------------------------------------------------------------------------------------


def _fit_one(
    source: Path | str | dict[str, MapFile],
    output: Path,
    picture: Path | None,
    options: FitOptions,
    quiet: bool,
) -> Record:
    """Fit one image or maps, write its files, and return its figures."""
    import eigengs_dr as eg

    from ..fitting.fit import FitInterrupted

    started = time.perf_counter()
    maps = source if isinstance(source, dict) else {}
    name = output.name if isinstance(source, dict) else Path(source).name
    settings = dict(vars(options))
    if maps:
        settings["space"] = {name: m.space for name, m in maps.items() if m.space}
    with bar(quiet) as show:
        show(f"{name}: load", 0, 1)
        image = load_maps(maps, options.encoding) if maps else _load(source, options)
        loaded = time.perf_counter()
        try:
            result = eg.fit(image, progress=partial(show, name), **settings)
        except FitInterrupted as interrupt:
            result = interrupt.result
            say(f"interrupted; the best fit so far is in {output}")
        except ValueError as error:
            raise error if maps else ValueError(f"{source}: {error}") from None
        replace(result, source="" if maps else name).save(output)
        show(f"{name}: measure", 0, 1)
        record = {
            "input": {name: str(m.path) for name, m in maps.items()} if maps else str(source),
            "output": str(output),
            "width": result.gaussians.width,
            "height": result.gaussians.height,
            **_figures(result),
            **(_maps_of(result) if maps else _measure(image, result)),
            "seconds_load": loaded - started,
        }
        if picture:
            eg.save_image(picture, _compare(image, result))
    record["seconds_total"] = time.perf_counter() - started
    if not quiet:
        click.echo(_summary(str(output if maps else source), record, options.target_space, picture))
    return record


def _load(path: Any, options: FitOptions) -> Any:
    from ..image.io import read_file

    return read_file(path, rendered_as(options.space) is None, options.encoding)


def load_maps(maps: dict[str, MapFile], encoding: str | None) -> dict[str, Any]:
    """Read the images of maps; grey data keep one channel."""
    from ..gaussian.channels import usual_space
    from ..image.io import read_file

    data = {name: rendered_as(m.space or usual_space(name)) is None for name, m in maps.items()}
    return {
        name: read_file(m.path, data[name], None if data[name] else encoding)
        for name, m in maps.items()
    }


def _figures(result: Fit) -> Record:
    """Return the figures of a fit."""
    found = {name: getattr(result, name) for name in FIGURES[1:]}
    trace = {"seconds_init": result.seconds_init, "trace": result.trace}
    return {"gaussians": len(result.gaussians), **found, **trace}


def _maps_of(result: Fit) -> Record:
    """Return the figures of the maps of a fit."""
    maps = result.gaussians.maps
    return {
        "maps": [
            {"name": m.name, "space": m.space, "channels": m.channels, **result.maps[m.name]}
            for m in maps
        ]
    }


def _measure(image: Any, result: Fit) -> Record:
    """Compare a fit with its image; data are in the unit of the fit."""
    import eigengs_dr as eg

    from ..fitting.target import unit_of
    from ..viewer.pictures import displayed

    space = result.gaussians.space
    image = displayed(image, space)
    unit = unit_of(image, space)
    seen, shown = image / unit, result.image / unit
    ms_ssim = eg.ms_ssim(seen, shown, space="ycbcr" if rendered_as(space) else "data")
    return {"space": space, "ssim": eg.ssim(seen, shown), "ms_ssim": ms_ssim}


def _compare(image: Any, result: Fit) -> Any:
    """Show image, fit and outlines side by side, a row for each map."""
    import numpy as np

    from ..viewer.pictures import comparison, displayed

    gaussians = result.gaussians
    if not gaussians.maps:
        return comparison(displayed(image, gaussians.space), result.image, gaussians)
    rows = []
    for m in gaussians.maps:
        shown = displayed(image[m.name], m.space)[..., : m.channels]
        rows.append(comparison(shown, result.image[m.name], gaussians[m.name]))
    return np.concatenate(rows)


def _summary(name: str, record: Record, target_space: str, picture: Path | None = None) -> str:
    """Describe a fit for a terminal."""
    blocks = f" in {record['blocks']} blocks" if "blocks" in record else ""
    whole = "seconds_total" in record
    lines = [
        f"{name}: {record['width']}x{record['height']}{blocks}, {record['gaussians']:,} Gaussians, "
        f"{record['iterations']} iterations in {record['seconds']:.1f} s"
        + (f" ({record['seconds_total']:.1f} s with loading and measuring)" if whole else "")
    ]
    for m in record.get("maps", []):
        figure, value = _target_figure(m, target_space)
        lines.append(
            f"  {m['name']} in {m['space']} (channels: {m['channels']}), {figure} {value:.2f} dB"
        )
    if "maps" not in record:
        lines.append(
            f"  psnr_{float_space(record['space'])} {record['psnr_ycbcr']:.2f} dB, "
            f"psnr_rgb {record['psnr_rgb']:.2f} dB"
        )
    if "ssim" in record:
        lines[-1] += f", SSIM {record['ssim']:.4f}, MS-SSIM {record['ms_ssim']:.4f}"
    lines.append(f"  wrote {record['output']}")
    if picture:
        lines.append(f"  wrote {picture} (photo, fit and outlines side by side)")
    return "\n".join(lines)


def _target_figure(record: Record, target_space: str) -> tuple[str, float]:
    """Return the name and the value of the PSNR that a target means."""
    key = target_key(record["space"], target_space)
    name = key if key == "psnr_rgb" else f"psnr_{float_space(record['space'])}"
    return name, record[key]


def _exit_code(records: list[Record], options: FitOptions) -> int:
    """Say which fits missed the target; return the exit code of the command."""
    stops = [record["stopped"] for record in records]
    if "failed" in stops:
        return FAILED
    for record in records:
        if record["stopped"] != "out of reach":
            continue
        spaces = record.get("maps") or [{"space": options.space, **record}]
        found = [(*_target_figure(m, options.target_space), m.get("name")) for m in spaces]
        figure, value, name = min(found, key=lambda entry: entry[1])
        say(
            f"{record['output' if name else 'input']}: {options.target_psnr:g} dB {figure} are out "
            f"of reach: {record['gaussians']} Gaussians have {value:.2f}"
            + (f" in {name}" if name else "")
            + "; lower --target-psnr, or raise --max-gaussians or --iterations"
        )
    return MISSED if "out of reach" in stops else 0


# ---------------------------------------------------------------------------------------------
#  Several images
# ---------------------------------------------------------------------------------------------


def _fit_several(
    inputs: Sequence[Path | str],
    outputs: list[Path],
    pictures: Sequence[Path | None],
    options: FitOptions,
    overwrite: bool,
    quiet: bool,
    measured: bool,
    client: Any,
) -> tuple[list[Record], bool]:
    """Fit images into a folder; return the records of what is done, and whether Ctrl-C came.

    What failed is said at once. Measured fits have SSIM and a trace, except on a cluster.
    """
    import eigengs_dr as eg

    started, folder = time.perf_counter(), outputs[0].parent
    records: dict[str, Record] = {}
    places = {output.stem: place for place, output in enumerate(outputs)}

    def note(done: int, total: int | None, row: eg.ImageRow) -> None:
        picture = pictures[places[row.name]]
        records[row.name] = record = _record(row, picture, options, measured)
        if record["stopped"] == "failed":
            say(f"error: {record['error']}")
        show(folder.name, done, total, record)

    interrupted = False
    with bar(quiet) as show:
        try:
            eg.fit_many(
                inputs,
                folder,
                overwrite=overwrite,
                progress=note,
                client=client,
                **vars(options),
            )
        except KeyboardInterrupt:
            done = f"{len(records)} of {len(inputs)} images are done"
            say(f"interrupted; {done}; the same command fits the others")
            interrupted = True
    ordered = sorted(records.values(), key=lambda record: places[record["name"]])
    if not quiet:
        space = float_space(options.space)
        click.echo(_summary_of_all(ordered, folder, time.perf_counter() - started, space))
    return ordered, interrupted


def _record(row: Any, picture: Path | None, options: FitOptions, measured: bool) -> Record:
    """Return the figures of one image of several, and write its picture."""
    import eigengs_dr as eg

    record = {"name": row.name, "input": str(row.input), "output": str(row.output)}
    if row.status != "done":
        return record | {"stopped": row.status} | ({"error": row.error} if row.error else {})
    record |= {name: getattr(row, name) for name in ("width", "height", *FIGURES)}
    if row.result is None or not (picture or measured):  # a worker keeps the result
        return record
    try:
        image = _load(row.input, options)
        if picture:
            eg.save_image(picture, _compare(image, row.result))
        return record | (_figures(row.result) | _measure(image, row.result) if measured else {})
    except (ValueError, OSError) as error:
        return record | {"stopped": "failed", "error": str(error)}


def _summary_of_all(records: list[Record], folder: Path, seconds: float, space: str) -> str:
    """Describe a run for a terminal."""
    fitted = [record for record in records if "psnr_rgb" in record]
    counts = Counter(record["stopped"] for record in records)
    others = "".join(f", {counts[k]} {k}" for k in ("skipped", "failed") if counts[k])
    text = f"{len(fitted)} image{'s' * (len(fitted) != 1)} fitted{others} in {seconds:.1f} s"
    if fitted:
        ycbcr, rgb = (sum(r[key] for r in fitted) / len(fitted) for key in FIGURES[-2:])
        text += f" ({len(fitted) / seconds:.2g} images/s)"
        text += f"\n  mean psnr_{space} {ycbcr:.2f} dB, psnr_rgb {rgb:.2f} dB"
    if counts["skipped"]:
        text += "\n  --overwrite fits the skipped images, whose results exist, again"
    return f"{text}\n  wrote {folder}" if fitted else text


# ---------------------------------------------------------------------------------------------
#  A large image by blocks, and the memory of a fit before the image is read
# ---------------------------------------------------------------------------------------------

NOTABLE = 1_000_000_000
"""Bytes from which on a fit says its memory."""

COMFORTABLE = 0.5
"""Share of the usable memory up to which an image is fitted as a whole."""


def _refuse_blocks(options: FitOptions, preview: Path | None, several: bool = False) -> str:
    """Return why these options have no fit by blocks, or nothing."""
    if options.preset != "default" or options.placement != "adaptive":
        return "--blocks needs the preset and the init that are the default"
    if several:
        return "--blocks fits one image; run the command for each image"
    excluded = {
        "--target-psnr": options.target_psnr,
        "--levels": options.levels,
        "--preview": preview,
    }
    name = next((name for name, value in excluded.items() if value is not None), None)
    return f"--blocks and {name} exclude each other; leave one of them out" if name else ""


def _plan_memory(
    path: Path | str, options: FitOptions, preview: Path | None, quiet: bool
) -> int | None:
    """Return the side of blocks where a fit of the whole image takes too much memory, else None.

    Say how much a notable fit takes, from the header of its file. What is wrong with the file, its
    reader says later.

    Raises
    ------
    ValueError
        If this process may use too little memory, and the options have no fit by blocks.
    """
    from ..blocks.fit_large import BLOCK_SIDE
    from ..blocks.windows import image_size

    size = image_size(path)
    if size is None:
        return None
    height, width, channels = size
    count = options.gaussians or default_count(width * height)
    if options.target_psnr is not None:  # the first try of the search
        count = max(1, width * height // PIXELS_PER_FIRST_GAUSSIAN)
    problem = width, height, channels if rendered_as(options.space) is None else 3, count
    needed, usable = memory.estimate_memory(*problem), memory.usable_memory()
    if usable and needed > COMFORTABLE * usable and not _refuse_blocks(options, preview):
        say(f"{path}: a fit of the whole takes too much memory; it is fitted by blocks")
        return BLOCK_SIDE
    try:
        line = memory.check_memory(*problem)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if needed >= NOTABLE and not quiet:
        say(line)
    return None


def _fit_by_blocks(
    path: Path | str, output: Path, side: int, options: FitOptions, quiet: bool, client: Any
) -> Record:
    """Fit one image by blocks into a file; after an interrupt, blocks that are done wait there."""
    import eigengs_dr as eg

    names = ("gaussians", "iterations", "space", "solve_steps", "cutoff", "backend", "encoding")
    settings = {name: getattr(options, name) for name in names}
    started = time.perf_counter()
    record: Record = {"input": str(path), "output": str(output), "stopped": "interrupted"}
    with bar(quiet) as show:

        def progress(done: int, total: int, row: Record) -> None:
            show(f"{Path(path).name}: {row['stage']}", done, total)

        try:
            result = eg.fit_large(
                path, output, block=side, progress=progress, client=client, **settings
            )
        except KeyboardInterrupt:
            say(
                f"interrupted; finished blocks are in {output}.checkpoint; the same command goes on"
            )
            return record | {"seconds": time.perf_counter() - started}
    found = {"stopped": "iterations", "blocks_resumed": result.resumed, "space": options.space}
    found |= {"width": result.gaussians.width, "height": result.gaussians.height}
    found |= {"gaussians": len(result.gaussians), "blocks": result.blocks}
    record |= found | {name: getattr(result, name) for name in FIGURES if name not in found}
    if not quiet:
        click.echo(_summary(str(path), record, options.target_space))
    return record
