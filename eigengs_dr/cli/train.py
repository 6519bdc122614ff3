"""The command ``eigengs-dr train``: train an EigenGS model on a folder of images."""

import os
import time
from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from ..backend.types import Record
from . import options
from .console import INTERRUPTED, bar, open_cluster, print_message
from .outputs import check_outputs, lock_outputs, name_outputs, name_pictures

FREQUENCY_AWARE: dict[str, bool | str] = {"auto": "auto", "yes": True, "no": False}
"""Values of the option by their names on the command line."""

HELD_OUT_FIGURES = ("psnr_pca", "psnr_init", "psnr_solved")
"""Figures of the held-out images; null in the report if there are none."""


@click.command()
@click.argument("folder", type=options.images, metavar="FOLDER|PATTERN")
@options.output("Model to write.", "MODEL.npz")
@options.value("--size", "WxH", options.size, "Crop and resize the images to this size.", "256x256")
@options.value(
    "--components", "K|Y,CB,CR", options.counts, "Largest number of components per channel.", "300"
)
@options.value("--energy", "SHARE", float, "Keep components with this share of the variance.")
@options.value("--target-psnr", "DB", float, "Keep the fewest components for this mean PSNR.")
@options.number(
    "--gaussians", "Number of Gaussians, at most one per pixel.  [default: 5000]", minimum=1
)
@options.choice(
    "--frequency-aware",
    FREQUENCY_AWARE,
    "Reserve a tenth of the Gaussians for the first components.",
)
@options.choice("--preset", ["default", "eigengs"], "Solve for weights, or train like the paper.")
@options.number("--iterations", "Steps of the preset eigengs.  [default: 15000]", minimum=1)
@options.choice("--space", ["ycbcr", "rgb"], "Colour space of the components.")
@options.encoding
@options.number("--seed", "Random seed.", 0, minimum=0)
@options.value("--preview", "FILE", options.path, "Picture of the components.")
@options.value(
    "--lights", "DIRS.lp", options.EXISTING, "The photos show one object under these lights."
)
@options.value(
    "--max-psnr-drop", "DB", float, "Loss of left-out --lights for fewer Gaussians.  [default: 0.3]"
)
@options.shared("cluster", "backend", "report", "quiet")
def train(
    run: options.Run,
    folder: Path,
    output: Path,
    preview: Path | None,
    lights: Path | None,
    **choices: Any,
) -> None:
    """Train a model on the images of a folder or a pattern.

    A model is one set of Gaussians that renders all principal components of the images. One image
    in ten is held out; up to 100 of them are measured. --energy refers to each channel of the
    training images, --target-psnr to PCA, in --space, of the held-out images. After Ctrl-C or a
    crash, the same command resumes from MODEL.npz.checkpoint. All processes of a --cluster need
    access to FOLDER and MODEL.npz.

    With --lights, the folder holds photos of one object from one camera; the list names each photo
    and the direction of its light. 'eigengs-dr render' shows the object under any light.
    Then --components counts planes; by default, planes and Gaussians are as few as --max-psnr-drop
    allows, with 300 steps; and nothing resumes. If FOLDER holds one list (.lp), it is taken without
    --lights, which a note says; PATTERN trains a family.

    \b
    Examples:
      eigengs-dr train photos/ -o photos.npz --preview photos.png
      eigengs-dr train faces/ -o faces.npz --size 128x128 --components 90,30,30
      eigengs-dr train photos/ -o photos.npz --target-psnr 24
      eigengs-dr train /shared/faces/ -o /shared/faces.npz --cluster tcp://node1:8786
      eigengs-dr train coin/ -o coin.npz --lights coin/dirs.lp
    """
    lights = lights or _find_lights(run, folder)
    if lights is not None:
        return _train_on_lights(run, folder, output, lights, preview, choices)
    if choices.pop("max_psnr_drop") is not None:
        raise click.UsageError("--max-psnr-drop needs --lights; leave it out")
    from ..backend.interrupts import Interrupted
    from ..eigenbasis.components import TrainOptions
    from ..eigenbasis.training import train_model
    from ..fitting.options import default_count
    from ..image.folder import list_images
    from ..image.io import save_image
    from ..viewer.pictures import component_sheet

    files = list_images(folder)
    [output] = name_outputs([_named(folder)], output, [".npz"])
    [picture] = name_pictures([_named(folder)], preview)
    check_outputs([output, picture, run.report], files)
    select(run.backend)
    width, height = options.check_pixels(*choices["size"])
    choices["gaussians"] = choices["gaussians"] or default_count(width * height)
    choices["frequency_aware"] = FREQUENCY_AWARE[choices["frequency_aware"]]
    settings = TrainOptions(**choices)
    try:
        with open_cluster(run.cluster) as client, bar(run.quiet) as show:
            result = train_model(
                folder,
                output,
                settings,
                run.backend,
                lambda done, total, row: show(row["stage"], done, total),
                client,
            )
    except Interrupted as error:
        print_message(f"interrupted; {error}")
        run.write_report(vars(settings) | {"input": folder, "stopped": "interrupted"})
        run.context.exit(INTERRUPTED)
    if picture:
        save_image(picture, component_sheet(result.model, result.basis))
    figures: Record = dict.fromkeys(HELD_OUT_FIGURES) | result.figures
    record = {"input": folder, "output": output, "most_components": settings.components} | figures
    run.write_report(vars(settings) | record)
    components = "+".join(map(str, figures["components"]))
    split = "split" if figures["frequency_aware"] else "not split"
    if figures["psnr_pca"] is None:
        measured = "no image was held out, so no psnr was measured; use at least 10 images"
    else:
        psnrs = (f"{name} {figures[name]:.2f} dB" for name in HELD_OUT_FIGURES)
        measured = "held out: " + ", ".join(psnrs)
    run.tell(
        f"{folder}: {figures['images']} images, {components} components, "
        f"{figures['gaussians']} Gaussians in {figures['seconds']:.1f} s; "
        f"{split}",
        f"  {measured}",
        f"  wrote {output}" + (f" and {picture}" if picture else ""),
    )


