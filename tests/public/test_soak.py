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
from _helpers.poster import camera, scene_of
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
EYE = camera([0, 0, 3], 8, pixel_format="rgb")


def grey_wall(number):
    # A poster of a bitmap; every other one under a sky of Gaussians.
    sky = {{"lamp": environment_of(light)}} if number % 2 else {{}}
    return scene_of(EYE, integrator={{"type": ("direct", "prb", "path")[number % 3]}}, **sky)


def fit():
    result = eg.fit(image, 60, iterations=3, space="linear", progress=False)
    assert result.image.tobytes() == expected
    results.append(result)


def render():
    with eg.exclusive():
        assert np.isfinite(eg.render(results[-1].gaussians, width=50, height=30).numpy()).all()


def scene():
    with eg.exclusive():
        texture = texture_of(results[-1].gaussians)
        shown = scene_of(EYE, texture=texture, integrator={{"type": "direct"}})
        assert np.isfinite(mi.render(shown, spp=2).numpy()).all()
        loaded.extend([shown, grey_wall(counts["scene"])])


def recover():
    with eg.exclusive():
        seen = grey_wall(counts["recover"])
    loss = photo_loss(seen, "poster.bsdf.reflectance", [GREY])
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
