"""Table of the prefilter beside mip maps."""

from collections.abc import Sequence

import pandas as pd

from eigengs_bench.harness.store import Row
from eigengs_bench.report.frames import Table, number


def psnr_table(rows: Sequence[Row]) -> Table:
    """Lay the rows of `eigengs_bench.experiments.prefilter.run` out."""
    frame = pd.DataFrame(rows)
    pixels = frame.pop("texels").astype(str) + " x " + frame.pop("slant").astype(str)
    frame = frame.map(number)
    frame.insert(0, "texels x slant", pixels)
    return Table("PSNR (RGB) / dB of one lookup a pixel, by its texels across and its slant", frame)
