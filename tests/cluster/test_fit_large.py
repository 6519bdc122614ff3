"""Blocks of a large image on a cluster."""

import numpy as np
import tifffile

import eigengs_dr as eg


def test_blocks_have_the_bits_of_one_process(client, tmp_path):
    picture = (255 * eg.sample("coffee")[:96, :160]).round().astype(np.uint8)
    tifffile.imwrite(tmp_path / "x.tif", picture, tile=(16, 16))
    options = {"iterations": 20, "block": 64, "backend": "llvm"}
    alone = eg.fit_large(tmp_path / "x.tif", **options).gaussians.to_arrays()
    shared = eg.fit_large(tmp_path / "x.tif", tmp_path / "x.npz", client=client, **options)
    for name, value in shared.gaussians.to_arrays().items():
        np.testing.assert_array_equal(value, alone[name])
    assert not (tmp_path / "x.npz.checkpoint").exists()
