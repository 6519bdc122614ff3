"""Where plugins are found, threads that load them, and mistakes: one line says what to do."""

import importlib
import re
import threading
import weakref
from pathlib import Path

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.process import run_python
from _helpers.texture import at, gaussians, mi, texture
from _helpers.variants import in_variants, on_both
from eigengs_dr.plugins import environment_of, gaussians_of, keep_in_bounds, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

ROOT = Path(__file__).parents[3]


def test_registering_again_keeps_the_class():
    before = type(texture(gaussians()))
    eg.register_plugins()
    assert type(texture(gaussians())) is before


FIRST = """
import eigengs_dr as eg, drjit as dr, importlib, mitsuba as mi, numpy as np
dr.set_thread_count(1)
eg.register_plugins()
for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
    mi.set_variant(variant)
    importlib.reload(importlib.import_module("MODULE"))
    try:
        mi.load_dict({"type": "gaussian_texture"})
    except RuntimeError as error:
        print(error)
mi.Bitmap(np.full((40, 40, 3), 0.5, np.float32)).write(r"FOLDER/x.exr")
print(np.array(mi.Bitmap(r"FOLDER/x.exr")).mean())
"""


def test_registered_before_there_is_a_variant_and_beside_one_thread(tmp_path):
    """In a process of its own. With one thread, as on one core, no EXR file would be written.

    Mitsuba 3.10 imports the module of the entry point, and again after a change of the variant.
    """
    text = (ROOT / "pyproject.toml").read_text()
    module = re.search(r'entry-points\.mitsuba\]\n(?:#.*\n)*\w+ = "(.*)"', text)[1]
    assert importlib.util.find_spec(module)
    done = run_python(FIRST.replace("FOLDER", str(tmp_path)).replace("MODULE", module))
    assert done.stdout.count("give one of filename") == 2, done.stderr
    assert done.stdout.splitlines()[-1] == "0.5", done.stderr


LOAD = """
import eigengs_dr as eg, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
scene = {"type": "scene", "sky": {"type": "constant"}}
random = np.random.default_rng(0)
noise = random.random((256, 256, 3)).astype(np.float32)
gaussians = eg.Gaussians.from_arrays(
    random.random((24, 2)) * (22, 17), np.tile([0.4, 0, 0.4], (24, 1)), random.random((24, 3)) / 9,
    [0.5] * 3, size=(22, 17), space="linear",
)
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
    print(len(loaded.shapes()), eg.render(gaussians).numpy().mean())
"""


def test_textures_of_files_load_while_the_caller_holds_the_lock(tmp_path):
    """Mitsuba's threads would wait for the lock, and the caller for them.

    OpenEXR waits for these threads too: a texture that waits for another one stops it.
    """
    done = run_python(LOAD.replace("FOLDER", str(tmp_path)))
    assert done.stdout.startswith("12 "), done.stderr


def test_a_block_keeps_the_scenes_that_another_thread_drops():
    """Mitsuba renders without Python's lock: what the thread frees would end the process."""
    others = []

    def load():
        with eg.exclusive():
            others.append(texture(gaussians()))

    def in_thread(function):
        thread = threading.Thread(target=function)
        thread.start()
        thread.join()

    in_thread(load)
    alive = weakref.ref(others[0])
    with eg.exclusive():
        in_thread(others.clear)
        assert alive() is not None
    assert alive() is None


def test_a_collector_that_works_stays_out_of_lookups():
    """Scenes freed while another one is recorded end the process."""
    import gc

    works = []

    class Watched:
        """A point that notes whether the collector works while it is looked up."""

        def __getattr__(self, name):
            works.append(gc.isenabled())
            return getattr(at(0.5, 0.5), name)

    tex = texture(gaussians())
    tex.eval(Watched())
    tex.eval_3(Watched())
    with pytest.raises(ValueError, match="three channels"):
        texture(gaussians("data", channels=1)).eval_3(at(0.5, 0.5))
    assert works and not any(works) and gc.isenabled()


