"""``eigengs-dr bench``: measurements of speed and accuracy."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from .backend.selection import select
from .cli.console import progress_bar
from .cli.levels import levels
from .cli.options import (
    ANY_PATH,
    EXISTING,
    FOLDER,
    backend_option,
    describe_run,
    quiet_option,
    report_option,
)
from .cli.outputs import check_outputs
from .cli.report import write_report
from .cli_budget import budget
from .cli_figures import figures
from .cli_pareto import pareto
from .cli_rate import rate
from .cli_report import report as make_report
from .cli_stability import stability
from .cli_tables import tables

CONDITIONS = ("cameras", "grazing", "hidden", "noise")
"""Of `inverse`, without importing Mitsuba, which their module does."""


@click.group()
def bench() -> None:
    """Measure speed and accuracy.

    \b
    Example:
      eigengs-dr bench kernels --report kernels.json
    """


for command in (tables, pareto, rate, budget, levels, stability, figures, make_report):
    bench.add_command(command)


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
    from .image.folder import image_files
    from .image.io import load_image

    files = image_files(folder)[:images]
    check_outputs([report], files)
    select(backend)
    from .bench import eigen as benchmark
    from .eigenbasis.registry import load_basis

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


@bench.command()
@click.argument("image", type=EXISTING, metavar="IMAGE")
@click.option("--basis", default="natural", show_default=True, metavar="NAME|FILE")
@click.option(
    "--condition",
    "conditions",
    multiple=True,
    type=click.Choice(CONDITIONS),
    help="What the photos are like; may be repeated. By default all.",
)
@click.option("--steps", type=click.IntRange(min=2), default=200, show_default=True)
@backend_option
@report_option
@click.option("--chart", type=ANY_PATH, help=".png, .svg or .pdf: PSNR over steps and seconds.")
@click.option(
    "--strip",
    type=ANY_PATH,
    metavar="S.png",
    help="Film strips, one a condition: S-cameras.png and so on.",
)
@quiet_option
@click.pass_context
def inverse(
    context: click.Context,
    image: Path,
    basis: str,
    conditions: tuple[str, ...],
    steps: int,
    backend: str | None,
    report: Path | None,
    chart: Path | None,
    strip: Path | None,
    quiet: bool,
) -> None:
    """Recover a poster from photos by texels, Gaussians, coefficients of a basis, and the last two.

    The image hangs on a wall in Mitsuba, and every method gets as many steps of gradient descent.
    All conditions take some ten minutes.

    \b
    Examples:
      eigengs-dr bench inverse photo.jpg --condition hidden --strip strip.png
      eigengs-dr bench inverse cat.jpg --basis cats.npz --report inverse.json --chart inverse.png
    """
    from .image.io import SAVE_OPTIONS, load_image, save_image

    names = tuple(dict.fromkeys(conditions)) or CONDITIONS
    strips = {name: strip.with_stem(f"{strip.stem}-{name}") for name in names} if strip else {}
    check_outputs([report, chart, *strips.values()], [image])
    for path, known in ((chart, (".png", ".svg", ".pdf")), (strip, tuple(SAVE_OPTIONS))):
        if path and path.suffix.lower() not in known:
            raise ValueError(f"{path}: the name must end in {' or '.join(known)}")
    select(backend)
    try:
        from .bench import inverse as benchmark
        from .bench import inverse_pictures as pictures

        if chart:
            import matplotlib.figure  # noqa: F401  asked for now, not after ten minutes
    except ImportError as error:
        raise ValueError(
            f"bench inverse: {error}; pip install 'eigengs-dr[plugins,charts]'"
        ) from error
    with progress_bar(quiet) as show:
        results = benchmark.run(basis, load_image(image), names, steps, backend, show)
    for name, path in strips.items():
        save_image(path, pictures.strip(results[name]))
    if chart:
        pictures.save_chart(chart, results)
    settings = {"image": str(image), "basis": basis, "steps": steps}
    if report:
        traces = benchmark.traces_of(results)
        figures = {**settings, **benchmark.figures_of(results), "traces": traces}
        write_report(report, {**describe_run(context, backend), **figures})
    if not quiet:
        click.echo(benchmark.table(results))


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
        write_report(report, {**describe_run(context, backend), **settings, **figures})
    if not quiet:
        click.echo("\n".join(f"{key:24} {value:.4g}" for key, value in figures.items()))
