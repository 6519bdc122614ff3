"""``eigengs-dr train``: a folder of images to an EigenGS model."""

from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from .console import INTERRUPTED, progress_bar, say
from .options import (
    ANY_PATH,
    FOLDER,
    Counts,
    Size,
    backend_option,
    choice,
    describe_run,
    quiet_option,
    report_option,
    seed_option,
)
from .outputs import check_outputs, name_outputs
from .report import write_report

FREQUENCY_AWARE: dict[str, bool | str] = {"auto": "auto", "yes": True, "no": False}
"""What the words of the option stand for."""

MEASURED = ("psnr_pca", "psnr_init", "psnr_solved")
"""Figures of the images held out; null in the report where there are none."""


@click.command()
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@click.option("-o", "--output", required=True, type=ANY_PATH, metavar="MODEL.npz")
@click.option(
    "--size",
    type=Size(),
    default="256x256",
    show_default=True,
    help="Width and height in pixels, to which the images are cropped and resized.",
)
@click.option(
    "--components",
    type=Counts(),
    default=300,
    show_default=True,
    help="The most kept of each colour channel; one number, or three such as 230,60,60.",
)
@click.option(
    "--energy",
    type=click.FloatRange(0, 1, min_open=True),
    help="Keep as few components as hold this share of a channel's variance, such as 0.99.",
)
@click.option(
    "--target-psnr",
    type=click.FloatRange(min=0, min_open=True),
    metavar="DB",
    help="Keep as few components as the images held out need for this mean PSNR of their PCA.",
)
@click.option(
    "--gaussians",
    type=click.IntRange(min=1),
    help="How many; by default 5000, or one a pixel where there are fewer pixels.",
)
@choice(
    "--frequency-aware",
    list(FREQUENCY_AWARE),
    "Whether a tenth of the Gaussians serve the first components alone.",
)
@choice("--preset", ["default", "eigengs"], "Solve for the weights; or train all, as the paper.")
@click.option(
    "--steps",
    type=click.IntRange(min=0),
    help="Steps of training; by default 0, or 15000 with --preset eigengs.",
)
@choice("--color", ["ycbcr", "rgb"], "Space of the components.")
@seed_option
@click.option("--preview", type=ANY_PATH, help="Picture of the components and their Gaussians.")
@backend_option
@report_option
@quiet_option
@click.pass_context
def train(
    context: click.Context,
    /,
    folder: Path,
    output: Path,
    backend: str | None,
    preview: Path | None,
    report: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Train an eigenbasis of Gaussians on the images of a folder.

    One image in ten is held out, and measured at the end. How many components are enough,
    --energy tells by the images trained on, --target-psnr by those held out: psnr_ycbcr, or with
    --color rgb the same of these channels. `eigengs-dr info` shows what fewer would reach.

    What is done is kept in the folder
    MODEL.npz.checkpoint: after Ctrl-C or a crash, the same command goes on from there.

    \b
    Examples:
      eigengs-dr train photos/ -o photos.npz --preview photos.png --report photos.json
      eigengs-dr train faces/ -o faces.npz --size 128x128 --components 100 --gaussians 2000
      eigengs-dr train photos/ -o photos.npz --energy 0.95
      eigengs-dr train photos/ -o photos.npz --target-psnr 24
      eigengs-dr fit photo.jpg -o photo.npz --init eigen --basis photos.npz
    """
    from ..image.folder import image_files
    from ..image.io import SAVE_OPTIONS

    [output] = name_outputs([folder], output, [".npz"])
    [picture] = name_outputs([folder], preview, list(SAVE_OPTIONS)) if preview else [None]
    check_outputs([output, picture, report], image_files(folder))
    select(backend)
    from ..eigenbasis import training

    settings = _settings(**options)
    try:
        with progress_bar(quiet) as show:
            trained = training.train(folder, output, settings, backend, show)
    except training.Interrupted as error:
        say(f"interrupted; {error}")
        context.exit(INTERRUPTED)
    if picture:
        _save_sheet(picture, trained)
    record = {"input": str(folder), "output": str(output), **_figures(trained.figures)}
    if report:
        chosen = {**vars(settings), "most_components": settings.components}
        write_report(report, {**describe_run(context, backend), **chosen, **record})
    if not quiet:
        click.echo(_summary(record, picture))


def _settings(gaussians: int | None, frequency_aware: str, **options: Any) -> Any:
    """Turn options into the settings of a training."""
    from ..eigenbasis.training import TrainOptions
    from ..fitting.options import default_count

    width, height = options["size"]
    return TrainOptions(
        gaussians=gaussians or default_count(width * height),
        frequency_aware=FREQUENCY_AWARE[frequency_aware],
        **options,
    )


def _figures(figures: dict[str, Any]) -> dict[str, Any]:
    """All figures of a report, also of what was not measured."""
    return {**dict.fromkeys(MEASURED), **figures}


def _save_sheet(path: Path, trained: Any) -> None:
    from ..image.io import save_image
    from .pictures import component_sheet

    save_image(path, component_sheet(trained.model, trained.basis))


def _summary(record: dict[str, Any], preview: Path | None) -> str:
    """What a training came to, for a terminal."""
    components = "+".join(map(str, record["components"]))
    text = (
        f"{record['input']}: {record['images']} images, {components} components, "
        f"{record['gaussians']} Gaussians in {record['seconds']:.1f} s; "
        f"{'split' if record['frequency_aware'] else 'not split'} ({record['split_reason']})\n  "
    )
    if record["psnr_pca"] is None:
        text += "no image was held out, so no psnr was measured; that takes 10 images"
    else:
        text += "held out: " + ", ".join(f"{name} {record[name]:.2f} dB" for name in MEASURED)
    wrote = f"{record['output']} and {preview}" if preview else record["output"]
    return f"{text}\n  wrote {wrote}"
