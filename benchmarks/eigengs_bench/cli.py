"""``eigengs-dr bench``: one command per question, answered by the module of the same name."""

from collections.abc import Callable
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from eigengs_bench.names import (
    KODAK_COUNTS,
    PAPER_SETS,
    PARTS,
    PRESETS,
    SAMPLES,
    SETS,
    SOLVE_STEPS,
    SUBJECTS_OF_DATA,
    SUBJECTS_OF_SAMPLES,
    TABLES,
    TEXTURE_PARTS,
)
from eigengs_bench.rows import FILE, Row, Task, code_state
from eigengs_bench.rows import record as record_rows
from eigengs_dr.backend.selection import name_of, select
from eigengs_dr.cli import options
from eigengs_dr.cli.console import FAILED, bar
from eigengs_dr.cli.options import number
from eigengs_dr.cli.outputs import check_outputs, describe_run

CHECKOUT = Path(__file__).parents[2]
"""The repository, whose docs/ has the rows behind the figures of the manual."""

FOLDER = Path("build/bench")
folder_option = options.output(
    f"For rows, models and charts; the same command goes on.  [default: {FOLDER}]", "FOLDER", False
)
data_argument = click.argument("data", type=options.folder, required=False, metavar="[DATA]")


def several(name: str, to: str, values: Any, text: str, default: Any = ()) -> Any:
    """Make an option that takes a word of several, or a number, and may be repeated."""
    kind = values if isinstance(values, click.ParamType) else click.Choice(list(values))
    text = f"{text}; may be repeated."
    once: Any = {"callback": lambda context, option, given: tuple(dict.fromkeys(given))}
    return click.option(name, to, multiple=True, type=kind, default=default, help=text, **once)


def sets_option(usual: tuple[str, ...]) -> Any:
    """Make the option ``--set``: by default the usual sets with DATA, or samples without."""
    text = f"Set of images, by default {' '.join(usual)} with DATA, and {SAMPLES} without"
    return several("--set", "names", SETS, text)


def question(bench: str, usual: tuple[str, ...] = ()) -> Any:
    """Turn a function with its options and its docstring into a command of the group.

    The command calls ``run(task, **settings)`` of the module of its name, prints the tables that
    ``summarize(rows)`` returns, and writes its charts to the folder.
    """

    def decorate(command: Callable[..., Any]) -> Any:
        @main.command(bench)
        @folder_option
        @click.option(
            "--record", is_flag=True, help="Add the rows to the manual, and fill in its pages."
        )
        @options.shared("backend", "quiet")
        @wraps(command)
        def wrapped(run: options.Run, output: Path | None, record: bool, **settings: Any) -> None:
            folder = output or FOLDER
            shared = {name: settings.pop(name) for name in Task._fields if name in settings}
            if "names" in settings:
                settings["names"] = settings["names"] or (usual if shared["data"] else (SAMPLES,))
                if not shared["data"] and set(settings["names"]) - {SAMPLES}:
                    raise ValueError("--set needs DATA, the folder of the set, for all but samples")
            if record and not (CHECKOUT / "docs").exists():
                raise click.UsageError("--record needs a checkout: pip install -e ./benchmarks")
            folder.mkdir(parents=True, exist_ok=True)
            check_outputs([folder / FILE], [])
            backend = name_of(select(run.backend))
            about = {**describe_run(run.context, backend), **code_state()}
            module = import_module(f"eigengs_bench.{bench}")
            with bar(run.quiet) as show:
                task = Task(folder, about, backend=backend, progress=show, **shared)
                rows = module.run(task, **settings)
            if not rows:
                raise ValueError("these options and DATA leave nothing to measure")
            _show(module.summarize(rows), rows, folder, run)
            if record:
                from eigengs_bench.pages import ROWS, write

                record_rows(CHECKOUT / ROWS, rows)
                write(CHECKOUT)

        return wrapped

    return decorate


