"""``eigengs-dr bench figures``: the pictures of the paper."""

from pathlib import Path

import click

from .backend.selection import select
from .cli.console import progress_bar, say
from .cli.options import (
    FOLDER,
    backend_option,
    describe_run,
    folder_option,
    quiet_option,
    seed_option,
)
from .cli.outputs import check_outputs

NAMES = ("iterations", "colors", "curves", "radii", "split", "cross")
"""Of the figures, without importing Dr.Jit, which their module does."""


@click.command()
@click.argument("data", required=False, type=FOLDER, metavar="[DATA]")
@folder_option("For the pictures")
@click.option(
    "--figure",
    "names",
    multiple=True,
    type=click.Choice(NAMES),
    help="What to draw; may be repeated. By default all.",
)
@click.option("--iterations", type=click.IntRange(min=1), default=1000, show_default=True)
@click.option(
    "--images",
    type=click.IntRange(min=1),
    default=8,
    show_default=True,
    help="Test images a set, for curves and radii.",
)
@seed_option
@backend_option
@quiet_option
@click.pass_context
def figures(
    context: click.Context,
    data: Path | None,
    output: Path,
    names: tuple[str, ...],
    iterations: int,
    images: int,
    seed: int,
    backend: str | None,
    quiet: bool,
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
    what needs more is left out. Models and measurements are kept in FOLDER, for another run to go
    on from; FOLDER/figures.json lists the pictures with captions and credits.

    \b
    Examples:
      eigengs-dr bench figures -o figures/
      eigengs-dr bench figures data/ -o figures/ --figure curves --images 20
    """
    select(backend)
    from .bench import figures as benchmark

    output.mkdir(parents=True, exist_ok=True)
    check_outputs([output / "figures.json"], [])
    machine = describe_run(context, backend)
    with progress_bar(quiet) as show:
        made = benchmark.run(
            output, data, machine, names, iterations, images, seed, backend, show, say
        )
    if not quiet:
        click.echo("\n".join(f"wrote {output / figure.path}" for figure in made))
