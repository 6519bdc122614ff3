"""``eigengs-dr fit``: images to Gaussians."""

from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import click

from ..backend.selection import select
from .console import INTERRUPTED, progress_bar, say
from .options import (
    ANY_PATH,
    EXISTING,
    backend_option,
    choice,
    describe_run,
    quiet_option,
    report_option,
    seed_option,
)
from .outputs import check_outputs, name_outputs
from .report import write_report

MISSED = 1
"""Exit code where a PSNR that was asked for is out of reach."""


@click.command()
@click.argument("images", nargs=-1, required=True, type=EXISTING, metavar="IMAGE...")
@click.option("-o", "--output", required=True, type=ANY_PATH, help=".npz file; or a folder.")
@click.option(
    "--gaussians",
    type=click.IntRange(min=1),
    help="How many; by default 5000, one a pixel where the image has fewer pixels, or as many as "
    "the basis has.",
)
@click.option(
    "--target-psnr",
    type=click.FloatRange(min=0, min_open=True),
    metavar="DB",
    help="As few Gaussians as reach it, instead of a given number.",
)
@click.option(
    "--space",
    "target_space",
    type=click.Choice(["ycbcr", "rgb"]),
    default="ycbcr",
    show_default=True,
    help="Where --target-psnr is measured.",
)
@click.option(
    "--max-gaussians",
    type=click.IntRange(min=1),
    help="Most for --target-psnr; by default 3 for 8 pixels, which have as many numbers.",
)
@click.option(
    "--levels",
    type=click.IntRange(min=1),
    help="Levels of detail: the first quarter of the Gaussians makes the image too, and so on.",
)
@click.option("--iterations", type=click.IntRange(min=0), default=1000, show_default=True)
@choice("--init", ["auto", "random", "grid", "adaptive", "eigen"], "Where the Gaussians start.")
@click.option(
    "--basis",
    default="natural",
    show_default=True,
    metavar="NAME|FILE",
    help="What --init eigen starts from: a model by name, or as 'train' wrote it.",
)
@choice("--preset", ["default", "gaussianimage", "eigengs"], "The method.")
@choice(
    "--color",
    ["ycbcr", "rgb", "linear", "data"],
    "Where errors are measured and colours are stored: linear for textures, data for normals and "
    "roughness, as they are.",
)
@seed_option
@click.option(
    "--preview",
    type=ANY_PATH,
    help="Picture of the photo, the fit, and the outlines of its Gaussians; or a folder.",
)
@backend_option
@report_option
@quiet_option
@click.pass_context
def fit(
    context: click.Context,
    /,
    images: tuple[Path, ...],
    output: Path,
    backend: str | None,
    preview: Path | None,
    report: Path | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Fit images by sums of Gaussians.

    For several images OUT and the preview are folders, and the files are named like the images. A
    preview shows a photo, its fit, and the outlines of at most 2,000 Gaussians at one standard
    deviation.
    Ctrl-C keeps the best fit so far: it is written before the command ends with exit code 130.

    --target-psnr searches for the smallest number of Gaussians, in up to about twice the
    iterations. A target that is out of reach is said so, the best fit is written, and the exit code
    is 1.

    With --preset eigengs, the paper's form, the file holds the Gaussians alone, without the mean
    image, which is kept in the basis.

    With --color data a grey file gives one channel, any other three; psnr_ycbcr in the report is
    then the PSNR of the data as it is, and psnr_rgb that of 8 bits.

    \b
    Examples:
      eigengs-dr fit photo.jpg -o photo.npz
      eigengs-dr fit photo.jpg -o photo.npz --gaussians 20000 --report photo.json
      eigengs-dr fit photo.jpg -o photo.npz --target-psnr 38
      eigengs-dr fit photo.jpg -o photo.npz --gaussians 5000 --levels 4
      eigengs-dr fit photo.jpg -o photo.npz --init eigen --iterations 100
      eigengs-dr fit *.png -o fits/ --preview previews/ --iterations 300
      eigengs-dr fit roughness.png -o roughness.npz --color data
    """
    from ..image.io import SAVE_OPTIONS

    _check_search(**settings)
    outputs = name_outputs(images, output, [".npz"])
    previews = name_outputs(images, preview, list(SAVE_OPTIONS)) if preview else []
    check_outputs([*outputs, *previews, report], images)
    select(backend)

    resolved = settings | {"basis": _basis(backend, **settings), "backend": backend}
    records: list[dict[str, Any]] = []
    for image, target, picture in zip_longest(images, outputs, previews):
        records.append(_fit_one(image, target, picture, quiet, **resolved))
        if records[-1]["stopped"] == "interrupted":
            break
    if report:
        figures = records[0] if len(images) == 1 else {"images": records}
        write_report(report, {**describe_run(context, backend), **settings, **figures})
    if records[-1]["stopped"] == "interrupted":
        say(f"interrupted; the best fit so far is in {records[-1]['output']}")
        context.exit(INTERRUPTED)
    missed = [record for record in records if record["stopped"] == "out of reach"]
    for record in missed:
        say(_out_of_reach(record, **settings))
    if missed:
        context.exit(MISSED)


def _check_search(
    target_psnr: float | None, target_space: str, max_gaussians: int | None, **rest: Any
) -> None:
    """Refuse options of a search where none is asked for."""
    if target_psnr is None and (max_gaussians is not None or target_space != "ycbcr"):
        raise click.UsageError("--max-gaussians and --space belong to --target-psnr; name it, too")


def _basis(backend: str | None, init: str, preset: str, basis: str, **rest: Any) -> Any:
    """Read the model to start from, once for all images; its name where none is needed."""
    from ..eigenbasis.registry import load_basis
    from ..fitting.presets import PRESETS

    method = PRESETS[preset]
    if (method.init if init == "auto" else init) != "eigen":
        return basis
    if method.mean == "dense":
        say("note: the result is the Gaussians alone; the mean image is kept in the basis")
    return load_basis(basis, backend)


def _fitted(image: Any, levels: int | None, progress: Any, **settings: Any) -> Any:
    """Fit an image in one way or the other."""
    import eigengs_dr as eg

    if levels is None:
        return eg.fit(image, progress=progress, **settings)
    if settings["target_psnr"] is not None:
        raise ValueError("levels and target_psnr exclude each other; give one of them")
    if settings["preset"] != "default" or settings["init"] not in ("auto", "adaptive"):
        raise ValueError("levels work with preset 'default' and init 'adaptive' alone")
    kept = {key: settings[key] for key in ("gaussians", "iterations", "color", "seed", "backend")}
    return eg.fit_levels(image, levels=levels, progress=progress, **kept)


def _fit_one(
    path: Path, output: Path, preview: Path | None, quiet: bool, **settings: Any
) -> dict[str, Any]:
    """Fit one image, write what was asked for, and return its figures."""
    import eigengs_dr as eg

    from ..image.metrics import float_space
    from .pictures import comparison

    color = settings["color"]
    image = eg.load_image(path, keep_grey=color == "data")
    with progress_bar(quiet) as show:
        try:
            result = _fitted(image, progress=partial(show, path.name), **settings)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    result.gaussians.save(output)
    if preview:
        eg.save_image(preview, comparison(image, result.image, result.gaussians))
    record = {
        "input": str(path),
        "output": str(output),
        "width": image.shape[1],
        "height": image.shape[0],
        "gaussians": len(result.gaussians),
        "iterations": result.iterations,
        "stopped": result.stopped,
        "seconds": result.seconds,
        "seconds_init": result.seconds_init,
        "psnr_ycbcr": eg.psnr(image, result.image, space=float_space(color)),
        "psnr_rgb": eg.psnr(image, result.image, space="rgb"),
        "ssim": eg.ssim(image, result.image),
        "ms_ssim": eg.ms_ssim(image, result.image, space=float_space(color)),
        "trace": result.trace,
    }
    if not quiet:
        click.echo(_summary(record, preview, float_space(color)))
    return record


def _out_of_reach(
    record: dict[str, Any], target_psnr: float, target_space: str, **rest: Any
) -> str:
    """What to do where no number of Gaussians was enough."""
    return (
        f"{record['input']}: {target_psnr:g} dB are out of reach: {record['gaussians']} Gaussians "
        f"have {record['psnr_' + target_space]:.2f}; lower --target-psnr, or allow more by "
        "--max-gaussians or --iterations"
    )


def _summary(record: dict[str, Any], preview: Path | None, space: str) -> str:
    """What a fit came to, for a terminal."""
    text = (
        "{input}: {width}x{height}, {gaussians} Gaussians, {iterations} iterations "
        "in {seconds:.1f} s\n  psnr_{space} {psnr_ycbcr:.2f} dB, psnr_rgb {psnr_rgb:.2f} dB, "
        "SSIM {ssim:.4f}, MS-SSIM {ms_ssim:.4f}\n  wrote {output}"
    ).format(**record, space=space)
    return f"{text}\n  wrote {preview} (photo, fit and outlines side by side)" if preview else text
