"""``eigengs-dr bench``: one command a question. Each command imports what it needs."""

from pathlib import Path
from typing import Any

import click

from eigengs_bench.harness.store import Task
from eigengs_bench.names import CONDITIONS, FIGURES, NATURAL, PAPER_SETS, PRESETS, SETS, TABLES
from eigengs_bench.options import (
    count_option,
    data_argument,
    many_option,
    measures_rows,
    output_option,
    prints_figures,
    save,
    set_options,
)
from eigengs_dr.backend.selection import select
from eigengs_dr.cli import options
from eigengs_dr.cli.console import progress_bar, say
from eigengs_dr.cli.options import ANY_PATH, EXISTING, FOLDER, backend_option, quiet_option
from eigengs_dr.cli.outputs import check_outputs

Names = tuple[str, ...]


@click.group()
def bench() -> None:
    """Measure speed and accuracy.

    Commands that take -o FOLDER keep their measurements there as lines of JSON: the same command
    goes on after a break, and one with more sets or images adds lines. DATA has a folder a set
    (faces256, cats512, cars256, natural256), with images to train on in train/ and others in test/;
    kodak has no parts.
    """


@bench.command()
@click.argument("data", type=FOLDER, metavar="DATA")
@many_option("--set", "names", SETS, "Which images, by default all but kodak")
@many_option("--table", "tables", TABLES, "Which tables, by default all")
@count_option("--images", 20, "Of each set.")
@measures_rows("tables.jsonl")
def tables(task: Task, names: Names, tables: Names) -> Any:
    """Measure every method on images of test folders, on which nothing was trained or tuned.

    \b
    main      gaussianimage, default, and eigengs with its own and with the universal basis
    ablation  eigengs in YCbCr or RGB, with and without the frequency-aware split
    cross     eigengs with the basis of other images
    reach     how soon default has the PSNR that gaussianimage ends with

    models/ of FOLDER keeps trained bases and models: about a gigabyte a set.
    """
    from eigengs_bench.experiments.tables import run
    from eigengs_bench.report.sections.methods import summarize

    return summarize(run(task, names or PAPER_SETS, tables or TABLES))


@bench.command()
@measures_rows("pareto.jsonl")
@set_options(3)
def pareto(task: Task, names: Names) -> Any:
    """Measure speed against accuracy: fits that differ from the default one in one setting.

    FOLDER gets a chart a set, and charts of the renderer and of storage. An image takes about two
    minutes.
    """
    from eigengs_bench.experiments.pareto import run
    from eigengs_bench.report.sections.pareto import summarize

    return summarize(run(task, names))


@bench.command()
@measures_rows("rate.jsonl")
@set_options(3)
def rate(task: Task, names: Names) -> Any:
    """Compare packed fits with JPEG and WebP at equal size.

    FOLDER gets a chart a set. An image of 256x256 pixels takes a minute.
    """
    from eigengs_bench.experiments.rate import run
    from eigengs_bench.report.sections.rate import summarize

    return summarize(run(task, names))


@bench.command()
@click.option(
    "--target",
    "targets",
    multiple=True,
    type=click.FloatRange(0, 100, min_open=True),
    default=(32.0, 36.0, 40.0),
    show_default=True,
    help="PSNR in YCbCr to reach; may be repeated.",
)
@measures_rows("budget.jsonl")
@set_options(20, NATURAL)
def budget(task: Task, names: Names, targets: tuple[float, ...]) -> Any:
    """Measure how many Gaussians a PSNR takes: of fits of fixed numbers, and by the search.

    \b
    On every image, in this order:
      fits of fixed numbers, Gaussians placed once, until two enclose each target
      the search of fit --target-psnr, and a default fit of the number it found
      fits of one number, Gaussians placed once, and placed anew on the way

    FOLDER gets a chart a set. An image of 256x256 pixels takes a minute or two.
    """
    from eigengs_bench.experiments.budget import run
    from eigengs_bench.report.sections.budget import summarize

    if any(target != target for target in targets):  # NaN is inside every click.FloatRange
        raise ValueError("--target is nan; it must be above 0 and at most 100")
    return summarize(run(task, names, tuple(dict.fromkeys(targets))))