def _show(section: Any, rows: list[Row], output: Path, run: options.Run) -> None:
    """Write the charts of a section as SVG into a folder; print its tables, and their sources."""
    from eigengs_bench.report import as_text, save_figure, sources_of

    for name, figure in section.charts.items():
        save_figure(output / f"{name}.svg", figure)
    charts = [f"chart: {output / name}.svg" for name in section.charts]
    text = "\n\n".join([*map(as_text, section.tables), "\n".join(sources_of(rows) + charts)])
    run.tell(*text.split("\n"))


@click.group("bench")
def main() -> None:
    """Measure speed and accuracy: one command per question.

    Each measurement is a line of FOLDER/rows.jsonl; a command that was interrupted resumes, and
    measures only what is missing. DATA has one folder per set (faces256, cats512, cars256,
    natural256), with images to train on in train/ and others in test/; kodak has no such parts.

    \b
    Examples:
      eigengs-dr bench kernels
      eigengs-dr bench tables data/ --set natural256 --images 3
    """


@question("tables", PAPER_SETS)
@data_argument
@sets_option(PAPER_SETS)
@several("--table", "tables", TABLES, "Table of the paper, by default all")
@number("--images", "Number of images from each set.", 20, 1)
@number("--iterations", "Steps of every fit.", 1000, 1)
def tables() -> None:
    """Measure every method on images that nothing was tuned on.

    \b
    main      gaussianimage, default, and eigengs with its own and with the universal basis
    ablation  eigengs in YCbCr or RGB, with and without the frequency-aware split

    FOLDER/models keeps trained bases and models: about a gigabyte per set.
    """


@question("pictures")
@data_argument
@number("--images", "Number of images from each set.", 8, 1)
@number("--iterations", "Steps of every fit.", 1000, 1)
def pictures() -> None:
    """Draw PSNR over steps of every method, as the paper does."""


@question("pareto", (SAMPLES,))
@data_argument
@sets_option((SAMPLES,))
@number("--images", "Number of images from each set.", 3, 1)
@number("--iterations", "Steps of the longest fits.", 1000, 1)
def pareto() -> None:
    """Measure speed against accuracy, one setting at a time.

    Fits differ from the default in one setting. An image takes about two minutes.
    """


@question("rate", (SAMPLES,))
@data_argument
@sets_option((SAMPLES,))
@number("--images", "Number of images from each set.", 3, 1)
@number("--iterations", "Steps of every fit.", 1000, 1)
def rate() -> None:
    """Compare packed fits with codecs and with published means.

    The codecs are JPEG, JPEG 2000, WebP, AVIF and JPEG XL. A photo of Kodak takes a minute.
    """


@question("number", ("natural256",))
@data_argument
@sets_option(("natural256",))
@several("--target", "targets", click.FloatRange(1, 100), "PSNR in YCbCr", (32.0, 36.0, 40.0))
@number("--images", "Number of images from each set.", 20, 1)
@number("--iterations", "Steps of every fit.", 1000, 1)
def number_of_gaussians() -> None:
    """Measure numbers and cost of the search of fit --target-psnr.

    A default fit with the same number of Gaussians is timed for comparison. An image of 256x256
    pixels takes ten seconds.
    """


@question("stability")
@click.option("--case", "cases", multiple=True, help="Hard case, by default all; may be repeated.")
@several("--preset", "presets", PRESETS, "Method, by default all", PRESETS)
@number("--iterations", "Largest number of steps of a fit.", 10_000, 0)
def stability() -> None:
    """Try every method on hard cases.

    They are odd images, odd starts, rates too high, seeds and units. All cases take three minutes.
    """


