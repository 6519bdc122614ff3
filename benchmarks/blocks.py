"""Time, memory and PSNR of a fit by blocks and of the whole, on a square mosaic of photos.

    python benchmarks/blocks.py 4096            # by blocks of 1,024 pixels
    python benchmarks/blocks.py 4096 --whole

The mosaic lies in a file of NumPy and is read by windows, unless the whole is fitted. PSNR in YCbCr
is that within 16 pixels of the borders of blocks, that beyond, and that of all pixels. The picture
is drawn from the Gaussians after time and memory are taken.
"""

import tempfile
import time
from pathlib import Path

import click
import numpy as np

import eigengs_dr as eg
from eigengs_bench.experiments.scaling import CELL, mosaic
from eigengs_bench.harness.alone import peak_gib
from eigengs_dr.blocks.draw import draw_region
from eigengs_dr.blocks.grid import divide
from eigengs_dr.image.color import rgb_to_ycbcr, to_coded
from eigengs_dr.image.metrics import psnr_from_mse

PIXELS_PER_GAUSSIAN = 20

NEAR = 16
"""Pixels on each side of a border."""


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
            found = eg.fit(np.load(path), count, iterations).gaussians
        else:
            found = eg.fit_large(
                path, gaussians=count, iterations=iterations, block=block
            ).gaussians
        seconds, memory = time.perf_counter() - started, peak_gib()
        near, far, everywhere = psnr_by_borders(found, np.load(path, mmap_mode="r"), block)
    click.echo(
        f"{side}x{side}, {count:,} Gaussians, {'whole' if whole else f'blocks of {block}'}, "
        f"{iterations} steps: {seconds:.1f} s, {memory:.2f} GiB, psnr_ycbcr "
        f"near borders {near:.2f}, beyond {far:.2f}, all {everywhere:.2f} dB"
    )


def psnr_by_borders(found: eg.Gaussians, image: np.ndarray, block: int) -> list[float]:
    """Return the PSNR in YCbCr near the borders of blocks, elsewhere, and of all pixels."""
    height, width = image.shape[:2]
    near_rows, near_columns = near_borders(height, block), near_borders(width, block)
    sums, counts, top = np.zeros(2), np.zeros(2), 0
    for band in draw_region(found.data(), (0, 0, width, height), (width, height), kind=np.float32):
        rows = slice(top, top + len(band))
        shown = rgb_to_ycbcr(to_coded(band)) - rgb_to_ycbcr(image[rows] / np.float32(255))
        errors = np.square(shown).mean(axis=2)
        near = near_rows[rows, None] | near_columns
        sums += errors[near].sum(dtype=float), errors[~near].sum(dtype=float)
        counts += near.sum(), (~near).sum()
        top = rows.stop
    return [psnr_from_mse(mse) for mse in (*(sums / counts), sums.sum() / counts.sum())]


def near_borders(length: int, block: int) -> np.ndarray:
    """Return which pixels of an axis lie near a border of blocks; an edge of the image is none."""
    borders = np.array([part.rows.start for part in divide(1, length, block, 0)[1:]])
    return (np.abs(np.arange(length)[:, None] + 0.5 - borders) < NEAR).any(axis=1)


def write_mosaic(path: Path, side: int) -> None:
    """Write a mosaic with 8 bits a channel, one row of cells at a time."""
    image = np.lib.format.open_memmap(path, "w+", np.uint8, (side, side, 3))
    for k, top in enumerate(range(0, side, CELL)):
        rows = np.roll(mosaic(side, CELL), k * CELL, axis=1)[: side - top]
        image[top : top + CELL] = np.rint(255 * rows)


if __name__ == "__main__":
    main()
