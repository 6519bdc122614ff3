"""``eigengs-dr bench``: one command a question. What a command needs is imported inside it."""

from __future__ import annotations

from pathlib import Path

import click

from eigengs_bench.cli_rows import budget, figures, pareto, rate, stability, tables
from eigengs_bench.names import CONDITIONS
from eigengs_bench.options import (
    about,
    chain,
    count_option,
    many_option,
    output_option,
    print_figures,
    run_options,
    save,
)
from eigengs_dr.backend import select
from eigengs_dr.cli_shared import (
    ANY_PATH,
    EXISTING,
    FOLDER,
    backend_option,
    quiet_option,
    report_option,
)
from eigengs_dr.console import progress_bar
from eigengs_dr.outputs import check_outputs
from eigengs_dr.report import write_report

figure_options = chain(report_option, quiet_option, click.pass_context)


@click.group()
def bench() -> None:
    """Measure speed and accuracy.

    \b
    Example:
      eigengs-dr bench kernels --report kernels.json
    """


for command in (tables, pareto, rate, budget, stability, figures):
    bench.add_command(command)


@bench.command()
@click.option(
    "--image",
    type=EXISTING,
    help="Image to refine, 512x512 or larger; by default a photo of scikit-image.",
)
@backend_option
@figure_options
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
    from eigengs_bench.experiments.kernels import run
    from eigengs_dr.images import load_image

    picture = load_image(image) if image else None
    with progress_bar(quiet) as show:
        figures = run(picture, backend, show)
    print_figures(figures, about(context, backend), report, quiet)


@bench.command()
@click.argument("basis", metavar="NAME|FILE")
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@count_option("--images", 20, "The first ones of the folder.")
@count_option("--iterations", 100, least=0)
@backend_option
@figure_options
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

    With --iterations 0 the starts themselves are measured.

    \b
    Examples:
      eigengs-dr bench eigen natural photos/ --iterations 0
      eigengs-dr bench eigen faces.npz faces-test/ --images 50 --report eigen.json
    """
    from eigengs_dr.images import image_files, load_image

    files = image_files(folder)[:images]
    check_outputs([report], files)
    select(backend)
    from eigengs_bench.experiments.eigen import run
    from eigengs_dr.bases import load_basis

    model = load_basis(basis, backend)
    with progress_bar(quiet) as show:
        figures = run(model, [load_image(file) for file in files], iterations, show)
    settings = {"basis": basis, "images": len(files), "iterations": iterations}
    print_figures(figures, {**about(context, backend), **settings}, report, quiet)


@bench.command()
@click.option("--variant", default="llvm_ad_rgb", show_default=True, help="Of Mitsuba.")
@figure_options
def texture(context: click.Context, variant: str, report: Path | None, quiet: bool) -> None:
    """Time a material ball with textures of Gaussians against one with a bitmap, in Mitsuba.

    \b
    Example:
      eigengs-dr bench texture --report texture.json
    """
    check_outputs([report], [])
    from eigengs_bench.experiments.texture import run

    with progress_bar(quiet) as show:
        figures = run(variant, show)
    run_about = about(context, "cuda" if "cuda" in variant else "llvm")
    print_figures(figures, {**run_about, "variant": variant}, report, quiet)


@bench.command()
@click.argument("image", type=EXISTING, metavar="IMAGE")
@click.option("--basis", default="natural", show_default=True, metavar="NAME|FILE")
@many_option("--condition", "conditions", CONDITIONS, "What photos are like, by default all")
@count_option("--steps", 200, least=2)
@backend_option
@click.option("--chart", type=ANY_PATH, help=".png, .svg or .pdf: PSNR over steps and seconds.")
@click.option(
    "--strip",
    type=ANY_PATH,
    metavar="S.png",
    help="Film strips, .png or .jpg, one a condition: S-cameras.png and so on.",
)
@figure_options
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

    \b
    Examples:
      eigengs-dr bench inverse photo.jpg --condition hidden --strip strip.png
      eigengs-dr bench inverse cat.jpg --basis cats.npz --report inverse.json --chart inverse.png
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
    from eigengs_dr.images import load_image

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


@bench.command()
@click.argument("image", type=EXISTING, required=False)
@output_option
@count_option("--gaussians", 5000)
@count_option("--levels", 4)
@count_option("--iterations", 1000)
@run_options
def levels(
    context: click.Context,
    image: Path | None,
    output: Path,
    gaussians: int,
    levels: int,
    iterations: int,
    seed: int,
    backend: str | None,
    quiet: bool,
) -> None:
    """Chart PSNR over how many Gaussians of a set are drawn.

    Without IMAGE a photo of scikit-image is fitted, at 256x256 pixels. FOLDER gets the chart
    levels.svg and the same as levels.csv.

    \b
    Examples:
      eigengs-dr bench levels -o levels/
      eigengs-dr bench levels photo.jpg -o levels/ --gaussians 20000 --levels 5
    """
    from eigengs_bench.experiments.levels import SAMPLE, SIDE, run
    from eigengs_bench.report.sections.levels import tell
    from eigengs_dr.images import load_image, sample
    from eigengs_dr.resampling import cropped

    output.mkdir(parents=True, exist_ok=True)
    files = [output / "levels.svg", output / "levels.csv"]
    check_outputs(files, [image] if image else [])
    select(backend)
    pixels = load_image(image) if image else cropped(sample(SAMPLE), SIDE, SIDE)
    with progress_bar(quiet) as show:
        rows = run(pixels, gaussians, levels, iterations, seed, backend, show)
    save(tell(rows, image.name if image else SAMPLE), output, quiet)


@bench.command()
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@output_option
@quiet_option
def report(folder: Path, output: Path, quiet: bool) -> None:
    """Write a page of what the other commands of bench left in a folder.

    Writes index.html, one file that needs no other, and README.md with pictures/ beside it. Every
    section names the commands, days, machines, versions and commits behind its figures.

    \b
    Example:
      eigengs-dr bench stability -o results/
      eigengs-dr bench pareto -o results/
      eigengs-dr bench report results/ -o page/
    """
    from eigengs_bench.report.page import write_page

    write_page(folder, output)
    if not quiet:
        click.echo(f"wrote {output / 'index.html'} and {output / 'README.md'}")
