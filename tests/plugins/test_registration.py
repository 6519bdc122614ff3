"""Where plugins are found."""

import subprocess
import sys

import pytest

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
import eigengs_dr as eg  # noqa: E402
from _helpers.texture import gaussians, texture  # noqa: E402

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

    def test_registered_before_there_is_a_variant(self):
        """In a process of its own, in which none was set yet."""
        program = (
            "import eigengs_dr as eg, mitsuba as mi\n"
            "eg.register_plugins()\n"
            "mi.set_variant('llvm_ad_rgb')\n"
            "try:\n"
            "    mi.load_dict({'type': 'gaussian_texture'})\n"
            "except RuntimeError as error:\n"
            "    print(error)\n"
        )
        found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
        assert "give one of filename" in found.stdout, found.stderr
