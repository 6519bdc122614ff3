"""Threads that fit, render, recover textures and drop results and scenes, for SOAK_SECONDS."""

import os

import pytest

from _helpers.process import python_path, run_python

SECONDS = float(os.environ.get("SOAK_SECONDS", "30"))

MIXED = """
import os, sys, threading, time
import numpy as np
import eigengs_dr as eg
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
from eigengs_dr.plugins import environment_of, photo_loss, texture_of

end = time.monotonic() + {seconds}
counts = dict.fromkeys(("fit", "render", "scene", "recover", "drop"), 0)
image = np.random.default_rng(0).random((24, 32, 3)).astype(np.float32)
first = eg.fit(image, 60, iterations=3, space="linear", progress=False)
expected = first.image.tobytes()
results, failures, loaded = [first], [], []
light = eg.Gaussians.from_arrays(
    [[8, 4]], [[0.3, 0, 0.3]], [[0.5] * 3], [1.0] * 3, size=(16, 8), space="radiance"
)
GREY = np.full((8, 8, 3), 0.5)
CONSTANT = {{"type": "constant"}}
FILM = {{"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb"}}


def wall(texture, sky=CONSTANT, integrator="direct"):
    # Load a wall that a camera sees.
    view = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    bsdf = {{"type": "diffuse", "reflectance": texture}}
    scene = {{"type": "scene", "integrator": {{"type": integrator}}, "sky": sky}}
    scene["sensor"] = {{"type": "perspective", "film": FILM, "to_world": view}}
    return mi.load_dict(scene | {{"wall": {{"type": "rectangle", "bsdf": bsdf}}}})


def grey_wall(number):
    # A wall with a bitmap; every other one under a sky of Gaussians.
    bitmap = {{"type": "bitmap", "data": mi.TensorXf(GREY), "raw": True}}
    sky = environment_of(light) if number % 2 else CONSTANT
    return wall(bitmap, sky, ("direct", "prb", "path")[number % 3])


def fit():
    result = eg.fit(image, 60, iterations=3, space="linear", progress=False)
    assert result.image.tobytes() == expected
    results.append(result)


def render():
    with eg.exclusive():
        assert np.isfinite(eg.render(results[-1].gaussians, width=50, height=30).numpy()).all()


def scene():
    with eg.exclusive():
        shown = wall(texture_of(results[-1].gaussians))
        assert np.isfinite(mi.render(shown, spp=2).numpy()).all()
        loaded.extend([shown, grey_wall(counts["scene"])])


def recover():
    with eg.exclusive():
        seen = grey_wall(counts["recover"])
    loss = photo_loss(seen, "wall.bsdf.reflectance", [GREY])
    found = eg.fit(loss=loss, size=(8, 8), gaussians=4, iterations=8, progress=False)
    assert np.isfinite(found.image).all()


def drop():
    # Drop results and scenes at any time: this needs no lock.
    while len(results) > 1:
        results.pop(0)
    while loaded:
        loaded.pop()
        time.sleep(0.003)
    time.sleep(0.01)


def repeat(work):
    try:
        while time.monotonic() < end and not failures:
            work()
            counts[work.__name__] += 1
    except BaseException as error:
        failures.append(repr(error))


sys.setswitchinterval(1e-6)
works = [fit, fit, render, scene, recover, recover, drop]
threads = [threading.Thread(target=repeat, args=(work,), daemon=True) for work in works]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(failures, counts)
os._exit(1 if failures or not all(counts.values()) else 0)
"""


@pytest.mark.slow
@pytest.mark.mitsuba
@pytest.mark.timeout(SECONDS + 300)
def test_mixed_threads():
    pytest.importorskip("mitsuba", reason="scenes need mitsuba")
    code = MIXED.format(seconds=SECONDS)
    ended = run_python(code, SECONDS + 100, PYTHONPATH=python_path())
    assert ended.returncode == 0, ended.stdout + ended.stderr
    print(ended.stdout)
