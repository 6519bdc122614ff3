"""The command ``eigengs-dr train``: train an EigenGS model on a folder of images."""

from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from ..backend.types import Record
from . import options
from .console import INTERRUPTED, bar, open_cluster, say
from .outputs import check_outputs, name_outputs, name_pictures

FREQUENCY_AWARE: dict[str, bool | str] = {"auto": "auto", "yes": True, "no": False}
"""Values of the option, by the word on the command line."""

MEASURED = ("psnr_pca", "psnr_init", "psnr_solved")
"""Figures of the images held out; null in the report if there are none."""


@click.command()
@click.argument("folder", type=options.folder, metavar="FOLDER")
@options.output("Model to write.", "MODEL.npz")
@options.value("--size", "WxH", options.size, "Crop and resize to this.", "256x256")
@options.value("--components", "K|Y,CB,CR", options.counts, "Limit, or one per channel.", "300")
@options.value("--energy", "SHARE", float, "Keep this share of variance.")
@options.value("--target-psnr", "DB", float, "Keep the fewest for this mean PSNR.")
@options.number("--gaussians", "Up to one per pixel.  [default: 5000]", least=1)
@options.choice("--frequency-aware", FREQUENCY_AWARE, "Reserve a tenth for the first components.")
@options.choice("--preset", ["default", "eigengs"], "Solve, or train (paper).")
@options.number("--iterations", "Training steps.  [default: 0; eigengs: 15000]", least=0)
@options.choice("--space", ["ycbcr", "rgb"], "Space of the components.")
@options.number("--seed", "Seed of random numbers.", 0, least=0)
@options.value("--preview", "FILE", options.path, "Picture of the components.")
@options.shared("cluster", "backend", "report", "quiet")
def train(
    run: options.Run, folder: Path | str, output: Path, preview: Path | None, **choices: Any
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
    check_outputs([output, picture, run.report], list_images(folder))
    select(run.backend)
    width, height = options.check_pixels(*choices["size"])
    choices["gaussians"] = choices["gaussians"] or default_count(width * height)
    choices["frequency_aware"] = FREQUENCY_AWARE[choices["frequency_aware"]]
    settings = TrainOptions(**choices)
    try:
        with open_cluster(run.cluster) as client, bar(run.quiet) as show:
            result = training.train(folder, output, settings, run.backend, show, client)
    except training.Interrupted as error:
        say(f"interrupted; {error}")
        run.write_report(vars(settings) | {"input": folder, "stopped": "interrupted"})
        run.context.exit(INTERRUPTED)
    if picture:
        save_image(picture, component_sheet(result.model, result.basis))
    found: Record = dict.fromkeys(MEASURED) | result.figures
    record = {"input": folder, "output": output, "most_components": settings.components} | found
    run.write_report(vars(settings) | record)
    components = "+".join(map(str, found["components"]))
    split = "split" if found["frequency_aware"] else "not split"
    if found["psnr_pca"] is None:
        measured = "no image was held out, so no psnr was measured; use at least 10 images"
    else:
        measured = "held out: " + ", ".join(f"{name} {found[name]:.2f} dB" for name in MEASURED)
    run.tell(
        f"{folder}: {found['images']} images, {components} components, "
        f"{found['gaussians']} Gaussians in {found['seconds']:.1f} s; "
        f"{split}",
        f"  {measured}",
        f"  wrote {output}" + (f" and {picture}" if picture else ""),
    )
