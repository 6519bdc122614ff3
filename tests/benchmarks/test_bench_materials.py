"""Shared shapes against separate sets, on a tiny material."""

import numpy as np
import pytest

from _helpers.benchmarks import lines_of, run
from _helpers.materials import images
from eigengs_bench.experiments.materials import SEPARATE, SHARED
from eigengs_bench.harness.store import read
from eigengs_bench.report.sections.materials import bits_at, ratio, summarize
from eigengs_dr.image.io import save_image


def test_a_tiny_material(tmp_path):
    for name in ("albedo", "roughness"):
        (tmp_path / "wood").mkdir(exist_ok=True)
        save_image(tmp_path / "wood" / f"{name}.png", images(16)[name])
    settings = ("--gaussians", 4, "--iterations", 2, "--quiet")
    result = run("bench", "materials", tmp_path / "wood", "-o", tmp_path / "out", *settings)
    assert result.exit_code == 0, result.output
    rows = read(tmp_path / "out" / "materials.jsonl")
    kinds = [row["job"]["method"] for row in rows]
    assert kinds.count(SHARED) == 1 and kinds.count(SEPARATE) == 2 and "PNG" in kinds
    first = next(row for row in rows if row["job"]["method"] == SHARED)
    assert set(first["psnr"]) == {"albedo", "roughness"} and first["bytes"] < first["npz_bytes"]
    section = summarize(rows)
    assert any("4 shared shapes" in line for line in lines_of(section.tables[0]))


def row(method, size, psnr, **job):
    """A row of a material of two maps."""
    named = {"material": "wood", "maps": ["a", "b"], "values": 800, "method": method, **job}
    both = {"bytes": size, "psnr": psnr, "npz_bytes": size, "npz_psnr": psnr}
    return {"job": named, "run": {}, **both}


def test_sizes_at_equal_psnr():
    rows = [row(SEPARATE, 100, {m: 30.0}, map=m, gaussians=1) for m in "ab"]
    rows += [row(SEPARATE, 400, {m: 40.0}, map=m, gaussians=4) for m in "ab"]
    shared = row(SHARED, 150, {"a": 35.0, "b": 30.0}, gaussians=2)
    assert ratio(rows, shared, "bytes") == pytest.approx(150 / (200 + 100))
    above = row(SHARED, 150, {"a": 45.0, "b": 30.0}, gaussians=2)
    assert np.isnan(ratio(rows, above, "bytes"))
    ends = [row(SHARED, 100, {"a": 30.0, "b": 40.0}), row(SHARED, 400, {"a": 45.0, "b": 45.0})]
    assert bits_at(ends, "bytes", 40.0) == pytest.approx(2.0)
    assert np.isnan(bits_at(ends, "bytes", 46.0))
