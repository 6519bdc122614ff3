"""After a change only what moved is made anew, with the bits of a texture that is made from it."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import SIZE
from _helpers.texture import backend, gaussians, mi, texel_centres, texture
from eigengs_dr.plugins import texture_of
from eigengs_dr.raster.lookup import cells

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

COLORS, SHAPES = ("color", "background"), ("mean", "factor")
ALL = (*SHAPES, *COLORS)
WALKS = {
    "colours": [("color",), ("background",), ("mean",), ("factor",), COLORS, ALL, ALL],
    "shapes": [("mean",), ("color",)],
    "all": [ALL, ("factor",), ALL, ("background",)],
}
"""Colours, shapes, or both: each of them first, and each of them after each of them."""

PREFILTERS = [0.0, 0.02]


def views():
    """Points that are seen from near, and from so far that their footprints are wide."""
    found = []
    for distance in (0.5, 20.0):
        si = texel_centres()
        si.t, si.wi = distance, mi.Vector3f(0.3, 0, 0.95)
        si.sh_frame = mi.Frame3f([0, 0, 1])
        si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
        found.append(si)
    return found


def seen(tex):
    return np.concatenate([np.array(tex.eval_3(si)) for si in views()])


def moved(parameters, names, seed):
    """Change parameters by a few percent; return the set that has them."""
    random = np.random.default_rng(seed)
    for name in names:
        value = np.array(parameters[name])
        factor = 1 + 0.1 * random.uniform(-1, 1, value.shape)
        parameters[name] = mi.TensorXf(np.float32(value * factor))
    parameters.update()
    arrays = [np.array(parameters[name]) for name in (*SHAPES, "color")]
    last = np.array(parameters["background"]).ravel()
    return eg.Gaussians.from_arrays(*arrays, last, size=SIZE, space="linear", backend=backend())


@pytest.mark.parametrize("prefilter", PREFILTERS)
@pytest.mark.parametrize("walk", WALKS)
def test_lookups_are_those_of_a_new_texture(walk, prefilter):
    tex = texture(gaussians("linear"), prefilter=prefilter)
    parameters, before = mi.traverse(tex), seen(tex)
    for seed, names in enumerate(WALKS[walk]):
        fresh = texture(moved(parameters, names, seed), prefilter=prefilter)
        found = seen(tex)
        np.testing.assert_array_equal(found, seen(fresh))
        assert np.abs(found - before).max() > 1e-4


@pytest.mark.parametrize("prefilter", PREFILTERS)
@pytest.mark.parametrize("of_file", [False, True])
def test_colours_alone_keep_the_lists(prefilter, of_file, tmp_path):
    gaussians("linear").save(tmp_path / "x.npz")
    file = {"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")}
    given = file if of_file else texture_of(gaussians("linear"))
    tex = mi.load_dict({**given, "prefilter": prefilter})
    parameters, start = mi.traverse(tex), tex.table.lists
    lists = []
    for seed in range(3):
        moved(parameters, COLORS, seed)
        lists.append(tex.table.lists)
        assert lists[-1].cells.runs is start.cells.runs
        assert (lists[-1].sizes and lists[-1].sizes.row) is (start.sizes and start.sizes.row)
        assert lists[-1].finest is lists[0].finest
    assert (lists[0].finest is not None) == (prefilter > 0)
    moved(parameters, ("mean",), 3)
    assert tex.table.lists.cells.runs is not start.cells.runs


@pytest.mark.parametrize("prefilter", PREFILTERS)
def test_a_file_of_more_gaussians_than_16_bits_number(prefilter, tmp_path, monkeypatch):
    """The first change of colours finds their rows in each band."""
    size, random = (64, 256), np.random.default_rng(0)
    arrays = random.uniform(0, 1, (60, 2)) * size, np.tile([0.4, 0.1, 0.5], (60, 1))
    color, last = random.uniform(-0.1, 0.1, (60, 3)), [0.5] * 3

    def set_of(scale):
        options = {"size": size, "space": "linear", "backend": backend()}
        return eg.Gaussians.from_arrays(*arrays, scale * color, last, **options)

    expected = [seen(texture(set_of(scale), prefilter=prefilter)) for scale in (1, 0.5)]
    monkeypatch.setattr(cells, "MOST", 50)
    set_of(1).save(tmp_path / "x.npz")
    path = str(tmp_path / "x.npz")
    tex = mi.load_dict({"type": "gaussian_texture", "filename": path, "prefilter": prefilter})
    assert dr.width(tex.table.lists.cells.first) > 1
    np.testing.assert_allclose(seen(tex), expected[0], atol=1e-3)  # of words of 16 bits
    parameters = mi.traverse(tex)
    parameters["color"] = 0.5 * parameters["color"]
    parameters.update()
    np.testing.assert_allclose(seen(tex), expected[1], atol=2e-5)


def derivatives(tex, names, mode):
    """The gradient of squared lookups, or the change of lookups along a direction."""
    parameters, along = mi.traverse(tex), mi.Float(0)
    if mode == "forward":
        dr.enable_grad(along)
        for name in names:
            parameters[name] = mi.TensorXf(parameters[name]) * (1 + along)
    else:
        for name in names:
            dr.enable_grad(parameters[name])
    parameters.update()
    values = [tex.eval_3(si) for si in views()]
    if mode == "forward":
        dr.forward(along)
        return [np.array(dr.grad(value)) for value in values]
    dr.backward(sum(dr.sum(dr.squared_norm(value)) for value in values))
    return [np.array(dr.grad(parameters[name])) for name in names]


@pytest.mark.parametrize("names", [("color",), COLORS, ALL])
@pytest.mark.parametrize(
    ("mode", "prefilter"), [("forward", 0.0), ("backward", 0.0), ("backward", 0.02)]
)
def test_derivatives_are_those_of_a_new_texture(names, mode, prefilter):
    """Also where nothing had derivatives when lists were made, as when colours have them first."""
    tex = texture(gaussians("linear"), prefilter=prefilter)
    fresh = texture(moved(mi.traverse(tex), ("color",), 0), prefilter=prefilter)
    for found, expected in zip(
        derivatives(tex, names, mode), derivatives(fresh, names, mode), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
        assert np.abs(found).max() > 1e-4
