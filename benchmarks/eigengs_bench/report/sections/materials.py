"""What materials take, from the rows that `materials` measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from eigengs_bench.experiments.materials import SEPARATE, SHARED
from eigengs_bench.harness.store import Row, code_name
from eigengs_bench.report import frames as fr

SAME = 0.05  # dB that do not count as a difference

LEVEL = 41.0  # dB, mean over the maps, at which GTC publishes its bits


def summarize(rows: Sequence[Row]) -> fr.Section:
    """Lay out bits and PSNR of each method, and the bytes of shared shapes over separate sets."""
    names = list(dict.fromkeys(row["job"]["material"] for row in rows))
    parts = {name: [r for r in rows if r["job"]["material"] == name] for name in names}
    codes = [code_name(row["run"]) for row in rows]
    tables = [_table(name, part, codes) for name, part in parts.items()]
    lines = [
        (name, *(fr.number(bits_at(part, kind), 3) for kind in ("bytes", "npz_bytes")))
        for name, part in parts.items()
    ]
    caption = (
        f"bits a pixel and channel of shared shapes at {LEVEL:g} dB, psnr_rgb, mean over the maps"
    )
    tables.append(fr.table(caption, ("material", "packed", "plain"), lines, codes))
    return fr.Section(tables)


def _table(name: str, rows: Sequence[Row], codes: list[str]) -> fr.Table:
    lines = []
    for row in (r for r in rows if r["job"]["method"] != SEPARATE):
        job = row["job"]
        label = f"{job['gaussians']:,} {SHARED}" if "gaussians" in job else job["method"]
        shared = job["method"] == SHARED
        ratios = [ratio(rows, row, k) if shared else math.nan for k in ("bytes", "npz_bytes")]
        lines.append(
            (
                label,
                f"{row['bytes']:,}",
                fr.number(8 * row["bytes"] / job["values"], 3),
                *(fr.number(row["psnr"][m]) for m in job["maps"]),
                fr.number(float(np.mean(list(row["psnr"].values())))),
                *(fr.number(r, 2) for r in ratios),
            )
        )
    columns = ("method", "bytes", "bits", *rows[0]["job"]["maps"], "mean")
    caption = (
        f"{name}: bytes, bits a pixel and channel, psnr_rgb of each map in dB; last: bytes of "
        "shared shapes over those of separate sets at the PSNR of each map, packed and plain"
    )
    return fr.table(caption, (*columns, "over packed", "over plain"), lines, codes)


def ratio(rows: Sequence[Row], shared: Row, kind: str) -> float:
    """Return the bytes of shared shapes over those of separate sets of equal PSNR.

    The bytes of a separate set are interpolated over its PSNR, and extrapolated below its smallest
    by one more step; NaN if a map is better than its largest set.
    """
    figure = {"bytes": "psnr", "npz_bytes": "npz_psnr"}[kind]
    total = 0.0
    for name in shared["job"]["maps"]:
        points = sorted(
            (row[figure][name], row[kind])
            for row in rows
            if row["job"]["method"] == SEPARATE and row["job"]["map"] == name
        )
        total += _size_at(points, shared[figure][name])
    return float(shared[kind] / total) if total else math.nan


def bits_at(rows: Sequence[Row], kind: str, level: float = LEVEL) -> float:
    """Return the bits a value of shared shapes at a mean PSNR; NaN where it is not reached."""
    figure = {"bytes": "psnr", "npz_bytes": "npz_psnr"}[kind]
    points = sorted(
        (float(np.mean(list(row[figure].values()))), 8 * row[kind] / row["job"]["values"])
        for row in rows
        if row["job"]["method"] == SHARED
    )
    return _size_at(points, level)


def _size_at(points: list[Any], level: float) -> float:
    """Interpolate the logarithm of sizes over PSNRs in rising order; see `ratio`."""
    if len(points) < 2 or level > points[-1][0] + SAME:
        return math.nan
    above = next((k for k, (psnr, _) in enumerate(points) if k and psnr >= level), len(points) - 1)
    (low, few), (high, many) = points[above - 1 : above + 1]
    share = min(max((level - low) / (high - low), -1), 1) if high > low else 0.0
    return float(few * (many / few) ** share)
