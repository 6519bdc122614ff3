"""Time, memory and PSNR of a fit by blocks and of the whole, on a square mosaic of photos.

    python benchmarks/blocks.py 4096            # by blocks of 1,024 pixels
    python benchmarks/blocks.py 4096 --whole

The mosaic lies in a file of NumPy and is read by windows, unless the whole is fitted.
"""

import tempfile
import time
from pathlib import Path

import click
import numpy as np

import eigengs_dr as eg
from eigengs_bench.experiments.scaling import CELL, mosaic
from eigengs_bench.harness.alone import peak_gib

PIXELS_PER_GAUSSIAN = 20


@click.command(help=__doc__)
@click.argument("side", type=click.IntRange(CELL))
@click.option("--block", default=1024, show_default=True, help="Side of a block in pixels.")
@click.option("--iterations", default=100, show_default=True, help="Steps.")
@click.option("--whole", is_flag=True, help="Fit the whole at once.")
def main(side: int, block: int, iterations: int, whole: bool) -> None:
    """Fit the mosaic, and print one line."""
    count = side * side // PIXELS_PER_GAUSSIAN
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mosaic.npy"
        write_mosaic(path, side)
        started = time.perf_counter()
        if whole:
            last = eg.fit(np.load(path), count, iterations).trace[-1]
            ycbcr, rgb = last["psnr_ycbcr"], last["psnr_rgb"]
        else:
            large = eg.fit_large(path, gaussians=count, iterations=iterations, block=block)
            ycbcr, rgb = large.psnr_ycbcr, large.psnr_rgb
        seconds = time.perf_counter() - started
    click.echo(
        f"{side}x{side}, {count:,} Gaussians, {'whole' if whole else f'blocks of {block}'}: "
        f"{seconds:.1f} s, {peak_gib():.2f} GiB, psnr_ycbcr {ycbcr:.2f}, psnr_rgb {rgb:.2f} dB"
    )


def write_mosaic(path: Path, side: int) -> None:
    """Write a mosaic with 8 bits a channel, one row of cells at a time."""
    image = np.lib.format.open_memmap(path, "w+", np.uint8, (side, side, 3))
    for k, top in enumerate(range(0, side, CELL)):
        rows = np.roll(mosaic(side, CELL), k * CELL, axis=1)[: side - top]
        image[top : top + CELL] = np.rint(255 * rows)


if __name__ == "__main__":
    main()
