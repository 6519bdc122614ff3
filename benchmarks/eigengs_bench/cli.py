"""``eigengs-dr bench``: one command a question. What a command needs is imported inside it."""

from pathlib import Path
from typing import Any

import click

from eigengs_bench.cli_once import eigen, inverse, kernels, levels, texture
from eigengs_bench.harness.store import Task
from eigengs_bench.names import FIGURES, NATURAL, PAPER_SETS, PRESETS, SETS, TABLES
from eigengs_bench.options import (
    chosen_sets,
    count_option,
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


for command in (kernels, eigen, texture, inverse, levels):
    bench.add_command(command)


@bench.command()
@click.argument("data", type=FOLDER, metavar="DATA")
@many_option("--set", "names", SETS, "Which images, by default all but kodak")
@many_option("--table", "tables", TABLES, "Which tables, by default all")
@count_option("--images", 20, "Of each set.")
@measures_rows("tables.jsonl")
def tables(task: Task, names: Names, tables: Names) -> Any:
    """Measure every method on images that nothing was trained or tuned on.

    \b
    main      gaussianimage, default, and eigengs with its own and with the universal basis
    ablation  eigengs in YCbCr or RGB, with and without the frequency-aware split
    cross     eigengs with the basis of other images
    reach     how soon default has the PSNR that gaussianimage ends with

    Trained bases and models are kept in models/ of the folder: about a gigabyte a set.
    """
    from eigengs_bench.experiments.tables import run
    from eigengs_bench.report.sections.methods import tell

    return tell(run(task, tuple(dict.fromkeys(names)) or PAPER_SETS, tables or TABLES))


@bench.command()
@set_options(3)
@measures_rows("pareto.jsonl")
def pareto(task: Task, names: Names) -> Any:
    """Measure speed against accuracy: fits that differ from the default one in one setting.

    FOLDER gets a chart and a CSV file a set, and charts of the renderer and of storage. An image
    takes some two minutes.
    """
    from eigengs_bench.experiments.pareto import run
    from eigengs_bench.report.sections.pareto import tell

    return tell(run(task, chosen_sets(names, task.data)))


@bench.command()
@set_options(3)
@measures_rows("rate.jsonl")
def rate(task: Task, names: Names) -> Any:
    """Compare packed fits with JPEG and WebP at equal size.

    FOLDER gets a chart a set. An image of 256x256 pixels takes a minute.
    """
    from eigengs_bench.experiments.rate import run
    from eigengs_bench.report.sections.rate import tell

    return tell(run(task, chosen_sets(names, task.data)))


@bench.command()
@set_options(20, f"{NATURAL}, or samples without DATA")
@click.option(
    "--target",
    "targets",
    multiple=True,
    type=click.FloatRange(0, 100, min_open=True),
    default=(32.0, 36.0, 40.0),
    show_default=True,
    metavar="DB",
    help="PSNR in YCbCr to reach; may be repeated.",
)
@measures_rows("budget.jsonl")
def budget(task: Task, names: Names, targets: tuple[float, ...]) -> Any:
    """Measure how many Gaussians a PSNR takes: of fits of fixed numbers, and by the search.

    \b
    On every image, in this order:
      fits of fixed numbers, splats placed once, until two enclose each target
      the search of fit --target-psnr, and a default fit of the number it found
      fits of one number, splats placed once, and placed anew on the way

    FOLDER gets a chart and a CSV file a set. An image of 256x256 pixels takes a minute or two.
    """
    from eigengs_bench.experiments.budget import run
    from eigengs_bench.report.sections.budget import tell

    if any(target != target for target in targets):  # NaN is inside every click.FloatRange
        raise ValueError("--target is nan; it must be above 0 and at most 100")
    return tell(run(task, chosen_sets(names, task.data, NATURAL), tuple(dict.fromkeys(targets))))


@bench.command()
@click.option("--case", "cases", multiple=True, help="By default all; may be repeated.")
@many_option("--preset", "presets", PRESETS, "By default all")
@measures_rows("stability.jsonl", iterations=10_000, least=0)
def stability(task: Task, names: Names, cases: Names, presets: Names) -> Any:
    """Try every preset on hard cases: odd images, odd starts, rates too high.

    Draws stability-tiles.png where the case "smooth" is among them: what tiling looks like. All
    cases take some ten minutes; the case "large" takes gigabytes.
    """
    from eigengs_bench.experiments.stability import run, tiles_of
    from eigengs_bench.experiments.stability_cases import chosen_cases
    from eigengs_bench.report.charts import save_figure, tiles_chart
    from eigengs_bench.report.page import TILES
    from eigengs_bench.report.sections.stability import tell

    chosen = chosen_cases(cases, task.iterations)
    rows = run(task, chosen, tuple(dict.fromkeys(presets)) or PRESETS)
    for smooth in (case for case in chosen if case.name == "smooth"):
        save_figure(task.folder / TILES, tiles_chart(smooth.image(), tiles_of(task, smooth)))
    return tell(rows)


@bench.command()
@data_argument
@many_option("--figure", "figures", FIGURES, "What to draw, by default all")
@count_option("--images", 8, "Test images a set, for curves and radii.")
@measures_rows("curves.jsonl")
def figures(task: Task, names: Names, figures: Names) -> Any:
    """Draw the pictures of the paper, with our fits.

    \b
    iterations  fits at iterations 0, 10, 100 and the last, by every preset
    colors      fits in YCbCr and in RGB, and their errors
    curves      PSNR every 50 iterations
    radii       how large Gaussians are, with the frequency-aware split and without
    split       what Gaussians for low and for high frequencies render alone
    cross       images projected on bases of other images

    Without DATA photos of scikit-image are fitted, and figures that need more are left out.
    FOLDER/figures.json lists the pictures with captions and credits.
    """
    from eigengs_bench.experiments.figures import run
    from eigengs_bench.report.frames import Told, table

    lines = [(task.folder / figure.path, figure.caption) for figure in run(task, figures, say)]
    return Told([table("Pictures", ("file", "caption"), lines)])


@bench.command()
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@output_option
@quiet_option
def report(folder: Path, output: Path, quiet: bool) -> None:
    """Write a page of what the other commands of bench left in a folder.

    Writes index.html, one file that needs no other, and README.md with pictures/ beside it. Every
    section names the commands, days, machines, versions and commits behind its figures.
    """
    from eigengs_bench.report.page import write_page

    write_page(folder, output)
    if not quiet:
        click.echo(f"wrote {output / 'index.html'} and {output / 'README.md'}")
