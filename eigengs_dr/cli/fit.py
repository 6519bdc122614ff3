"""The command ``eigengs-dr fit``: one image, several images, or the maps of a material."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import eigengs_dr as eg

from ..backend.selection import select
from ..backend.types import Record
from ..image.color import exposed
from ..image.io import displayed
from ..image.space import SPACES, YCBCR, space_of
from . import options
from .console import FAILED, INTERRUPTED, MISSED, bar, open_cluster, prefix_errors, print_message
from .options import MapFile
from .outputs import check_outputs, check_replaceable, lock_outputs, name_outputs, name_pictures

if TYPE_CHECKING:
    from ..fitting.method import Method
    from ..fitting.options import FitOptions

Show = Callable[..., None]
"""Shows the progress of a fit, see `bar`."""

Fitted = tuple[list[Record], list[str]]
"""The figures of each image, for the report, and the lines for the terminal."""

INITS = ("adaptive", "grid", "random")
"""Names of the initial placements."""

PRESETS = ("default", "gaussianimage", "eigengs")
"""Names of the methods: ours, and those of two papers."""

DEFAULT_BASIS = "natural"
"""Name of the model from which the preset "eigengs" starts by default."""

EXCLUDED_OPTIONS = (
    ("images", "maps", "name all images: --map NAME=FILE"),
    ("basis", "maps", "a model is for one image"),
    ("blocks cluster recursive", "maps", "maps are fitted together, as one image"),
    ("init start", "basis", "a model, as of --preset eigengs, has Gaussians of its own"),
    ("init", "start", "a start has Gaussians of its own"),
    ("target_psnr", "start basis", "the Gaussians of a search are placed anew"),
    ("levels", "basis", "the Gaussians of levels are placed anew"),
    ("init basis start", "blocks", "the Gaussians of blocks have a placement of their own"),
    ("preset target_psnr levels", "blocks", "blocks are fitted by the default method"),
    ("preview", "blocks cluster", "a preview needs the fit in this process"),
)
"""Options that exclude each other, besides those of `eigengs_dr.fitting.options.EXCLUSIONS`."""


@click.command()
@click.argument("images", nargs=-1, type=options.images, metavar="IMAGE...")
@options.output(".npz file or folder.  [default: the current folder]", "OUT", required=False)
@options.maps("A map of a material, instead of IMAGE; repeatable.")
@options.number("--gaussians", "Number of Gaussians.  [default: 5000]")
@options.value("--target-psnr", "DB", float, "Take the fewest Gaussians for this PSNR.")
@options.choice("--target-space", ["rgb", "ycbcr"], "Colour space of --target-psnr.", True)
@options.number("--max-gaussians", "Largest number of Gaussians for --target-psnr.")
@options.value("--blocks", "SIZE", click.IntRange(min=1), "Fit by blocks of this side.")
@options.level_counts("Number of levels of detail, each 4 times as large, or Gaussians up to each.")
@options.number("--iterations", "Optimisation steps.", 1000)
@options.choice("--init", INITS, "Initial placement.  [default: adaptive]", True)
@options.value("--basis", "NAME|FILE", str, "Model to start from: natural, or a file.")
@options.value("--start", "FILE", options.path, "Set of Gaussians to start from.")
@click.option("--keep", is_flag=True, help="Start from all of --start, whatever fits.")
@options.choice("--preset", PRESETS, "Our method, or that of a paper.")
@options.choice(
    "--space",
    SPACES,
    "Colour space: linear for textures, log for light above 1, normal for normal maps, data for "
    "other values.  [default: ycbcr]",
    True,
)
@options.encoding
@options.number("--seed", "Random seed.", 0)
@options.value("--preview", "FILE", options.path, "Picture, or folder, of photo, fit and outlines.")
@click.option("--recursive", is_flag=True, help="Also take images in subfolders.")
@click.option("--overwrite", is_flag=True, help="Also fit images that have results.")
@options.shared("cluster", "backend", "report", "quiet")
def fit(
    run: options.Run,
    images: tuple[Path, ...],
    output: Path | None,
    maps: dict[str, MapFile],
    basis: str | None,
    blocks: int | None,
    preview: Path | None,
    overwrite: bool,
    **choices: Any,
) -> None:
    """Fit sums of Gaussians to images. Grey images become RGB; --space data keeps one channel.

    IMAGE may be a folder, or a pattern in quotes. For several images, -o and --preview name
    folders, whose files are named after the images; --report has a row per image. If one fails,
    the others are fitted, and the exit code is 2.

    A single result is replaced. Of several images, those with results are skipped, so the same
    command continues a run; results of other options are an error. Files that are not sets of
    Gaussians are never replaced.

    Ctrl-C writes the best fit so far, or of several images stops after the last complete one, with
    exit code 130. If --target-psnr is out of reach, the best fit is written, with exit code 1.

    An image too large for memory is refused. --blocks 1024 fits it block by block, by default with
    one Gaussian per 20 pixels; after Ctrl-C, the same command continues.

    With --map, maps of one size share one set of shapes, and -o names the file. Names such as
    albedo and color mean linear light, normal means normals, others data; --map height:data=FILE
    sets a space. --target-psnr then applies to each map.

    \b
    Examples:
      eigengs-dr fit photo.jpg
      eigengs-dr fit photo.jpg -o photo.npz --target-psnr 38
      eigengs-dr fit photo.jpg --basis natural --iterations 100
      eigengs-dr fit frame2.jpg --start frame1.npz --iterations 100
      eigengs-dr fit photo.jpg -o levels.npz --levels 5000,7000,9000
      eigengs-dr fit photos/ -o fits/ --report fits.json
      eigengs-dr fit "photos/**/*.jpg" -o fits/ --cluster local:4
      eigengs-dr fit sky.exr -o sky.npz --space log --gaussians 20000
      eigengs-dr fit --map albedo=a.jpg --map roughness=r.jpg --map normal=n.jpg -o bark.npz
    """
    _check_options(run.context)
    recursive = choices["recursive"]
    files = [m.path for m in maps.values()]
    files = files or [file for given in images for file in _expand(given, recursive)]
    settings = _settings(choices, basis, run.backend)
    several = not maps and (len(files) > 1 or files != list(images))
    if recursive and files == list(images):
        raise ValueError("--recursive takes a folder of images")
    if run.cluster and not (several or blocks):
        raise ValueError("--cluster takes several images, or --blocks")
    inputs = files if several else files[:1]
    outputs = name_outputs(inputs, output, [".npz"], several)
    pictures = name_pictures(inputs, preview, several)
    check_outputs([*outputs, *pictures, run.report], [*files, *([basis] if basis else [])])
    if several and blocks:
        raise ValueError("--blocks fits one image; run the command for each image")
    if not several:
        check_replaceable(outputs[0], bool(maps))
    if not (several or maps or blocks):
        from .memory import check_memory

        line = check_memory(files[0], settings, not _conflict(run.context, blocks=1))
        if line and not run.quiet:
            print_message(line)
    if not run.cluster:
        select(run.backend)
    if settings.method.needs_model:
        print_message("note: the file holds only the Gaussians; the mean image stays in the basis")
    with open_cluster(run.cluster) as client, bar(run.quiet) as show:
        if several:
            records, lines = _fit_several(
                show, files, outputs, pictures, settings, overwrite, client
            )
        elif blocks:
            records, lines = _fit_by_blocks(show, files[0], outputs[0], settings, blocks, client)
        else:
            source = maps or files[0]
            records, lines = _fit_at_once(show, source, outputs[0], pictures[0], settings)
    run.tell(*lines)
    used = choices | {"space": settings.space or YCBCR}
    if settings.start is not None and choices["start"] is None:
        used["basis"] = basis or DEFAULT_BASIS
    figures = {"images": records} if several else records[0]
    run.write_report(used | {"block": blocks} | figures)
    run.context.exit(_exit_code(records, len(inputs), settings))


def _check_options(context: click.Context) -> None:
    """Raise ValueError if options exclude each other, or one lacks another."""
    if conflict := _conflict(context):
        raise ValueError(conflict)
    given = context.params
    if not (given["images"] or given["maps"]):
        raise click.UsageError("no image is given; give image files, or maps with --map")
    if given["maps"] and given["output"] is None:
        raise ValueError("--map needs -o, the .npz file to write")
    if given["keep"] and given["start"] is None:
        raise ValueError("--keep is for the Gaussians of --start; give both")
    has_limits = given["max_gaussians"] is not None or given["target_space"]
    if has_limits and given["target_psnr"] is None:
        raise ValueError("--max-gaussians and --target-space need --target-psnr")


def _conflict(context: click.Context, **more: object) -> str | None:
    """Return why options that are given, and more of them, exclude each other; or None."""
    from ..fitting.options import EXCLUSIONS, conflict_in

    source, default = context.get_parameter_source, click.core.ParameterSource.DEFAULT
    given = {name: value for name, value in context.params.items() if source(name) != default}
    if given.get("preset") == "eigengs":
        more["basis"] = DEFAULT_BASIS
    labels = {str(p.name): p.opts[-1] for p in context.command.params}
    return conflict_in(given | more, EXCLUSIONS + EXCLUDED_OPTIONS, labels.__getitem__)


def _settings(choices: dict[str, Any], basis: str | None, backend: str | None) -> FitOptions:
    """Return the options of a fit for the options of the command line."""
    from ..fitting.options import FitOptions
    from ..fitting.start import set_in

    start: eg.EigenGS | eg.Gaussians | None = None
    method = _method(choices["preset"], choices["init"])
    if basis is not None or method.needs_model:
        start = eg.EigenGS.load(basis or DEFAULT_BASIS, backend)
    if choices["start"] is not None:
        start = eg.Gaussians.load(choices["start"], backend)
        method = method.without("redistribute") if choices["keep"] else method
    target, count, levels = (choices[name] for name in ("target_psnr", "gaussians", "levels"))
    if target is not None:
        target = eg.Goal(target, choices["target_space"] or "rgb", choices["max_gaussians"])
    if isinstance(levels, tuple):
        count, levels = tuple(eg.level_counts(count or levels[-1], levels)), None
    return FitOptions(
        gaussians=count,
        iterations=choices["iterations"],
        target_psnr=target,
        start=start,
        space=choices["space"] or (set_in(start).space if start else None),
        method=method,
        seed=choices["seed"],
        backend=backend,
        encoding=choices["encoding"],
        levels=levels,
    )


def _method(preset: str, init: str | None) -> Method:
    """Return the method of a preset, optionally with another initial placement."""
    from ..fitting.place import Adaptive, Grid, Placement, Random
    from ..paper.eigengs import EIGENGS
    from ..paper.gaussianimage import GAUSSIANIMAGE

    method = {"default": eg.DEFAULT, "gaussianimage": GAUSSIANIMAGE, "eigengs": EIGENGS}[preset]
    places: dict[str, Placement] = {"adaptive": Adaptive(), "grid": Grid(), "random": Random()}
    return method if init is None else replace(method, place=places[init])


def _expand(source: Path, recursive: bool) -> Sequence[Path]:
    """Expand a folder or a pattern to its images."""
    from ..image.folder import list_images

    return [source] if source.exists() and not source.is_dir() else list_images(source, recursive)


# ---------------------------------------------------------------------------------------------
#  One image, or maps that share one set of shapes
# ---------------------------------------------------------------------------------------------


def _fit_at_once(
    show: Show,
    source: Path | dict[str, MapFile],
    output: Path,
    picture: Path | None,
    settings: FitOptions,
) -> Fitted:
    """Fit one image, or maps, without blocks, and write its files."""
    started = time.perf_counter()
    lock_outputs(output)
    maps = source if isinstance(source, dict) else {}
    name = (output if isinstance(source, dict) else Path(source)).name
    with prefix_errors("--map" if maps else str(source)):
        show(f"{name}: load", 0, 1)
        image = load_images(source, settings.space or "ycbcr", settings.encoding)
        loaded, target = time.perf_counter(), image
        if maps:
            target = {key: eg.Map(image[key], m.space) for key, m in maps.items()}
        try:
            result = eg.fit(target, progress=partial(show, name), **vars(settings))
        except eg.Interrupted as interrupt:
            result = interrupt.result
            print_message(f"interrupted; the best fit so far is in {output}")
        replace(result, source=name).save(output)
        show(f"{name}: measure", 0, 1)
        inputs = {name: m.path for name, m in maps.items()} or source
        record: Record = {"input": inputs, "output": output}
        record |= _figures(result) | _similarity(image, result)
        if picture:
            eg.save_image(picture, _comparison(image, result.gaussians, result.image))
    record |= {"seconds_load": loaded - started, "seconds_total": time.perf_counter() - started}
    return [record], _summary(str(output if maps else source), record, settings, picture)


def load_images(source: Path | dict[str, MapFile], space: str, encoding: str | None) -> Any:
    """Read an image, or the images of maps by name; grey data keeps one channel."""
    from ..gaussian.channels import usual_space
    from ..image.io import read_floats

    if isinstance(source, dict):
        return {
            name: load_images(m.path, m.space or usual_space(name), encoding)
            for name, m in source.items()
        }
    return read_floats(source, not space_of(space).is_color, encoding)


UNREPORTED = ("gaussians", "image", "mean_image", "maps", "source", "resumed")
"""Attributes of results that are not figures of a report."""


def _figures(result: eg.Fit | eg.LargeFit) -> Record:
    """Return the figures of a result."""
    g = result.gaussians
    figures = {"gaussians": len(g), "width": g.width, "height": g.height, "space": g.space}
    figures |= {name: value for name, value in vars(result).items() if name not in UNREPORTED}
    if maps := getattr(result, "maps", {}):
        figures["maps"] = [m._asdict() | maps[m.name] for m in g.maps]
    return figures


def _similarity(image: Any, result: eg.Fit) -> Record:
    """Return SSIM and MS-SSIM of a fit of colours; nothing for maps and other data."""
    space = result.gaussians.space
    if result.maps:
        return {}
    image = displayed(image, space)
    if not space.has_codes(image):
        return {}
    exposure = space.exposure(image)
    pair = exposed(image, exposure), exposed(result.image, exposure)
    ms_ssim = eg.ms_ssim(*pair, space="ycbcr" if space.is_color else "data")
    return {"ssim": eg.ssim(*pair), "ms_ssim": ms_ssim}


def _comparison(image: Any, gaussians: eg.Gaussians, drawn: Any) -> Any:
    """Return a picture of image, fit and outlines side by side, with a row for each map."""
    import numpy as np

    from ..viewer.pictures import comparison

    if not gaussians.maps:
        original = displayed(image, gaussians.space)
        exposure = gaussians.space.exposure(original)
        return comparison(exposed(original, exposure), exposed(drawn, exposure), gaussians)
    rows = []
    for m in gaussians.maps:
        original = displayed(image[m.name], m.space)[..., : m.channels]
        rows.append(comparison(original, drawn[m.name], gaussians[m.name]))
    return np.concatenate(rows)


def _summary(
    name: str, record: Record, settings: FitOptions, picture: Path | None = None
) -> list[str]:
    """Format the summary of a fit for the terminal."""
    blocks = f" in {record['blocks']} blocks" if "blocks" in record else ""
    size, count = f"{record['width']}x{record['height']}", record["gaussians"]
    lines = [
        f"{name}: {size}{blocks}, {count:,} Gaussian{'s' * (count != 1)}, "
        f"{record['iterations']} iterations in {record['seconds']:.1f} s"
    ]
    if "seconds_total" in record:
        lines[0] += f" ({record['seconds_total']:.1f} s including loading and measuring)"
    if record.get("kept") is not None:
        lines.append(_kept(record["kept"], count))
    for m in record.get("maps", []):
        figure, value = _target_figure(m, settings)
        lines.append(
            f"  {m['name']} in {m['space']} (channels: {m['channels']}), {figure} {value:.2f} dB"
        )
    if "maps" not in record:
        lines.append(_psnrs(record["space"], record["psnr_ycbcr"], record["psnr_rgb"]))
    if "ssim" in record:
        lines[-1] += f", SSIM {record['ssim']:.4f}, MS-SSIM {record['ms_ssim']:.4f}"
    lines.append(f"  wrote {record['output']}")
    if picture:
        lines.append(f"  wrote {picture} (photo, fit and outlines side by side)")
    return lines


def _kept(kept: int, count: int) -> str:
    anew = ", the others were placed anew" if kept < count else ""
    return f"  kept {kept:,} of {count:,} Gaussians of the start{anew}"


def _psnrs(space: str, floats: float, rgb: float) -> str:
    line = f"  psnr_{space_of(space).figure} {floats:.2f} dB"
    # Data outside of [0, 1] has no PSNR of 8-bit values.
    return line if math.isnan(rgb) else f"{line}, psnr_rgb {rgb:.2f} dB"


def _target_figure(record: Record, settings: FitOptions) -> tuple[str, float]:
    """Return the name and the value of the PSNR to which a target refers."""
    space = space_of(record["space"])
    key = (settings.goal or eg.Goal(99)).key(space)
    return key if key == "psnr_rgb" else f"psnr_{space.figure}", record[key]


def _exit_code(records: list[Record], expected: int, settings: FitOptions) -> int:
    """Report fits that missed the target, and return the exit code of the command."""
    stops = [record["stopped"] for record in records]
    if "interrupted" in stops or len(records) < expected:
        return INTERRUPTED
    if "failed" in stops:
        return FAILED
    for record in records:
        if record["stopped"] != "out of reach":
            continue
        maps = record.get("maps")
        psnrs = [(*_target_figure(m, settings), m.get("name")) for m in maps or [record]]
        figure, value, name = min(psnrs, key=lambda entry: entry[1])
        assert settings.goal
        print_message(
            f"{record['output' if maps else 'input']}: {figure} of {settings.goal.psnr:g} dB is "
            f"out of reach: {record['gaussians']} Gaussians reach {value:.2f}"
            + (f" in {name}" if maps else "")
            + "; lower --target-psnr, or raise --max-gaussians or --iterations"
        )
    return MISSED if "out of reach" in stops else 0


# ---------------------------------------------------------------------------------------------
#  Several images
# ---------------------------------------------------------------------------------------------


def _fit_several(
    show: Show,
    files: Sequence[Path],
    outputs: list[Path],
    pictures: Sequence[Path | None],
    settings: FitOptions,
    overwrite: bool,
    client: Any,
) -> Fitted:
    """Fit images into a folder, and report failures at once."""
    started, folder = time.perf_counter(), outputs[0].parent
    picture_of = {path.stem: picture for path, picture in zip(outputs, pictures, strict=True)}

    def note(done: int, total: int | None, row: eg.ImageRow) -> None:
        if row.error:
            print_message(f"error: {row.error}")
        picture = picture_of[row.name]
        if picture and row.result:
            eg.save_image(picture, _compared(row, settings))
        elif picture and row.status == "skipped" and not picture.exists():
            try:
                compared = _compared(row, settings)
            except (ValueError, OSError) as error:
                print_message(f"note: {picture} is not drawn: {error}; --overwrite fits it again")
            else:
                eg.save_image(picture, compared)
        show(folder.name, done, total, row)

    choices = {name: value for name, value in vars(settings).items() if name != "loss"}
    try:
        rows = eg.fit_many(
            files, folder, overwrite=overwrite, progress=note, client=client, **choices
        )
    except eg.Interrupted as stop:
        rows = stop.result
        done = f"{len(rows)} of {len(files)} images are done"
        print_message(f"interrupted; {done}; repeat the command to fit the others")
    space, seconds = settings.space or "ycbcr", time.perf_counter() - started
    known = [{k: v for k, v in vars(row).items() if v not in (None, "")} for row in rows]
    records = [{"stopped": record["status"], "space": space} | record for record in known]
    return records, _summary_of_all(rows, folder, seconds, space)


def _compared(row: eg.ImageRow, settings: FitOptions) -> Any:
    """Return the picture of a row; for a skipped image it shows the set in the file."""
    assert row.input and row.output
    image = load_images(row.input, settings.space or "ycbcr", settings.encoding)
    if row.result:
        return _comparison(image, row.result.gaussians, row.result.image)
    if settings.method.needs_model:
        raise ValueError(f"{row.output} lacks the mean image")
    gaussians = eg.Gaussians.load(row.output, settings.backend)
    if image.pixels.shape[:2] != (gaussians.height, gaussians.width):
        raise ValueError(f"{row.output} is of an image of {gaussians.width}x{gaussians.height}")
    return _comparison(image, gaussians, eg.picture_of(gaussians))


def _summary_of_all(rows: list[eg.ImageRow], folder: Path, seconds: float, space: str) -> list[str]:
    """Format the summary of a run for the terminal."""
    fitted = [row for row in rows if row.status == "done"]
    counts = Counter(row.status for row in rows)
    others = "".join(f", {counts[k]} {k}" for k in ("skipped", "failed") if counts[k])
    lines = []
    text = f"{len(fitted)} image{'s' * (len(fitted) != 1)} fitted{others} in {seconds:.1f} s"
    if fitted:
        pairs = [(row.psnr_ycbcr, row.psnr_rgb) for row in fitted]
        floats, rgb = (sum(values) / len(fitted) for values in zip(*pairs, strict=True))
        text += f" ({len(fitted) / seconds:.2g} images/s)"
        lines.append(f"  mean{_psnrs(space, floats, rgb)[1:]}")
    if kept := [row.kept for row in fitted if row.kept is not None]:
        lines.append(_kept(sum(kept), sum(row.gaussians or 0 for row in fitted)))
    if counts["skipped"]:
        lines.append("  the results of skipped images exist; --overwrite fits them again")
    if fitted:
        lines.append(f"  wrote {folder}")
    return [text, *lines]


# ---------------------------------------------------------------------------------------------
#  A large image by blocks
# ---------------------------------------------------------------------------------------------


def _fit_by_blocks(
    show: Show, path: Path, output: Path, settings: FitOptions, side: int, client: Any
) -> Fitted:
    """Fit one image by blocks into a file; an interrupt keeps the finished blocks beside it."""
    names = ("gaussians", "iterations", "method", "seed", "backend", "encoding")
    choices: Record = {name: getattr(settings, name) for name in names}
    choices |= {"space": settings.space or YCBCR, "block": side, "client": client}
    record: Record = {"input": path, "output": output}

    def progress(done: int, total: int, row: eg.ImageRow) -> None:
        show(f"{Path(path).name}: {row.status}", done, total)

    try:
        result = eg.fit_large(path, output, progress=progress, **choices)
    except eg.Interrupted:
        print_message(
            f"interrupted; finished blocks are in {output}.checkpoint; repeat the command to "
            "continue"
        )
        return [record | {"stopped": "interrupted"}], []
    record |= {"stopped": "iterations", **_figures(result), "blocks_resumed": result.resumed}
    return [record], _summary(str(path), record, settings)
