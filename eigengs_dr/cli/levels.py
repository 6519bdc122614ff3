"""``eigengs-dr bench levels``: what the first splats of a set are worth."""

from pathlib import Path

import click

from ..backend.selection import select
from .console import progress_bar
from .options import EXISTING, backend_option, folder_option, quiet_option, seed_option
from .outputs import check_outputs

SAMPLE, SIDE = "coffee", 256
"""A photo of scikit-image, and what its middle is shrunk to."""


@click.command()
@click.argument("image", type=EXISTING, required=False)
@folder_option("For the results")
@click.option("--gaussians", type=click.IntRange(min=1), default=5000, show_default=True)
@click.option("--levels", type=click.IntRange(min=1), default=4, show_default=True)
@click.option("--iterations", type=click.IntRange(min=1), default=1000, show_default=True)
@seed_option
@backend_option
@quiet_option
def levels(
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
    from ..bench import levels as benchmark
    from ..bench.charts import new_figure, save_figure
    from ..bench.table import as_text
    from ..image.io import load_image
    from ..image.resize import center_crop
    from ..image.samples import sample

    new_figure(1, 1)  # says now, not after the fits, that charts cannot be drawn
    drawing, file = output / "levels.svg", output / "levels.csv"
    output.mkdir(parents=True, exist_ok=True)
    check_outputs([drawing, file], [image] if image else [])
    select(backend)
    pixels = load_image(image) if image else center_crop(sample(SAMPLE), SIDE, SIDE)
    name = image.name if image else SAMPLE
    with progress_bar(quiet) as show:
        points = benchmark.measure(pixels, gaussians, levels, iterations, seed, backend, show)
    benchmark.save_points(file, points)
    save_figure(drawing, benchmark.chart(points, name))
    if not quiet:
        click.echo(as_text(benchmark.table(points, name)))
        click.echo(f"\nchart: {drawing}")
