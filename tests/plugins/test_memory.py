"""A texture says what it holds: what Dr.Jit has more of while the texture lives."""

import gc
import re

import drjit as dr
import numpy as np
import pytest

from _helpers.texture import at, gaussians, in_front, mi, texture
from eigengs_dr.plugins import resident_bytes

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

ROW = re.compile(
    r"^ *(\d+) +(LLVM|CUDA) +([a-z]+)(\d+)? .*? +(\d+) +[\d.]+ [KMGi]*B ", re.MULTILINE
)
"""A variable of `drjit.whos` that is in memory: number, backend, type, bits, and size."""


def stored(capfd):
    """Return the bytes of each variable that Dr.Jit holds in memory, by its number."""
    gc.collect()
    capfd.readouterr()
    dr.whos()
    rows = ROW.findall(capfd.readouterr().out)
    return {
        number: int(size) * (1 if kind == "bool" else int(bits) // 8)
        for number, _, kind, bits, size in rows
    }


def look_up(tex):
    dr.eval(tex.eval_3(in_front(at([0.2, 0.6], [0.3, 0.7]))))


def in_a_file(prefilter, folder):
    path = folder / "set.npz"
    gaussians().save(path)
    return {"type": "gaussian_texture", "filename": str(path), "prefilter": prefilter}


@pytest.mark.parametrize("prefilter", [0.0, 0.01])
@pytest.mark.parametrize("filed", [False, True])
def test_resident_bytes_are_those_that_dr_jit_holds(filed, prefilter, capfd, tmp_path):
    scene, g = in_a_file(prefilter, tmp_path), gaussians()
    look_up(mi.load_dict(scene))  # what the package keeps for every texture
    before = stored(capfd)
    tex = mi.load_dict(scene) if filed else texture(g, prefilter=prefilter)
    look_up(tex)
    found = sum(size for number, size in stored(capfd).items() if number not in before)
    # The transform of uv is a matrix of literals that were made opaque: a few numbers of 4 bytes.
    assert found - 200 <= resident_bytes(tex) <= found + 200


def test_sampled_light_counts(capfd):
    tex = texture(gaussians())
    tex.eval_1_grad(at(0.2, 0.3))
    before, held = stored(capfd), resident_bytes(tex)
    dr.eval(tex.sample_position(mi.Point2f(0.3, 0.4)))
    found = sum(size for number, size in stored(capfd).items() if number not in before)
    assert abs(resident_bytes(tex) - held - found) <= 300


def test_derivatives_count():
    tex = texture(gaussians())
    parameters = mi.traverse(tex)
    held, number = resident_bytes(tex), len(np.ravel(parameters["color"]))
    dr.enable_grad(parameters["color"])
    parameters.update()
    dr.backward(dr.sum(tex.eval_1(at(0.3, 0.6))))
    dr.eval(dr.grad(parameters["color"]))
    assert resident_bytes(tex) >= held + 4 * number


@pytest.mark.texture_units
@pytest.mark.parametrize(("channels", "padded"), [(1, 1), (3, 4)])
def test_of_a_bitmap_they_are_those_of_its_texels(channels, padded, capfd):
    """As Dr.Jit stores them from the first rendering on."""
    scene = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((64, 32, channels), np.uint8))}
    bitmap = mi.load_dict(scene | {"raw": True})
    dr.eval(bitmap.eval_1(at(0.2, 0.3)) if channels == 1 else bitmap.eval_3(at(0.2, 0.3)))
    assert resident_bytes(bitmap) == 64 * 32 * padded
    assert 64 * 32 * padded in stored(capfd).values()


def test_the_string_shows_them():
    tex = texture(gaussians())
    assert f"resident_bytes = {resident_bytes(tex)}," in str(tex)
