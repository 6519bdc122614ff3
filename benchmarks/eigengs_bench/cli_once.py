"""The commands that measure once, and keep no rows."""

from pathlib import Path
from typing import Any

import click

from eigengs_bench.names import CONDITIONS
from eigengs_bench.options import (
    about,
    count_option,
    many_option,
    output_option,
    prints_figures,
    save,
)
from eigengs_dr.backend.selection import select
from eigengs_dr.cli.console import progress_bar
from eigengs_dr.cli.options import (
    ANY_PATH,
    EXISTING,
    FOLDER,
    backend_option,
    quiet_option,
    report_option,
    seed_option,
)
from eigengs_dr.cli.outputs import check_outputs
from eigengs_dr.cli.report import write_report


@click.command()
@backend_option
@prints_figures
def kernels(show: Any, backend: str | None) -> Any:
    """Time the renderer and its derivatives against plain Dr.Jit and the machine's peak."""
    select(backend)
    from eigengs_bench.experiments.kernels import run

    return backend, {}, run(backend, show)


@click.command()
@click.argument("basis", metavar="NAME|FILE")
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@count_option("--images", 20, "The first ones of the folder.")
@count_option("--iterations", 100, "With 0 the starts themselves are measured.", 0)
@backend_option
@prints_figures
def eigen(
    show: Any, basis: str, folder: Path, images: int, iterations: int, backend: str | None
) -> Any:
    """Compare the starts of a fit that a model gives with those the image alone gives."""
    select(backend)
    from eigengs_bench.experiments.eigen import run
    from eigengs_dr.eigenbasis.registry import load_basis
    from eigengs_dr.image.folder import image_files
    from eigengs_dr.image.io import load_image

    pictures = [load_image(file) for file in image_files(folder)[:images]]
    settings = {"basis": basis, "images": len(pictures), "iterations": iterations}
    return backend, settings, run(load_basis(basis, backend), pictures, iterations, show)


@click.command()
@click.option("--variant", default="llvm_ad_rgb", show_default=True, help="Of Mitsuba.")
@prints_figures
def texture(show: Any, variant: str) -> Any:
    """Time a material ball with textures of Gaussians against one with a bitmap, in Mitsuba."""
    from eigengs_bench.experiments.texture import run

    return "cuda" if "cuda" in variant else "llvm", {"variant": variant}, run(variant, show)


@click.command()
@click.argument("image", type=EXISTING, metavar="IMAGE")
@click.option("--basis", default="natural", show_default=True, metavar="NAME|FILE")
@many_option("--condition", "conditions", CONDITIONS, "What photos are like, by default all")
@count_option("--steps", 200, least=2)
@backend_option
@click.option("--chart", type=ANY_PATH, help=".png, .svg or .pdf: PSNR over steps and seconds.")
@click.option("--strip", type=ANY_PATH, metavar="S.png", help="Film strips: S-cameras.png, ...")
@report_option
@quiet_option
@click.pass_context
def inverse(
    context: click.Context,
    image: Path,
    basis: str,
    conditions: tuple[str, ...],
    steps: int,
    backend: str | None,
    chart: Path | None,
    strip: Path | None,
    report: Path | None,
    quiet: bool,
) -> None:
    """Recover a poster from photos by texels, Gaussians, coefficients of a basis, and the last two.

    The image hangs on a wall in Mitsuba, and every method gets as many steps of gradient descent.
    All conditions take some ten minutes.
    """
    names = tuple(dict.fromkeys(conditions)) or CONDITIONS
    strips = {name: strip.with_stem(f"{strip.stem}-{name}") for name in names} if strip else {}
    check_outputs([report, chart, *strips.values()], [image])
    for path, known in ((chart, (".png", ".svg", ".pdf")), (strip, (".png", ".jpg"))):
        if path and path.suffix.lower() not in known:
            raise ValueError(f"{path}: the name must end in {' or '.join(known)}")
    select(backend)
    try:
        from eigengs_bench.experiments.inverse import figures_of, run, traces_of
    except ImportError as error:
        raise ValueError(f"bench inverse: {error}; pip install 'eigengs-dr[plugins]'") from error
    from eigengs_bench.report.charts import save_figure
    from eigengs_bench.report.frames import as_text
    from eigengs_bench.report.sections.inverse import film_strip, results_chart, results_table
    from eigengs_bench.report.strips import save_strip
    from eigengs_dr.image.io import load_image

    with progress_bar(quiet) as show:
        results = run(basis, load_image(image), names, steps, backend, show)
    for name, path in strips.items():
        save_strip(path, film_strip(results[name]))
    if chart:
        save_figure(chart, results_chart(results))
    if report:
        settings = {"image": str(image), "basis": basis, "steps": steps}
        figures = {"results": figures_of(results), "traces": traces_of(results)}
        write_report(report, {**about(context, backend), **settings, **figures})
    if not quiet:
        click.echo(as_text(results_table(results)))


@click.command()
@click.argument("image", type=EXISTING, required=False)
@output_option
@count_option("--gaussians", 5000)
@count_option("--levels", 4)
@count_option("--iterations", 1000)
@seed_option
@backend_option
@quiet_option
def levels(
    image: Path | None, output: Path, gaussians: int, levels: int, quiet: bool, **settings: Any
) -> None:
    """Chart PSNR over how many Gaussians of a set are drawn: levels.svg and levels.csv in FOLDER.

    Without IMAGE a photo of scikit-image is fitted, at 256x256 pixels.
    """
    output.mkdir(parents=True, exist_ok=True)
    check_outputs([output / "levels.svg", output / "levels.csv"], [image] if image else [])
    select(settings["backend"])
    from eigengs_bench.experiments.levels import SAMPLE, SIDE, run
    from eigengs_bench.report.sections.levels import tell
    from eigengs_dr.image.io import load_image
    from eigengs_dr.image.resize import center_crop
    from eigengs_dr.image.samples import sample

    pixels = load_image(image) if image else center_crop(sample(SAMPLE), SIDE, SIDE)
    with progress_bar(quiet) as show:
        rows = run(pixels, gaussians, levels, show, **settings)
    save(tell(rows, image.name if image else SAMPLE), output, quiet)
