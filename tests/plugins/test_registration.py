"""Where plugins are found, and scenes that Mitsuba loads in threads of its own."""

import threading

import pytest

import eigengs_dr as eg
from _helpers.process import run_python
from _helpers.texture import gaussians, mi, texture

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


class TestFound:
    def test_a_file_beside_the_scene(self, tmp_path, monkeypatch):
        gaussians().save(tmp_path / "x.npz")
        (tmp_path / "scene.xml").write_text(
            '<scene version="3.0.0"><shape type="rectangle"><bsdf type="diffuse">'
            '<texture type="gaussian_texture" name="reflectance">'
            '<string name="filename" value="x.npz"/></texture></bsdf></shape></scene>'
        )
        monkeypatch.chdir("/")
        scene = mi.load_file(str(tmp_path / "scene.xml"))
        assert any(key.endswith("reflectance.mean") for key, _ in mi.traverse(scene))

    def test_registering_again_keeps_the_class(self):
        before = type(texture(gaussians()))
        eg.register_plugins()
        assert type(texture(gaussians())) is before


FIRST = """
import eigengs_dr as eg, drjit as dr, mitsuba as mi, numpy as np
dr.set_thread_count(1)
eg.register_plugins()
mi.set_variant("llvm_ad_rgb")
try:
    mi.load_dict({"type": "gaussian_texture"})
except RuntimeError as error:
    print(error)
mi.Bitmap(np.full((40, 40, 3), 0.5, np.float32)).write(r"FOLDER/x.exr")
print(np.array(mi.Bitmap(r"FOLDER/x.exr")).mean())
"""


def test_registered_before_there_is_a_variant_and_beside_one_thread(tmp_path):
    """In a process of its own. With one thread, as on one core, no EXR file would be written."""
    done = run_python(FIRST.replace("FOLDER", str(tmp_path)))
    *told, mean = done.stdout.splitlines()
    assert "give one of filename" in "".join(told) and mean == "0.5", done.stderr


LOAD = """
import eigengs_dr as eg, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
scene = {"type": "scene", "sky": {"type": "constant"}}
noise = np.random.default_rng(0).random((256, 256, 3)).astype(np.float32)
gaussians = eg.fit(noise[:64, :64], 200, 0).gaussians
for n in range(6):
    mi.Bitmap(noise).write(rf"FOLDER/{n}.exr")
    gaussians.save(rf"FOLDER/{n}.npz")
    smooth = {"type": "gaussian_texture", "filename": rf"FOLDER/{n}.npz", "prefilter": n / 100}
    for kind in (smooth, {"type": "bitmap", "filename": rf"FOLDER/{n}.exr"}):
        paint = {"type": "roughplastic", "diffuse_reflectance": kind}  # it asks for the mean
        scene[f"{kind['type']}{n}"] = {"type": "sphere", "bsdf": paint}
with eg.exclusive():
    for _ in range(3):
        loaded = mi.load_dict(scene)
with eg.exclusive():  # nobody has kept the lock, or its absence
    print(len(loaded.shapes()), eg.fit(eg.sample("coffee")[:16, :16], 9, 1).gaussians)
"""


def test_textures_of_files_load_while_the_caller_holds_the_lock(tmp_path):
    """Mitsuba's threads would wait for the lock, and the caller for them.

    OpenEXR waits for these threads too: a texture that waits for another one stops it.
    """
    done = run_python(LOAD.replace("FOLDER", str(tmp_path)))
    assert done.stdout.startswith("12 "), done.stderr


def test_a_block_keeps_the_scenes_that_another_thread_drops():
    """Mitsuba renders without Python's lock: what the thread frees would end the process."""
    from eigengs_dr.backend.recording import exclusive
    from eigengs_dr.plugins.registration import living_objects

    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    before, others = len(living_objects()), []

    def load():
        with exclusive():
            others.append(mi.load_dict({"type": "scene", "ball": {"type": "sphere"}}))

    def in_thread(function):
        thread = threading.Thread(target=function)
        thread.start()
        thread.join()

    in_thread(load)
    with exclusive():
        in_thread(others.clear)
        assert len(living_objects()) > before
    assert len(living_objects()) == before
