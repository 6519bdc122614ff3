"""``eigengs-dr bench``: measurements of speed and accuracy."""

from pathlib import Path

import click

from .backend import select
from .cli_shared import EXISTING, backend_option, described, quiet_option, report_option
from .console import progress_bar
from .outputs import check_outputs
from .report import write_report


@click.group()
def bench() -> None:
    """Measure speed and accuracy.

    \b
    Example:
      eigengs-dr bench kernels --report kernels.json
    """


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
    from functools import partial

    import eigengs_dr as eg

    from .bench import kernels as benchmark

    picture = eg.load_image(image) if image else None
    with progress_bar(quiet) as show:
        figures = benchmark.run(picture, backend=backend, progress=partial(show, "kernels"))
    if report:
        write_report(report, {**described(context, backend), **figures})
    if not quiet:
        click.echo("\n".join(f"{key:24} {value:.4g}" for key, value in figures.items()))
