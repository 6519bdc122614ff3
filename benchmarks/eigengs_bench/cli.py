"""``eigengs-dr bench``: one command a question. Each command imports what it needs."""

from pathlib import Path
from typing import Any

import click

from eigengs_bench.cli_single import eigen, inverse, kernels, levels, prefilter, radiance, texture
from eigengs_bench.harness.store import Task
from eigengs_bench.names import (
    FIGURES,
    KODAK_COUNTS,
    NATURAL,
    PAPER_SETS,
    PARTS,
    PRESETS,
    SETS,
    SOLVE_STEPS,
    TABLES,
)
from eigengs_bench.options import (
    count_option,
    counts_option,
    data_argument,
    many_option,
    measures_rows,
    output_option,
    set_options,
)
from eigengs_dr.cli.console import say
from eigengs_dr.cli.options import FOLDER, quiet_option

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
    """Compare packed fits with JPEG, JPEG 2000, WebP and AVIF at equal size.

    FOLDER gets a chart a set. An image of 256x256 pixels takes a minute.
    """
    from eigengs_bench.experiments.rate import run
    from eigengs_bench.report.sections.rate import summarize

    return summarize(run(task, names))


@bench.command()
@click.argument("folders", nargs=-1, required=True, type=FOLDER, metavar="FOLDER...")
@click.option(
    "--gaussians",
    "counts",
    multiple=True,
    type=click.IntRange(min=1),
    default=(2000, 8000, 32000),
    show_default=True,
    help="Of a set; may be repeated.",
)
@measures_rows("materials.jsonl", iterations=300)
def materials(task: Task, folders: tuple[Path, ...], counts: tuple[int, ...]) -> Any:
    """Compare maps on shared shapes with a set for each map, PNG, ASTC and BC7.

    A FOLDER holds the images of one material; their names are those of the maps: albedo.jpg,
    roughness.jpg, normal.jpg. ASTC needs astc-encoder-py, BC7 needs etcpak and texture2ddecoder;
    without them they are left out.
    """
    from eigengs_bench.experiments.materials import run
    from eigengs_bench.report.sections.materials import summarize

    return summarize(run(task, folders, tuple(dict.fromkeys(counts))))


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
@click.argument("data", type=FOLDER, metavar="DATA")
@counts_option("--counts", KODAK_COUNTS, "Gaussians; may be repeated.")
@counts_option("--steps", (1000,), "Steps of a fit; may be repeated.", least=0)
@count_option("--solve-steps", SOLVE_STEPS, "Steps of the colour solve.")
@count_option("--photos", 24, "The first ones.")
@click.option("--timed", is_flag=True, help="Nothing else runs: the seconds count.")
@measures_rows("kodak.jsonl", iterations=None)
def kodak(
    task: Task,
    photos: int,
    counts: tuple[int, ...],
    steps: tuple[int, ...],
    solve_steps: int,
    timed: bool,
) -> Any:
    """Fit the Kodak photos by numbers of Gaussians, beside what other methods published.

    \b
    Examples:
      eigengs-dr bench kodak data -o F
      eigengs-dr bench kodak data -o F --counts 5000 --counts 10000 --steps 5000
      eigengs-dr bench kodak data -o F --photos 4 --timed
      eigengs-dr bench kodak data -o F --counts 28000 --steps 0 --solve-steps 30

    DATA has the photos in kodak/. Ctrl-C keeps the fits that are done. FOLDER gets charts of PSNR
    over Gaussians, and over the seconds of timed fits.
    """
    from eigengs_bench.experiments.kodak import run
    from eigengs_bench.report.sections.kodak import summarize

    return summarize(run(task._replace(images=photos), counts, steps, solve_steps, timed))


@bench.command()
@many_option("--part", "parts", PARTS, "What to vary, by default all")
@count_option("--max-side", 4096, "Leave out larger images, in pixels; the largest have 8192.")
@measures_rows("scaling.jsonl", iterations=24)
def scaling(task: Task, parts: Names, max_side: int) -> Any:
    """Measure what size costs: time of a step, of the start, and memory.

    \b
    pixels   images of 128x128 to 8192x8192 with 0.076 Gaussians a pixel
    splats   100 to 2,000,000 Gaussians on images of one size
    threads  1, 2, 4, ... threads on images of three sizes
    small    images a second of whole fits of 100 steps

    Every size runs in a process of its own. --iterations is the least number of steps behind a
    mean. All sizes to 4096x4096 take some ten minutes and 5 GB, 8192x8192 needs four times as much.
    """
    from eigengs_bench.experiments.scaling import run
    from eigengs_bench.report.sections.scaling import summarize

    return summarize(run(task, parts or PARTS, max_side))


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


for command in (kernels, eigen, texture, prefilter, inverse, levels, radiance):
    bench.add_command(command)
