"""Scenes that Mitsuba loads in threads of its own."""

import numpy as np
import pytest

from _helpers.process import run_python

pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
import eigengs_dr as eg

pytestmark = pytest.mark.mitsuba

LOAD = """
import eigengs_dr as eg, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
scene = {"type": "scene"}
for n in range(6):
    texture = {"type": "gaussian_texture", "filename": rf"FOLDER/{n % 2}.npz", "prefilter": 0.01}
    scene[f"s{n}"] = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}}
with eg.exclusive():
    loaded = mi.load_dict(scene)
with eg.exclusive():  # nobody has kept the lock, or its absence
    print(len(loaded.shapes()), eg.fit(eg.sample("coffee")[:16, :16], 9, 1).gaussians)
"""


def test_textures_of_files_load_while_the_caller_holds_the_lock(tmp_path):
    """Mitsuba's threads would wait for the lock, and the caller for them."""
    for n in range(2):
        image = np.full((16, 16, 3), 0.25 + n / 4)
        eg.fit(image, 9, iterations=1, backend="llvm").gaussians.save(tmp_path / f"{n}.npz")
    done = run_python(LOAD.replace("FOLDER", str(tmp_path)))
    assert done.stdout.startswith("6 "), done.stderr