@bench.command()
@click.option("--case", "cases", multiple=True, help="By default all; may be repeated.")
@many_option("--preset", "presets", PRESETS, "By default all")
@measures_rows("stability.jsonl", iterations=10_000, least=0)
def stability(task: Task, cases: Names, presets: Names) -> Any:
    """Try every preset on hard cases: odd images, odd starts, rates too high.

    With the case "smooth" the command draws stability-tiles.png: what tiling looks like. All cases
    take about ten minutes; the case "large" takes gigabytes.
    """
    from eigengs_bench.experiments.stability import run, tiles_of
    from eigengs_bench.experiments.stability_cases import chosen_cases
    from eigengs_bench.report.charts import save_figure, tiles_chart
    from eigengs_bench.report.page import TILES
    from eigengs_bench.report.sections.stability import summarize

    chosen = chosen_cases(cases, task.iterations)
    rows = run(task, chosen, presets or PRESETS)
    for smooth in (case for case in chosen if case.name == "smooth"):
        save_figure(task.folder / TILES, tiles_chart(smooth.image(), tiles_of(task, smooth)))
    return summarize(rows)


@bench.command()
@data_argument
@many_option("--figure", "figures", FIGURES, "What to draw, by default all")
@count_option("--images", 8, "Test images a set, for curves and radii.")
@measures_rows("curves.jsonl")
def figures(task: Task, figures: Names) -> Any:
    """Draw the pictures of the paper, with our fits.

    \b
    iterations  fits at iterations 0, 10, 100 and the last, by every preset
    colors      fits in YCbCr and in RGB, and their errors
    curves      PSNR every 50 iterations
    radii       how large Gaussians are, with the frequency-aware split and without
    split       what Gaussians for low and for high frequencies render alone
    cross       images projected on bases of other images

    Without DATA the command fits photos of scikit-image, and leaves out figures that need more.
    FOLDER/figures.json lists the pictures with captions and credits.
    """
    from eigengs_bench.experiments.figures import run
    from eigengs_bench.report.frames import Section, table

    lines = [(task.folder / figure.path, figure.caption) for figure in run(task, figures, say)]
    return Section([table("Pictures", ("file", "caption"), lines)])


@bench.command()
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@output_option
@quiet_option
def report(folder: Path, output: Path, quiet: bool) -> None:
    """Write a page of the results that the other commands of bench keep in a folder.

    The page is index.html, one file that needs no other, and README.md with pictures/ beside it.
    Every section names the commands, days, machines, versions and commits behind its figures.
    """
    from eigengs_bench.report.page import write_page

    write_page(folder, output)
    if not quiet:
        click.echo(f"wrote {output / 'index.html'} and {output / 'README.md'}")


@bench.command()
@backend_option
@prints_figures
def kernels(show: Any, backend: str | None) -> Any:
    """Time the renderer and its derivatives against plain Dr.Jit and the machine's peak."""
    from eigengs_bench.experiments.kernels import run

    return run(backend, show), ""


@bench.command()
@click.argument("basis", metavar="NAME|FILE")
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@count_option("--images", 20, "The first ones of the folder.")
@count_option("--iterations", 100, "With 0 the command measures the starts themselves.", 0)
@backend_option
@prints_figures
def eigen(show: Any, basis: str, folder: Path, images: int, iterations: int, backend: Any) -> Any:
    """Compare starts of a fit: by a model, and by the image alone."""
    from eigengs_bench.experiments.eigen import run
    from eigengs_dr.eigenbasis.registry import load_basis
    from eigengs_dr.image.folder import image_files
    from eigengs_dr.image.io import load_image

    pictures = [load_image(file) for file in image_files(folder)[:images]]
    return run(load_basis(basis, backend), pictures, iterations, show), ""


