"""The commands that keep their measurements as rows in a folder, and go on after a break."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from eigengs_bench.names import FIGURES, NATURAL, PAPER_SETS, PRESETS, SETS, TABLES
from eigengs_bench.options import (
    chosen_sets,
    count_option,
    data_argument,
    many_option,
    measuring,
    output_option,
    run_options,
    save,
    set_options,
)
from eigengs_dr.cli_shared import FOLDER
from eigengs_dr.console import say


@click.command()
@click.argument("data", type=FOLDER, metavar="DATA")
@output_option
@many_option("--set", "names", SETS, "Which images, by default all but kodak")
@many_option("--table", "tables", TABLES, "Which tables, by default all")
@count_option("--images", 20, "Of each set.")
@count_option("--iterations", 1000)
@run_options
def tables(
    context: click.Context,
    data: Path,
    output: Path,
    names: tuple[str, ...],
    tables: tuple[str, ...],
    backend: str | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Measure every method on images that nothing was trained or tuned on.

    DATA has a folder a set (faces256, cats512, cars256, natural256), with images in train/ for the
    bases and in test/ for the figures; kodak has no parts. The first images are used.

    \b
    Tables:
      main      gaussianimage, default, and eigengs with its own and with the universal basis
      ablation  eigengs in YCbCr or RGB, with and without the frequency-aware split
      cross     eigengs with the basis of other images
      reach     how soon default has the PSNR that gaussianimage ends with

    Every fit adds a line to tables.jsonl: the same command goes on after a break, and one with more
    sets or steps adds lines. Trained models are kept in models/: about a gigabyte a set.

    \b
    Examples:
      eigengs-dr bench tables data/ -o results/ --set natural256 --images 3
      eigengs-dr bench tables data/ -o results/ --images 4 --iterations 10000 --table main
    """
    from eigengs_bench.experiments.tables import FILE, run
    from eigengs_bench.report.sections.methods import tell

    with measuring(context, output, FILE, backend, quiet, data=data, **settings) as task:
        rows = run(task, tuple(dict.fromkeys(names)) or PAPER_SETS, tables or TABLES)
    save(tell(rows), output, quiet)


