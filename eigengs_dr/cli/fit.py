"""The command ``eigengs-dr fit``: fit images by Gaussians."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..backend.selection import select
from ..fitting.options import INITS, PRESETS, FitOptions
from ..image.color import SPACES
from ..image.metrics import float_space, target_key
from .console import INTERRUPTED, open_cluster, say
from .fit_images import fit_one, fit_several
from .fit_large import announce_memory, block_side, check_large, fit_by_blocks
from .fit_material import MapFile, MapOption, run_maps
from .options import (
    ANY_PATH,
    LEVEL_COUNTS,
    ImageSource,
    backend_option,
    choice,
    cluster_option,
    describe_run,
    encoding_option,
    quiet_option,
    report_option,
)
from .outputs import check_outputs, keeps_result, name_outputs, write_report

if TYPE_CHECKING:
    from ..eigenbasis.eigengs import EigenGS

DEFAULT_BASIS = "natural"
"""Name of the model from which the preset "eigengs" starts by default."""

MISSED = 1
"""Exit code if the target PSNR cannot be reached."""

FAILED = 2
"""Exit code if one of several images cannot be fitted."""


@click.command()
@click.argument("images", nargs=-1, type=ImageSource(), metavar="IMAGE...")
@click.option(
    "-o", "--output", type=ANY_PATH, help=".npz file or folder.  [default: the current folder]"
)
@click.option(
    "--map",
    "maps",
    multiple=True,
    type=MapOption(),
    help="A map of a material by name, instead of IMAGE; repeat for more.",
)
@click.option("--gaussians", type=int, metavar="N", help="Number of Gaussians.  [default: 5000]")
@click.option("--target-psnr", type=float, metavar="DB", help="Find the fewest for this PSNR.")
@click.option(
    "--target-space",
    type=click.Choice(["rgb", "ycbcr"]),
    default="rgb",
    show_default=True,
    help="Space of --target-psnr for images.",
)
@click.option("--max-gaussians", type=int, metavar="N", help="Limit for --target-psnr.")
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
@click.option(
    "--iterations",
    type=int,
    metavar="N",
    default=1000,
    show_default=True,
    help="Steps of optimisation.",
)
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
@click.option(
    "--seed",
    type=int,
    metavar="N",
    default=0,
    show_default=True,
    help="Seed of --init random.",
)
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
    maps: tuple[MapFile, ...],
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
    from ..image.io import SAVE_OPTIONS

    options = FitOptions(**settings, start=_model(settings, basis))
    if maps:
        files = (output, preview, report)
        context.exit(run_maps(context, images, maps, files, options, overwrite, quiet))
    if not images:
        raise click.UsageError("no image is given; name image files, or maps with --map")
    paths = [file for source in images for file in _expand(source)]
    several = len(paths) > 1 or paths != list(images)
    if cluster and (preview or not (several or blocks)):
        raise ValueError("--cluster takes several images, or --blocks, and no --preview")
    outputs = name_outputs(paths, output, [".npz"], several)
    previews = name_outputs(paths, preview, list(SAVE_OPTIONS), several) if preview else []
    models = [Path(basis)] if basis and Path(basis).is_file() else []
    check_outputs([*outputs, *previews, report], [*paths, *models])
    if not several and keeps_result(outputs[0], overwrite, quiet):
        return
    side = blocks or block_side(paths[0], several, options, preview)
    if side:
        check_large(options, preview, several)
    elif not several:
        announce_memory(paths[0], options, quiet)
    if not cluster:
        select(options.backend)
    _note_mean(options)
    if side:
        with open_cluster(cluster) as client:
            record, interrupted = fit_by_blocks(paths[0], outputs[0], side, options, quiet, client)
        records = [record]
    elif several:
        folder, measured = outputs[0].parent, report is not None
        with open_cluster(cluster) as client:
            records, interrupted = fit_several(
                paths, folder, previews, options, overwrite, quiet, measured, client
            )
    else:
        picture = previews[0] if previews else None
        records = [fit_one(paths[0], outputs[0], picture, quiet, options)]
        interrupted = records[0]["stopped"] == "interrupted"
    if report:
        figures = {"images": records} if several else records[0]
        run_figures = describe_run(context, options.backend) | _decisive(options, basis)
        run_figures["block"] = side
        write_report(report, run_figures | figures)
    if interrupted and not several and not side:
        say(f"interrupted; the best fit so far is in {outputs[0]}")
    if interrupted:
        context.exit(INTERRUPTED)
    _exit(context, records, options)


def _decisive(options: FitOptions, basis: str | None) -> dict[str, Any]:
    """Return the settings for a report."""
    settings = {field.name: getattr(options, field.name) for field in fields(options)}
    del settings["backend"], settings["start"]  # the report names the backend that was used
    if options.start is not None:
        settings["basis"] = basis or DEFAULT_BASIS
    return settings


def _expand(source: Path | str) -> Sequence[Path | str]:
    """Replace a folder, a pattern or a URL by the images that it stands for."""
    from ..collection.sources import list_files

    return [source] if isinstance(source, Path) and source.is_file() else list_files(source)


def _model(settings: dict[str, Any], basis: str | None) -> "EigenGS | None":
    """Return the model to start from: that of --basis, or what the preset of the paper needs."""
    paper = PRESETS[settings["preset"]].mean == "dense"
    if basis is None and not paper:
        return None
    from ..eigenbasis.eigengs import EigenGS

    return EigenGS.load(basis or DEFAULT_BASIS, settings["backend"])


def _note_mean(options: FitOptions) -> None:
    """Say that the mean image is not in the file, if the preset keeps it as pixels."""
    if options.method.mean == "dense":
        say("note: the file holds the Gaussians alone; the mean image stays in the basis")


def _exit(context: click.Context, records: list[dict[str, Any]], options: FitOptions) -> None:
    """Report fits that missed the target, and exit with the code of a failure."""
    if any(record["stopped"] == "failed" for record in records):
        context.exit(FAILED)
    failures = [record for record in records if record["stopped"] == "out of reach"]
    for record in failures:
        space = record.get("space", options.space)  # light above 1 has another one
        key = target_key(space, options.target_space)
        name = "psnr_rgb" if key == "psnr_rgb" else f"psnr_{float_space(space)}"
        say(
            f"{record['input']}: {options.target_psnr:g} dB {name} are out of reach: "
            f"{record['gaussians']} Gaussians have {record[key]:.2f}; lower --target-psnr, or "
            "raise --max-gaussians or --iterations"
        )
    if failures:
        context.exit(MISSED)