def _named(folder: Path) -> Path:
    """Return the folder after which outputs are named; of a pattern, the one that holds it."""
    return folder if os.path.isdir(folder) else Path(folder).absolute().parent


def _find_lights(run: options.Run, folder: Path) -> Path | None:
    """Return the list of lights in a folder, and say so; None of a pattern or a family."""
    from ..image.folder import find_lists
    from ..image.formats import READ_SUFFIXES

    lists = find_lists(folder) if os.path.isdir(folder) else []
    if not lists:
        return None
    suffixes = sorted(path.suffix for path in Path(folder).iterdir() if path.name[0] != ".")
    suffix = next((name for name in suffixes if name.lower() in READ_SUFFIXES), "")
    family = f"give '{Path(folder) / '*'}{suffix}' to train a family"
    if len(lists) > 1:
        names = ", ".join(path.name for path in lists)
        listed = f"{folder}: holds {len(lists)} lists of lights ({names})"
        raise click.UsageError(f"{listed}; give one of them with --lights, or {family}")
    note = f"{lists[0]} names the lights of the photos"
    if given := _given(run, *FOR_FAMILIES, "components"):
        planes = ", name the list with --lights" * (given == "--components")
        raise click.UsageError(f"{note}; leave out {given}{planes}, or {family}")
    print_message(f"note: {note}: training a model of lights; {family}")
    return lists[0]


def _given(run: options.Run, *names: str) -> str:
    """Return those of some options that the command line holds, as it spells them."""
    source = run.context.get_parameter_source
    given = [name for name in names if source(name) == click.core.ParameterSource.COMMANDLINE]
    return ", ".join("--" + name.replace("_", "-") for name in given)


FOR_FAMILIES = ("size", "energy", "target_psnr", "frequency_aware", "preset", "space", "cluster")
"""Options that photos under known lights do not take."""


def _train_on_lights(
    run: options.Run,
    folder: Path,
    output: Path,
    lights: Path,
    preview: Path | None,
    choices: Record,
) -> None:
    """Fit a model to photos of one object under known lights, and write it."""
    import eigengs_dr as eg

    from ..image.folder import list_images
    from ..relight.lights import read_lights

    if given := _given(run, *FOR_FAMILIES):
        raise click.UsageError(f"{given} and --lights exclude each other; give one of them")
    planes = choices["components"] if _given(run, "components") else None
    if isinstance(planes, tuple):
        raise click.UsageError("--components is one number with --lights: that of planes")
    [output] = name_outputs([_named(folder)], output, [".npz"])
    [picture] = name_pictures([_named(folder)], preview)
    photos = folder if os.path.isdir(folder) else list_images(folder)
    photos, directions = read_lights(lights, photos)
    check_outputs([output, picture, run.report], [lights, *photos])
    lock_outputs(output)
    select(run.backend)
    steps = choices["iterations"]
    started, stopped = time.perf_counter(), False
    try:
        with bar(run.quiet) as show:
            model = eg.Relightable.fit(
                photos,
                directions,
                gaussians=choices["gaussians"],
                planes=planes,
                max_psnr_drop=choices["max_psnr_drop"],
                seed=choices["seed"],
                encoding=choices["encoding"],
                backend=run.backend,
                progress=lambda done, total, row: show(row.get("stage", "planes"), done, total),
                **({} if steps is None else {"iterations": steps}),
            )
    except eg.Interrupted as interrupt:
        model, stopped = interrupt.result, True
    model.save(output)
    if picture:
        eg.save_image(picture, eg.picture_of(model.relight((0, 0, 1))))
    seconds, planes = time.perf_counter() - started, model.planes.channels
    figures: Record = {"gaussians": len(model.planes), "planes": planes}
    figures |= {"lights": len(model.lights), "table": model.table.kind, "seconds": seconds}
    figures["psnr_held_out"] = model.psnr_held_out
    ending = {"stopped": "interrupted"} if stopped else {}
    run.write_report(figures | {"input": folder, "output": output} | ending)
    run.tell(
        f"{folder}: {len(model.lights)} photos, {planes} planes, {len(model.planes):,} Gaussians "
        f"in {seconds:.1f} s",
        f"  left-out lights: psnr_rgb {model.psnr_held_out:.2f} dB",
        f"  wrote {output}" + (f" and {picture}" if picture else ""),
    )
    if stopped:
        print_message(f"interrupted; the model so far is in {output}")
        run.context.exit(INTERRUPTED)
