"""Materials: the set of a map, pictures, files, and hostile files."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import file_refused
from _helpers.files import members_of
from _helpers.materials import MAPS, material
from _helpers.reference import render_exact
from _helpers.sets import check_equal
from eigengs_dr.gaussian.channels import TextureMap, check_maps, slices, usual_space
from eigengs_dr.gaussian.file import read_map
from eigengs_dr.storage import npz
from eigengs_dr.storage.npz import BadValue


def test_the_set_of_a_map_renders_its_channels(backend):
    """The oracle renders each map alone, in double precision."""
    m = material(backend=backend)
    arrays, pictures = m.to_arrays(), eg.picture_of(m)
    for own, part in zip(m.maps, slices(m.maps), strict=True):
        view = m[own.name]
        assert (view.space, view.channels) == (own.space, own.channels)
        exact = render_exact(
            arrays["mean"],
            arrays["factor"],
            arrays["color"][:, part],
            arrays["background"][part],
            22,
            17,
            m.cutoff,
        )
        summed = eg.render(replace(view, space="data")).numpy()
        np.testing.assert_allclose(summed, exact, atol=2e-3)  # a Gaussian ends at its cutoff
        np.testing.assert_allclose(pictures[own.name], eg.picture_of(view), atol=2e-6)
        assert view.mean[0].index == m.mean[0].index  # one memory


def test_names():
    m = material()
    assert repr(m) == "Gaussians(24, 22x17 pixels, maps albedo, roughness, normal, cutoff=3)"
    with pytest.raises(
        KeyError, match="no map is named 'height'; it has albedo, roughness, normal"
    ):
        m["height"]
    assert [usual_space(n) for n in ("Base_Color", "NORMAL", "ao")] == ["linear", "normal", "data"]
    assert (len(m[:7]), len(m[:7]["normal"]), m[:7].maps) == (7, 7, MAPS)
    with pytest.raises(KeyError, match="it has no maps"):
        m["normal"]["normal"]


@pytest.mark.parametrize(
    ("maps", "words"),
    [
        ([TextureMap("a", "data", 1), TextureMap("a", "data", 1)], "give each name once"),
        ([TextureMap("a", "hsv", 3)], "space 'hsv' is not in"),
        ([TextureMap("a", "normal", 1)], "has 1 channels; space 'normal' has 3"),
        ([TextureMap("a", "data", 2)], "has 2 channels; space 'data' has 1 or 3"),
        ([TextureMap("a", "data", 1, np.nan)], "weight is nan"),
        ([TextureMap("a", "data", 3)], "but the Gaussians have 1"),
    ],
)
def test_invalid_maps(maps, words):
    with pytest.raises(BadValue, match=words):
        check_maps(maps, 1)


def test_a_file_holds_it_all(tmp_path):
    m = material()
    m.save(tmp_path / "m.npz")
    again = eg.Gaussians.load(tmp_path / "m.npz")
    assert again.maps == m.maps
    check_equal(again, m.to_arrays())


def test_an_image_has_no_map_to_read(tmp_path):
    material()["albedo"].save(tmp_path / "g.npz")
    with pytest.raises(ValueError, match="holds one image and no maps; leave out map"):
        read_map(tmp_path / "g.npz", "albedo")


HOSTILE = {
    "a name": ({"names": np.array(["albedo", "../x", "normal"])}, "a name starts with a letter"),
    "lengths": ({"weights": np.ones(2)}, "differ in length"),
    "too many": ({"names": np.array(["a"] * 99)}, "claims shape"),
    "long": ({"names": np.array(["a" * 70, "b", "c"])}, "longer than 64 characters"),
    "missing": ({"names": None}, "key 'names' is missing"),
    "values": ({"color": np.full((24, 7), np.nan, np.float32)}, "color holds values that are not"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files(tmp_path, case):
    changes, words = HOSTILE[case]
    path = tmp_path / "m.npz"
    material().save(path)
    members = {k: v for k, v in (members_of(path) | changes).items() if v is not None}
    npz.write(path, "eigengs_dr.material", 1, members)
    with file_refused(path, words):
        eg.Gaussians.load(path)
