"""Threads that fit, render, load scenes and drop results, for a minute or SOAK_SECONDS."""

import os

import pytest

from _helpers.process import python_path, run_python

SECONDS = float(os.environ.get("SOAK_SECONDS", "60"))

MIXED = """
import os, sys, threading, time
import numpy as np
import eigengs_dr as eg
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
from eigengs_dr.plugins import texture_of

end, counts = time.monotonic() + {seconds}, dict.fromkeys(("fit", "render", "scene", "drop"), 0)
image = np.random.default_rng(0).random((24, 32, 3)).astype(np.float32)
first = eg.fit(image, 60, iterations=3, space="linear", progress=False)
expected = first.image.tobytes()
results, failures = [first], []


def wall(texture):
    return {{
        "type": "scene",
        "integrator": {{"type": "direct"}},
        "sensor": {{"type": "perspective", "film": {{"type": "hdrfilm", "width": 8, "height": 8}}}},
        "sky": {{"type": "constant"}},
        "wall": {{"type": "rectangle", "bsdf": {{"type": "diffuse", "reflectance": texture}}}},
    }}


def fit():
    result = eg.fit(image, 60, iterations=3, space="linear", progress=False)
    assert result.image.tobytes() == expected
    results.append(result)


def render():
    with eg.exclusive():
        assert np.isfinite(eg.render(results[-1].gaussians, width=50, height=30).numpy()).all()


def scene():
    with eg.exclusive():
        loaded = mi.load_dict(wall(texture_of(results[-1].gaussians)))
        assert np.isfinite(mi.render(loaded, spp=2).numpy()).all()
        del loaded


def drop():
    while len(results) > 1:
        results.pop(0)
    time.sleep(0.01)


def repeat(work):
    try:
        while time.monotonic() < end and not failures:
            work()
            counts[work.__name__] += 1
    except BaseException as error:
        failures.append(repr(error))


sys.setswitchinterval(1e-6)
works = [fit, fit, render, scene, drop]
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
