"""``eigengs-dr bench``: measurements of speed and accuracy."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from .backend import select
from .cli_shared import (
    EXISTING,
    FOLDER,
    backend_option,
    described,
    quiet_option,
    report_option,
)
from .console import progress_bar
from .outputs import check_outputs
from .report import write_report


@click.group()
def bench() -> None:
    """Measure speed and accuracy.

    \b
    Example:
      eigengs-dr bench kernels --report kernels.json
    """


@bench.command()
@click.option(
    "--image",
    type=EXISTING,
    help="What is refined, 512x512 or larger; by default a photo of scikit-image.",
)
@backend_option
@report_option
@quiet_option
@click.pass_context
def kernels(
    context: click.Context,
    image: Path | None,
    backend: str | None,
    report: Path | None,
    quiet: bool,
) -> None:
    """Time the renderer and its derivatives against plain Dr.Jit and the machine's peak.

    \b
    Example:
      eigengs-dr bench kernels --report kernels.json
    """
    check_outputs([report], [])
    select(backend)
    import eigengs_dr as eg

    from .bench import kernels as benchmark

    picture = eg.load_image(image) if image else None
    with progress_bar(quiet) as show:
        figures = benchmark.run(picture, backend=backend, progress=partial(show, "kernels"))
    _tell(context, backend, report, quiet, figures)


@bench.command()
@click.argument("basis", metavar="NAME|FILE")
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@click.option("--images", type=click.IntRange(min=1), default=20, show_default=True)
@click.option("--iterations", type=click.IntRange(min=0), default=100, show_default=True)
@backend_option
@report_option
@quiet_option
@click.pass_context
def eigen(
    context: click.Context,
    basis: str,
    folder: Path,
    images: int,
    iterations: int,
    backend: str | None,
    report: Path | None,
    quiet: bool,
) -> None:
    """Compare the starts of a fit that a model gives with those the image alone gives.

    Uses the first images of the folder. With --iterations 0 the starts themselves are measured.

    \b
    Examples:
      eigengs-dr bench eigen natural photos/ --iterations 0
      eigengs-dr bench eigen faces.npz faces-test/ --images 50 --report eigen.json
    """
    from .images import image_files, load_image

    files = image_files(folder)[:images]
    check_outputs([report], files)
    select(backend)
    from .bases import load_basis
    from .bench import eigen as benchmark

    model = load_basis(basis, backend)
    with progress_bar(quiet) as show:
        figures = benchmark.run(
            model, [load_image(file) for file in files], iterations, partial(show, "eigen")
        )
    settings = {"basis": basis, "images": len(files), "iterations": iterations}
    _tell(context, backend, report, quiet, figures, **settings)


@bench.command()
@click.option("--variant", default="llvm_ad_rgb", show_default=True, help="Of Mitsuba.")
@report_option
@quiet_option
@click.pass_context
def texture(context: click.Context, variant: str, report: Path | None, quiet: bool) -> None:
    """Time a material ball with textures of Gaussians against one with a bitmap, in Mitsuba.

    \b
    Example:
      eigengs-dr bench texture --report texture.json
    """
    check_outputs([report], [])
    from .bench import texture as benchmark

    with progress_bar(quiet) as show:
        figures = benchmark.run(variant, progress=partial(show, "texture"))
    backend = "cuda" if "cuda" in variant else "llvm"
    _tell(context, backend, report, quiet, figures, variant=variant)


def _tell(
    context: click.Context,
    backend: str | None,
    report: Path | None,
    quiet: bool,
    figures: dict[str, float],
    **settings: Any,
) -> None:
    """Write the report and print the figures."""
    if report:
        write_report(report, {**described(context, backend), **settings, **figures})
    if not quiet:
        click.echo("\n".join(f"{key:24} {value:.4g}" for key, value in figures.items()))
