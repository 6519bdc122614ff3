"""Commands of ``eigengs-dr bench`` that keep no rows: they print figures, or draw one chart."""

from pathlib import Path
from typing import Any

import click

from eigengs_bench.names import CONDITIONS
from eigengs_bench.options import count_option, many_option, output_option, prints_figures, save
from eigengs_dr.backend.selection import select
from eigengs_dr.cli import options
from eigengs_dr.cli.console import bar
from eigengs_dr.cli.options import ANY_PATH, EXISTING, FOLDER, backend_option, quiet_option
from eigengs_dr.cli.outputs import check_outputs


@click.command()
@backend_option
@prints_figures
def kernels(show: Any, backend: str | None) -> Any:
    """Time the renderer and its derivatives against plain Dr.Jit and the machine's peak."""
    from eigengs_bench.experiments.kernels import run

    return run(backend, show), ""


@click.command()
@click.argument("basis", metavar="NAME|FILE")
@click.argument("folder", type=FOLDER, metavar="FOLDER")
@count_option("--images", 20, "The first ones of the folder.")
@count_option("--iterations", 100, "With 0 the command measures the starts themselves.", 0)
@backend_option
@prints_figures
def eigen(show: Any, basis: str, folder: Path, images: int, iterations: int, backend: Any) -> Any:
    """Compare starts of a fit: by a model, and by the image alone."""
    from eigengs_bench.experiments.eigen import run
    from eigengs_dr.eigenbasis.eigengs import EigenGS
    from eigengs_dr.image.folder import image_files
    from eigengs_dr.image.io import load_image

    pictures = [load_image(file) for file in image_files(folder)[:images]]
    return run(EigenGS.load(basis, backend), pictures, iterations, show), ""


@click.command()
@click.option("--variant", default="llvm_ad_rgb", show_default=True, help="Of Mitsuba.")
@prints_figures
def texture(show: Any, variant: str) -> Any:
    """Time a material ball with textures of Gaussians against one with a bitmap, in Mitsuba."""
    from eigengs_bench.experiments.texture import run

    return run(variant, show), ""


@click.command()
@click.argument("images", nargs=-1, type=click.Path(exists=True), metavar="[IMAGE...]")
@prints_figures
def prefilter(show: Any, images: tuple[str, ...]) -> Any:
    """Compare the prefilter of the texture with mip maps, by means over round and long pixels.

    An IMAGE is a square whose side is a power of two; by default textures of scikit-image.
    """
    try:
        from eigengs_bench.experiments.prefilter import TEXTURES, run
    except ImportError as error:
        raise ValueError(f"bench prefilter: {error}; pip install 'eigengs-dr[plugins]'") from error
    from eigengs_bench.report.frames import as_text
    from eigengs_bench.report.sections.prefilter import psnr_table
    from eigengs_dr.image.io import load_image, sample

    squares = {path: load_image(path) for path in images}
    rows = run(squares or {name: sample(name) for name in TEXTURES}, show)
    return {"results": rows}, as_text(psnr_table(rows))


@click.command()
@count_option("--gaussians", 20_000)
@count_option("--iterations", 1000)
@click.option("--picture", type=ANY_PATH, metavar="P.jpg", help="The fits at two exposures.")
@prints_figures
def radiance(show: Any, picture: Path | None, **settings: Any) -> Any:
    """Fit a made-up environment map of 1,024x512 pixels: light above 1, and through 8 bits."""
    from eigengs_bench.experiments.radiance import comparison, run
    from eigengs_dr.image.io import save_image

    check_outputs([picture], [])
    figures, results = run(progress=show, **settings)
    if picture:
        save_image(picture, comparison(results))
    return figures, ""


@click.command()
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


@click.command()
@click.argument("image", type=EXISTING, required=False)
@output_option
@count_option("--gaussians", 5000)
@click.option("--levels", type=options.LEVEL_COUNTS, default=4, show_default=True)
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
    from eigengs_dr.image.io import load_image, sample
    from eigengs_dr.image.resize import center_crop

    pixels = load_image(image) if image else center_crop(sample(SAMPLE), SIDE, SIDE)
    with bar(quiet) as show:
        points = run(pixels, progress=show, **settings)
    points.to_csv(output / "levels.csv", index=False)
    save(summarize(points, image.name if image else SAMPLE), output, quiet)
