"""The command ``eigengs-dr train``: train an EigenGS model on a folder of images."""

from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from . import options
from .console import INTERRUPTED, bar, open_cluster, say
from .outputs import check_outputs, describe_run, name_outputs, name_pictures, write_report

FREQUENCY_AWARE: dict[str, bool | str] = {"auto": "auto", "yes": True, "no": False}
"""Values of the option, by the word on the command line."""

MEASURED = ("psnr_pca", "psnr_init", "psnr_solved")
"""Figures of the images held out; null in the report if there are none."""


@click.command()
@click.argument("folder", type=options.FOLDER, metavar="FOLDER")
@options.output("Model to write.", "MODEL.npz")
@click.option("--size", type=options.Size(), default="256x256", help="Crop and resize to this.")
@click.option("--components", type=options.COUNTS, default=300, help="Limit, or one per channel.")
@click.option(
    "--energy",
    type=click.FloatRange(0, 1, min_open=True),
    metavar="SHARE",
    help="Keep this share of variance.",
)
@click.option(
    "--target-psnr",
    type=click.FloatRange(min=0, min_open=True),
    metavar="DB",
    help="Keep the fewest for this mean PSNR.",
)
@options.number("--gaussians", "Up to one per pixel.  [default: 5000]", least=1)
@options.choice(
    "--frequency-aware", list(FREQUENCY_AWARE), "Reserve a tenth for the first components."
)
@options.choice("--preset", ["default", "eigengs"], "Solve, or train (paper).")
@options.number("--iterations", "Training steps.  [default: 0; eigengs: 15000]", least=0)
@options.choice("--space", ["ycbcr", "rgb"], "Space of the components.")
@options.seed_option
@click.option("--preview", type=options.ANY_PATH, help="Picture of the components.")
@options.cluster_option
@options.backend_option
@options.report_option
@options.quiet_option
@click.pass_context
def train(
    context: click.Context,
    /,
    folder: Path | str,
    output: Path,
    cluster: str | None,
    backend: str | None,
    preview: Path | None,
    report: Path | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Train a model on a folder of images, or on its URL.

    A model is one set of Gaussians that renders all principal components of the images. One image
    in ten is held out and measured at the end. --energy counts the variance of each channel of
    the training images; --target-psnr measures PCA, in --space, of the images held out. After
    Ctrl-C or a crash, the same command resumes from the folder MODEL.npz.checkpoint. With --cluster
    the processes of a Dask cluster find components and weights; all see FOLDER and MODEL.npz.

    \b
    Examples:
      eigengs-dr train photos/ -o photos.npz --preview photos.png
      eigengs-dr train faces/ -o faces.npz --size 128x128 --components 90,30,30
      eigengs-dr train photos/ -o photos.npz --target-psnr 24
      eigengs-dr train /shared/faces/ -o /shared/faces.npz --cluster tcp://node1:8786
      eigengs-dr fit photo.jpg --basis photos.npz
    """
    from ..eigenbasis import training
    from ..eigenbasis.options import TrainOptions
    from ..fitting.options import default_count
    from ..image.folder import list_images
    from ..image.io import save_image
    from ..viewer.pictures import component_sheet

    [output] = name_outputs([folder], output, [".npz"])
    [picture] = name_pictures([folder], preview)
    check_outputs([output, picture, report], list_images(folder))
    select(backend)
    width, height = settings["size"]
    settings["gaussians"] = settings["gaussians"] or default_count(width * height)
    settings["frequency_aware"] = FREQUENCY_AWARE[settings["frequency_aware"]]
    chosen = TrainOptions(**settings)
    try:
        with open_cluster(cluster) as client, bar(quiet) as show:
            result = training.train(folder, output, chosen, backend, show, client)
    except training.Interrupted as error:
        say(f"interrupted; {error}")
        context.exit(INTERRUPTED)
    if picture:
        save_image(picture, component_sheet(result.model, result.basis))
    record = {"input": str(folder), "output": str(output), **dict.fromkeys(MEASURED)}
    record |= result.figures
    choices = vars(chosen) | {"most_components": chosen.components}
    write_report(report, describe_run(context, backend) | choices | record)
    if not quiet:
        click.echo(_summary(record, picture))


def _summary(record: dict[str, Any], preview: Path | None) -> str:
    """Describe a training for a terminal."""
    components = "+".join(map(str, record["components"]))
    text = (
        f"{record['input']}: {record['images']} images, {components} components, "
        f"{record['gaussians']} Gaussians in {record['seconds']:.1f} s; "
        f"{'split' if record['frequency_aware'] else 'not split'}\n  "
    )
    if record["psnr_pca"] is None:
        text += "no image was held out, so no psnr was measured; use at least 10 images"
    else:
        text += "held out: " + ", ".join(f"{name} {record[name]:.2f} dB" for name in MEASURED)
    wrote = f"{record['output']} and {preview}" if preview else record["output"]
    return f"{text}\n  wrote {wrote}"