class TestMistakes:
    @pytest.mark.parametrize(
        ("properties", "message"),
        [
            ({"filename": "nowhere.npz"}, "nowhere.npz"),
            ({"filename": __file__}, r"test_plugins\.py"),
            ({"filename": "a.png"}, "a.png: is an image, .* 'eigengs-dr fit', .* plugin bitmap"),
            ({}, "give one of filename"),
            ({"filename": "a.npz", "model": "b.npz"}, "give one of filename"),
        ],
    )
    def test_of_where_from(self, properties, message):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict({"type": "gaussian_texture", **properties})

    def test_a_photo_as_environment(self):
        with pytest.raises(RuntimeError, match=r"is an image, .* the plugin envmap"):
            mi.load_dict({"type": "gaussian_environment", "filename": "sky.exr"})

    @pytest.mark.parametrize(
        ("properties", "message"),
        [
            ({"wrap_mode": "bounce"}, "wrap_mode 'bounce' is unknown; use one of repeat, mirror"),
            ({"cutoff": 0.0}, "cutoff is 0.0; it must be above 0 and at most 12"),
            ({"prefilter": -1.0}, "prefilter is -1.0; it is the angle of a pixel"),
            ({"prefiltre": 1.0}, "it has no property prefiltre"),
            ({"space": "cmyk"}, "space 'cmyk'"),
            ({"raw": "false"}, "raw is 'false'; it must be a boolean"),
            ({"cutoff": "wide"}, "cutoff is 'wide'; it must be a number"),
            ({"prefilter": False}, "prefilter is False; it must be true, or the angle of a pixel"),
            ({"width": 31.5}, "width is 31.5; it must be an integer"),
            ({"memory": "tiny"}, "memory is 'tiny'; it must be one of exact, normal, sm"),
            ({"to_uv": 2.0}, "to_uv is 2.0; it must be a transform"),
        ],
    )
    def test_of_properties(self, properties, message):
        with pytest.raises(RuntimeError) as caught:
            texture(gaussians(), **properties)
        assert f"gaussian_texture: {message}" in str(caught.value).splitlines()[0]

    @pytest.mark.parametrize(
        ("properties", "message"),
        [
            ({"scale": -1.0}, "scale is -1.0; it must be finite, and at least 0"),
            ({"scale": "bright"}, "scale is 'bright'; it must be a number"),
            ({"prefilter": 2.0}, "prefilter is 2.0; it is the angle of a pixel"),
            ({"wrap_mode": "clamp"}, "it has no property wrap_mode"),
        ],
    )
    def test_of_an_environment(self, properties, message):
        with pytest.raises(RuntimeError) as caught:
            mi.load_dict({**environment_of(gaussians("linear")), **properties})
        assert f"gaussian_environment: {message}" in str(caught.value).splitlines()[0]

    def test_transforms(self):
        flat = np.diag([1.0, 0, 1])
        many = mi.Transform4f().scale(mi.Vector3f(mi.Float([1, 2, 3]), 1, 1))
        with pytest.raises(RuntimeError, match="to_uv maps the plane to a line"):
            texture(gaussians(), to_uv=mi.ScalarTransform3f(flat))
        with pytest.raises(RuntimeError, match="to_uv holds 3 transforms; it must hold one"):
            texture(gaussians(), to_uv=many)
        parameters = mi.traverse(texture(gaussians()))
        parameters["to_uv"] = mi.ScalarTransform3f(flat)
        with pytest.raises(Exception, match="to_uv maps the plane to a line"):
            parameters.update()

    def test_sets_of_other_channels(self):
        with pytest.raises(RuntimeError, match="has 4 channels; use a set of 1 to 3"):
            texture(gaussians("data", channels=4))
        with pytest.raises(ValueError, match="a bump map needs heights; this set has 2"):
            texture(gaussians("data", channels=2)).eval_1_grad(at(0.5, 0.5))

    def test_an_array_that_is_missing_or_has_another_shape(self):
        properties = texture_of(gaussians())
        del properties["color"]
        with pytest.raises(RuntimeError, match="color is missing"):
            mi.load_dict(properties)
        parameters = mi.traverse(texture(gaussians()))
        parameters["color"] = mi.TensorXf(np.zeros((3, 3), np.float32))
        with pytest.raises(Exception, match=r"color has shape \(3, 3\), expected \(24, 3\)"):
            parameters.update()

    @in_variants(on_both("spectral"))
    @pytest.mark.parametrize("raw", [True, False])
    def test_a_spectrum_from_data(self, variant, raw):
        tex = texture(gaussians("rgb" if raw else "data"), raw=raw)
        with pytest.raises(ValueError, match="not raw data"):
            tex.eval(at(0.5, 0.5))

    @in_variants(["scalar_rgb"])
    @pytest.mark.parametrize("kind", ["gaussian_texture", "gaussian_environment"])
    def test_scalar_variants(self, variant, kind):
        with pytest.raises(RuntimeError, match=f"{kind} does not support the variant scalar_rgb"):
            mi.load_dict({"type": kind, "filename": "x.npz"})

    def test_the_name_of_no_texture(self):
        parameters = mi.traverse(
            mi.load_dict({"type": "diffuse", "reflectance": texture_of(gaussians())})
        )
        for name in ("reflectance.mean", "bsdf.reflectance"):
            for function in (gaussians_of, keep_in_bounds):
                with pytest.raises(ValueError, match=f"no {name}.mean .* mitsuba.traverse"):
                    function(parameters, name, gaussians())

    def test_none_stands_for_the_default(self):
        """It ends the process in Mitsuba."""
        g = gaussians("linear")
        for make in (texture_of, environment_of):
            given = make(g, prefilter=None, cutoff=None)
            assert "prefilter" not in given and given["cutoff"] == g.cutoff
            mi.load_dict(given)
