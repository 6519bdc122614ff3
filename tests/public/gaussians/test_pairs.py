"""Every public function takes what every other returns.

Dr.Jit ends the process where it meets an array in a state that an operation cannot take, so the
pairs run in a process of their own, which names each pair before it tries it.
"""

import pytest

from _helpers.process import python_path, run_python

PAIRS = """
import pickle, tempfile
from pathlib import Path

import drjit as dr
import numpy as np

import eigengs_dr as eg
from _helpers.families import family, small_model
from _helpers.sets import random_scene

dr.set_thread_count(1)  # others would spin
SIDE = 32
image = family(1, side=SIDE)[0]
folder = Path(tempfile.mkdtemp())
made = random_scene(size=(SIDE, SIDE)).on("llvm", space="rgb")
other = random_scene(seed=1, size=(SIDE, SIDE)).on("llvm", space="rgb")
made.save(folder / "a.npz")
model = small_model("llvm")


def scattered():
    color = dr.zeros(type(made.color), (3, len(made)))
    for row in color:  # a scatter that is still to be done, as a user's own program may leave one
        dr.scatter(row, 0.5, dr.arange(dr.uint32_array_t(row), len(made)))
    return eg.Gaussians(made.mean, made.factor, color, made.background, SIDE, SIDE, "rgb")


def material():
    maps = {"albedo": image, "roughness": image[..., :1]}
    return eg.fit(maps, 20, iterations=1, backend="llvm").gaussians["albedo"]


def brighter():
    color = eg.to_tensors(made)["color"]
    return eg.from_tensors({"color": dr.concat([color[:9], 2 * color[9:]])}, like=made)


producers = {
    "from_arrays": lambda: made,
    "fit": lambda: eg.fit(image, 20, iterations=2, space="rgb", backend="llvm").gaussians,
    "load": lambda: eg.Gaussians.load(folder / "a.npz", "llvm"),
    "concatenate": lambda: eg.concatenate([made, other]),
    "slice": lambda: made[:9],
    "mask": lambda: made[np.arange(len(made)) % 2 == 0],
    "map": material,
    "scaled": lambda: eg.concatenate([made, other]).scaled(16, 16).scaled(SIDE, SIDE),
    "bounded": made.bounded,
    "from_tensors": brighter,
    "encode": lambda: model.encode(image),
    "scatter": scattered,
}


def derivatives(g):
    g = dr.detach(g)
    dr.enable_grad(g)
    dr.backward(dr.sum(eg.render(g).array))
    for name in ("mean", "factor", "color", "background"):
        assert np.isfinite(dr.grad(getattr(g, name)).numpy()).all()


consumers = {
    "to_tensors": lambda g: {name: t.numpy() for name, t in eg.to_tensors(g).items()},
    "from_tensors": lambda g: eg.from_tensors(eg.to_tensors(g), like=g).to_arrays(),
    "render": lambda g: eg.render(g).numpy(),
    "tile_lists": lambda g: eg.render(g, lists=eg.tile_lists(g)).numpy(),
    "gradients": derivatives,
    "to_arrays": lambda g: g.to_arrays(),
    "save": lambda g: g.save(folder / "b.npz"),
    "concatenate": lambda g: eg.concatenate([g, g]).to_arrays(),
    "slice": lambda g: g[:3].to_arrays(),
    "scaled": lambda g: g.scaled(8, 8).to_arrays(),
    "bounded": lambda g: g.bounded().to_arrays(),
    "pickle": pickle.dumps,
    "picture_of": eg.picture_of,
    "fit": lambda g: eg.fit(image, start=g, space=g.space, iterations=1),
}
# Not with each of them, as packing takes half a second.
eg.pack(scattered(), folder / "b.egs", max_psnr_drop=60)
for producer, make in producers.items():
    for consumer, use in consumers.items():
        print(producer, "->", consumer, flush=True)
        use(make())
print("all pairs", flush=True)
"""


@pytest.mark.slow
def test_every_function_takes_what_every_other_returns():
    process = run_python(PAIRS, PYTHONPATH=python_path())
    last = process.stdout.splitlines()[-1:]
    assert last == ["all pairs"], f"{last}: {process.stderr[-500:]}"