@click.command()
@set_options("samples, photos of scikit-image", 3)
def pareto(
    context: click.Context,
    data: Path | None,
    output: Path,
    names: tuple[str, ...],
    backend: str | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Measure speed against accuracy: fits that differ from the default one in one setting.

    DATA has a folder a set, with images to train models on in train/ and others in test/; the set
    "samples" needs none. FOLDER gets all measurements as pareto.jsonl, a chart and a CSV file a
    set, charts of the renderer and of storage, and the models. The same command again goes on
    where it was stopped. An image takes some two minutes.

    \b
    Examples:
      eigengs-dr bench pareto -o pareto/ --images 1
      eigengs-dr bench pareto data/ -o pareto/ --set samples --set faces256
    """
    from eigengs_bench.experiments.pareto import FILE, run
    from eigengs_bench.report.sections.pareto import tell

    wanted = chosen_sets(names, data)
    with measuring(context, output, FILE, backend, quiet, data=data, **settings) as task:
        rows = run(task, wanted)
    save(tell(rows), output, quiet)


@click.command()
@set_options("samples, photos of scikit-image", 3)
def rate(
    context: click.Context,
    data: Path | None,
    output: Path,
    names: tuple[str, ...],
    backend: str | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Compare packed fits with JPEG and WebP at equal size.

    DATA has a folder a set, with images in test/, or the images themselves; the set "samples" needs
    none. FOLDER gets all measurements as rate.jsonl and a chart a set. The same command again goes
    on where it was stopped. An image of 256x256 pixels takes a minute.

    \b
    Examples:
      eigengs-dr bench rate -o rate/ --images 1
      eigengs-dr bench rate data/ -o rate/ --set kodak --set natural256
    """
    from eigengs_bench.experiments.rate import FILE, run
    from eigengs_bench.report.sections.rate import tell

    wanted = chosen_sets(names, data)
    with measuring(context, output, FILE, backend, quiet, data=data, **settings) as task:
        rows = run(task, wanted)
    save(tell(rows), output, quiet)


@click.command()
@set_options(f"{NATURAL}, or samples without DATA", 20)
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
def budget(
    context: click.Context,
    data: Path | None,
    output: Path,
    names: tuple[str, ...],
    targets: tuple[float, ...],
    backend: str | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Measure how many Gaussians a PSNR takes: of fits of fixed numbers, and by the search.

    \b
    On every image, in this order:
      fits of fixed numbers, splats placed once, until two enclose each target
      the search of fit --target-psnr, and a default fit of the number it found
      fits of one number, splats placed once, and placed anew on the way

    DATA has a folder a set, with images in test/, or the images themselves; the set "samples" needs
    none. FOLDER gets all measurements as budget.jsonl, and a chart and a CSV file a set. The same
    command again goes on where it was stopped. An image of 256x256 pixels takes a minute or two,
    one of 768x512 some ten.

    \b
    Examples:
      eigengs-dr bench budget -o budget/ --images 1 --target 36
      eigengs-dr bench budget data/ -o budget/ --set natural256 --images 20
    """
    from eigengs_bench.experiments.budget import FILE, run
    from eigengs_bench.report.sections.budget import tell

    if any(target != target for target in targets):  # NaN is inside every click.FloatRange
        raise ValueError("--target is nan; it must be above 0 and at most 100")
    wanted = chosen_sets(names, data, NATURAL)
    with measuring(context, output, FILE, backend, quiet, data=data, **settings) as task:
        rows = run(task, wanted, tuple(dict.fromkeys(targets)))
    save(tell(rows), output, quiet)


@click.command()
@output_option
@click.option("--case", "cases", multiple=True, help="May be repeated. By default all.")
@many_option("--preset", "presets", PRESETS, "By default all")
@count_option("--iterations", None, "At most so many in every case.", least=0)
@run_options
def stability(
    context: click.Context,
    output: Path,
    cases: tuple[str, ...],
    presets: tuple[str, ...],
    iterations: int | None,
    seed: int,
    backend: str | None,
    quiet: bool,
) -> None:
    """Try every preset on hard cases: odd images, odd starts, rates too high.

    Writes stability.jsonl, and where the case "smooth" is among them stability-tiles.png: what
    tiling looks like. All cases take some ten minutes; the case "large" takes gigabytes. After
    Ctrl-C the same command goes on.

    \b
    Examples:
      eigengs-dr bench stability -o stability/
      eigengs-dr bench stability -o stability/ --case black --case smooth --preset default
      eigengs-dr bench stability -o quick/ --iterations 100
    """
    from eigengs_bench.experiments.stability import FILE, run, tiles_of
    from eigengs_bench.experiments.stability_cases import CASES
    from eigengs_bench.report.charts import save_figure, tiles_chart
    from eigengs_bench.report.page import TILES
    from eigengs_bench.report.sections.stability import defects, tell

    unknown = [name for name in cases if name not in CASES]
    if unknown:
        raise ValueError(f"case {unknown[0]!r} is unknown; use one of {', '.join(CASES)}")
    chosen = [CASES[name] for name in dict.fromkeys(cases or CASES)]
    if iterations is not None:
        chosen = [case._replace(iterations=min(case.iterations, iterations)) for case in chosen]
    with measuring(context, output, FILE, backend, quiet, data=None, seed=seed) as task:
        rows = run(task, chosen, tuple(dict.fromkeys(presets)) or PRESETS)
        for smooth in (case for case in chosen if case.name == "smooth"):
            figure = tiles_chart(smooth.image(), tiles_of(task, smooth))
            save_figure(output / TILES, figure)
    save(tell(rows), output, quiet)
    for line in () if quiet else defects(rows):
        click.echo(f"defect of default: {line}")


@click.command()
@data_argument
@output_option
@many_option("--figure", "names", FIGURES, "What to draw, by default all")
@count_option("--iterations", 1000)
@count_option("--images", 8, "Test images a set, for curves and radii.")
@run_options
def figures(
    context: click.Context,
    data: Path | None,
    output: Path,
    names: tuple[str, ...],
    backend: str | None,
    quiet: bool,
    **settings: Any,
) -> None:
    """Draw the pictures of the paper, with our fits.

    \b
    iterations  fits at iterations 0, 10, 100 and the last, by every preset
    colors      fits in YCbCr and in RGB, and their errors
    curves      PSNR every 50 iterations
    radii       how large Gaussians are, with the frequency-aware split and without
    split       what Gaussians for low and for high frequencies render alone
    cross       images projected on bases of other images

    DATA is a folder of image sets: cats512, faces256, cars256 and natural256, with images to train
    on in train/ and others in test/, and kodak. Without it photos of scikit-image are fitted, and
    figures that need more are left out. Models and measurements are kept in FOLDER;
    FOLDER/figures.json lists the pictures with captions and credits.

    \b
    Examples:
      eigengs-dr bench figures -o figures/
      eigengs-dr bench figures data/ -o figures/ --figure curves --images 20
    """
    from eigengs_bench.experiments.figure_charts import FILE
    from eigengs_bench.experiments.figures import run

    with measuring(context, output, FILE, backend, quiet, data=data, **settings) as task:
        made = run(task, names, say)
    if not quiet:
        click.echo("\n".join(f"wrote {output / figure.path}" for figure in made))