@bench.command()
@click.option("--variant", default="llvm_ad_rgb", show_default=True, help="Of Mitsuba.")
@prints_figures
def texture(show: Any, variant: str) -> Any:
    """Time a material ball with textures of Gaussians against one with a bitmap, in Mitsuba."""
    from eigengs_bench.experiments.texture import run

    return run(variant, show), ""


@bench.command()
@click.argument("image", type=EXISTING, metavar="IMAGE")
@click.option("--basis", default="natural", show_default=True, metavar="NAME|FILE")
@many_option("--condition", "conditions", CONDITIONS, "What photos are like, by default all")
@count_option("--steps", 200, least=2)
@backend_option
@click.option("--chart", type=ANY_PATH, help=".png, .svg or .pdf: PSNR over steps and seconds.")
@click.option("--strip", type=ANY_PATH, metavar="S.png", help="Film strips: S-cameras.png, ...")
@prints_figures
def inverse(
    show: Any, image: Path, conditions: Any, chart: Path, strip: Path, **settings: Any
) -> Any:
    """Recover a poster from photos by texels, Gaussians, coefficients of a basis, and the last two.

    The image hangs on a wall in Mitsuba, and every method takes the same number of steps of
    gradient descent. All conditions take about ten minutes.
    """
    names = conditions or CONDITIONS
    strips = {name: strip.with_stem(f"{strip.stem}-{name}") for name in names} if strip else {}
    check_outputs([chart, *strips.values()], [image])
    for path, known in ((chart, ".png .svg .pdf"), (strip, ".png .jpg")):
        if path and path.suffix.lower() not in known.split():
            raise ValueError(f"{path}: the name must end in {' or '.join(known.split())}")
    try:
        from eigengs_bench.experiments.inverse import figures_of, run, traces_of
    except ImportError as error:
        raise ValueError(f"bench inverse: {error}; pip install 'eigengs-dr[plugins]'") from error
    from eigengs_bench.report.charts import save_figure, save_strip
    from eigengs_bench.report.frames import as_text
    from eigengs_bench.report.sections.inverse import film_strip, results_chart, results_table
    from eigengs_dr.image.io import load_image

    results = run(image=load_image(image), conditions=names, progress=show, **settings)
    for name, path in strips.items():
        save_strip(path, film_strip(results[name]))
    if chart:
        save_figure(chart, results_chart(results))
    figures = {"results": figures_of(results), "traces": traces_of(results)}
    return figures, as_text(results_table(results))


@bench.command()
@click.argument("image", type=EXISTING, required=False)
@output_option
@count_option("--gaussians", 5000)
@count_option("--levels", 4)
@count_option("--iterations", 1000)
@options.seed_option
@backend_option
@quiet_option
def levels(image: Path | None, output: Path, quiet: bool, **settings: Any) -> None:
    """Chart PSNR over how many Gaussians of a set are drawn: levels.svg and levels.csv in FOLDER.

    Without IMAGE the command fits a photo of scikit-image, at 256x256 pixels.
    """
    output.mkdir(parents=True, exist_ok=True)
    check_outputs([output / "levels.svg", output / "levels.csv"], [image] if image else [])
    select(settings["backend"])
    from eigengs_bench.experiments.levels import SAMPLE, SIDE, run
    from eigengs_bench.report.sections.levels import summarize
    from eigengs_dr.image.io import load_image
    from eigengs_dr.image.resize import center_crop
    from eigengs_dr.image.samples import sample

    pixels = load_image(image) if image else center_crop(sample(SAMPLE), SIDE, SIDE)
    with progress_bar(quiet) as show:
        points = run(pixels, progress=show, **settings)
    points.to_csv(output / "levels.csv", index=False)
    save(summarize(points, image.name if image else SAMPLE), output, quiet)