@question("kodak")
@click.argument("data", type=options.folder, metavar="DATA")
@several("--counts", "counts", click.IntRange(min=1), "Gaussians", KODAK_COUNTS)
@several("--steps", "steps", click.IntRange(min=0), "Steps of a fit", (1000,))
@number("--solve-steps", "Steps of the colour solve.", SOLVE_STEPS, 1)
@number("--images", "Number of photos, from the first.", 24, 1)
@click.option("--timed", is_flag=True, help="Record seconds: nothing else runs on the machine.")
def kodak() -> None:
    """Fit the Kodak photos with several numbers of Gaussians.

    Published figures stand beside the fits.

    \b
    Examples:
      eigengs-dr bench kodak data
      eigengs-dr bench kodak data --counts 5000 --counts 10000 --steps 5000
      eigengs-dr bench kodak data --images 4 --timed
      eigengs-dr bench kodak data --counts 28000 --steps 0 --solve-steps 30
    """


@question("relight")
@click.argument("data", type=options.folder, metavar="DATA")
@click.option("--set", "names", multiple=True, help="Folder in DATA, by default all.")
@number("--iterations", "Steps of every fit.", 300, 1)
@click.option(
    "--neural", is_flag=True, help="Also train a network; needs torch, and minutes a set."
)
def relight() -> None:
    """Compare planes of Gaussians with planes of pixels.

    DATA holds folders of photos with their lights, an .lp file. PSNRs are those of photos that were
    left out: those in Test beside a folder Dome, or every fifth one. A set of 50 photos takes
    ten minutes.
    """


@question("scaling")
@several("--part", "parts", PARTS, "What to vary", PARTS)
@number("--max-side", "Largest side of an image in pixels, up to 8192.", 4096, 1)
@number("--iterations", "Fewest steps of a fit.", 100, 1)
def scaling() -> None:
    """Measure the time of steps and starts, and memory, over sizes.

    \b
    pixels   images of 128x128 to 8192x8192 with 0.076 Gaussians per pixel
    splats   100 to 2,000,000 Gaussians on images of one size
    small    images per second of whole fits of 100 steps, one by one and by fit_many

    Every size runs in its own process. All up to 4096x4096 take about ten minutes and 5 GB.
    """


@question("kernels")
def kernels() -> None:
    """Time the renderer and its derivatives against the machine's peak."""


@question("texture")
@data_argument
@several("--part", "parts", TEXTURE_PARTS, "What to compare", TEXTURE_PARTS)
def texture() -> None:
    """Compare Gaussians with bitmaps in Mitsuba.

    \b
    posters  a bitmap and Gaussians that look alike at a slant; DATA has three of them in textures/
    lights   an envmap and Gaussians, over a ball
    ball     the time of a material ball, and what textures hold

    A poster takes a minute.
    """


@question("inverse")
@data_argument
@several("--scene", "subjects", SUBJECTS_OF_SAMPLES + SUBJECTS_OF_DATA, "Scene, by default all")
@number("--seeds", "Number of seeds whose figures are averaged.", 2, 1)
def inverse() -> None:
    """Recover textures from photos by texels and by Gaussians.

    \b
    poster    a flat picture, with 3 and with 16 cameras around it
    ball      the colour of a glossy coat, with 2, 3 and 16 cameras on all sides
    material  its colour and its roughness, with 6 and with 8 cameras
    text, tiled, room, crate, noisy  each with 8 cameras
    painting  a large picture from two cameras; DATA is the folder of its scene
    wall      colour, normals and roughness of the wall behind the painting

    Steps render 4 samples per pixel, others 1, 16 and 64. Everything takes more than an hour.
    """


@main.command()
@click.option("--check", is_flag=True, help="Write nothing; fail if a page is not up to date.")
@options.shared("quiet")
def pages(run: options.Run, check: bool) -> None:
    """Write what docs/rows.jsonl holds into README.md and docs/.

    Tables and figures go between marks, <!-- table: kodak.quality --> and <!-- end -->; charts lie
    in docs/images/measured/.
    """
    from eigengs_bench.pages import outdated, write

    paths = outdated(CHECKOUT) if check else write(CHECKOUT)
    verb = "not up to date, run eigengs-dr bench pages:" if check else "wrote"
    run.tell(*(f"{verb} {path.relative_to(CHECKOUT)}" for path in paths), f"{len(paths)} files")
    run.context.exit(FAILED if check and paths else 0)
