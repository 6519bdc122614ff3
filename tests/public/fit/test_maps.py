"""Fits of materials: every map in its own space, goals for each map, levels, packing, mistakes."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.materials import images
from _helpers.waves import METHODS


def figures(result, **changed):
    """psnr_rgb of each map of a fit, measured anew."""
    shown = images() | changed
    return {name: eg.psnr(shown[name], result.image[name]) for name in shown}


@pytest.fixture(scope="module")
def plain():
    return eg.fit(images(), 60, iterations=60)


def test_each_map_is_fitted_in_its_space(plain):
    spaces = [(m.name, m.space, m.channels) for m in plain.gaussians.maps]
    assert spaces == [("albedo", "linear", 3), ("roughness", "data", 1), ("normal", "normal", 3)]
    reached = figures(plain)
    assert min(reached.values()) > 25
    best = max(plain.trace, key=lambda row: row["psnr_ycbcr"])
    for name, psnr in reached.items():
        assert best["maps"][name]["psnr_rgb"] == pytest.approx(psnr, abs=0.05)
    lengths = np.linalg.norm(2 * plain.image["normal"] - 1, axis=2)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)


def test_a_weight_favours_its_map(plain):
    rough = eg.Map(images()["roughness"], weight=8)
    heavy = figures(eg.fit(images() | {"roughness": rough}, 60, iterations=60))
    assert heavy["roughness"] > figures(plain)["roughness"] + 0.5


def test_weights_of_pixels_hold_for_all_maps(plain):
    """Pixels without weight may be NaN, also in the first solve that balances the maps."""
    weight, hidden = np.ones((32, 32)), images()
    weight[:, 16:] = 0
    for image in hidden.values():
        image[:, 16:] = np.nan
    found = eg.fit(hidden, 60, iterations=60, weight=weight)
    for name, image in images().items():
        left, other = (eg.psnr(r.image[name][:, :16], image[:, :16]) for r in (found, plain))
        assert left > other + 1
        assert found.maps[name]["psnr_rgb"] == pytest.approx(left, abs=0.05)


def test_one_map_of_one_channel_and_data_above_1():
    height = 12 * images()["roughness"]
    result = eg.fit({"height": height}, 100, iterations=40)
    assert [tuple(m)[:3] for m in result.gaussians.maps] == [("height", "data", 1)]
    assert np.abs(result.image["height"] - height).mean() < 0.1


def test_equal_channels_of_data_become_one_and_spaces_are_of_names_or_the_users():
    grey = np.repeat(images()["roughness"], 3, axis=2)
    glow = eg.Map(images()["albedo"], space="rgb")
    maps = {"Roughness": grey, "Base_Color": grey, "glow": glow}
    result = eg.fit(maps | {"NORMAL": images()["normal"]}, 30, iterations=0)
    kinds = [(m.space, m.channels) for m in result.gaussians.maps]
    assert kinds == [("data", 1), ("linear", 3), ("rgb", 3), ("normal", 3)]


def test_goals_of_maps_are_met_by_few():
    goals = {"albedo": 30, "roughness": 28, "normal": 26}
    maps = {name: eg.Map(image, goal=goals[name]) for name, image in images().items()}
    result = eg.fit(maps, iterations=40)
    assert result.stopped == "met"
    reached = figures(result)
    assert all(reached[name] >= goals[name] - 0.01 for name in goals)
    easier = eg.fit(images(), target_psnr=22, iterations=40)
    assert len(easier.gaussians) < len(result.gaussians)


def test_the_goal_of_a_fit_is_that_of_maps_without_their_own():
    """In the space of the goal; normals and data have one PSNR alone."""
    maps = images() | {"roughness": eg.Map(images()["roughness"], goal=30)}
    result = eg.fit(maps, target_psnr=eg.Goal(26, "ycbcr", max_gaussians=300), iterations=40)
    assert result.stopped == "met" and len(result.gaussians) <= 300
    shown = figures(result)
    assert shown["roughness"] > 29.5  # of data, its PSNR without rounding counts
    color = eg.psnr(images()["albedo"], result.image["albedo"], "ycbcr")
    assert color > 25.9 and shown["normal"] > 25.5


@pytest.mark.slow
def test_levels_are_materials_too():
    result = eg.fit(images(), [40, 160], iterations=40)
    level = eg.picture_of(result.gaussians[:40])
    assert eg.psnr(level["albedo"], images()["albedo"]) > 22


@pytest.mark.slow
def test_maps_by_another_method():
    result = eg.fit(images(), 60, iterations=30, method=METHODS["gaussianimage"])
    assert list(result.image) == list(images())
    assert result.psnr_ycbcr > result.trace[0]["psnr_ycbcr"]


@pytest.mark.slow
def test_packing(tmp_path):
    result = eg.fit(images(), 4, iterations=60)
    before = figures(result)
    packed = eg.pack(result, tmp_path / "m.egs", images(), max_psnr_drop=0.5)
    assert 0 < packed.psnr_drop <= 0.5
    result.save(tmp_path / "m.npz")
    assert packed.bytes < (tmp_path / "m.npz").stat().st_size
    loaded = eg.Gaussians.load(tmp_path / "m.egs")
    assert [m[:3] for m in loaded.maps] == [m[:3] for m in result.gaussians.maps]
    for name, picture in eg.picture_of(loaded).items():
        np.testing.assert_allclose(picture, eg.picture_of(packed.gaussians)[name], atol=1e-5)
        psnr = eg.psnr(picture, images()[name])
        assert psnr == pytest.approx(packed.psnr[name], abs=0.05)
        assert psnr > before[name] - 2.5  # so few Gaussians share the loss unevenly
    assert min(eg.pack(result, tmp_path / "n.egs").psnr.values()) > 25
    with pytest.raises(ValueError, match="has maps; give the images of albedo, roughness, normal"):
        eg.pack(result, tmp_path / "b.egs", images()["albedo"])
    with pytest.raises(ValueError, match="a set with maps has one section"):
        eg.pack(result, tmp_path / "b.egs", images(), sections=[2, 2])


SMALL = {"albedo": np.zeros((8, 8, 3)), "roughness": np.zeros((8, 8))}
ROUGH, WHITE = SMALL["roughness"], SMALL["albedo"]


@pytest.mark.parametrize(
    ("maps", "settings", "words"),
    [
        (SMALL | {"ao": np.zeros((8, 9))}, {}, "differ in size: albedo 8x8, roughness 8x8, ao 9x8"),
        (SMALL | {"a b": np.zeros((8, 8))}, {}, "map 'a b': a name starts with a letter"),
        ({}, {}, "maps are none; give each name once"),
        ({f"albedo{k}": np.eye(3)[:, :, None] * (1, 2, 3) for k in range(6)}, {}, "18 channels"),
        (SMALL | {"normal": np.zeros((8, 8))}, {}, "map 'normal': shape .* three channels"),
        ({"albedo": np.full((8, 8, 3), np.nan)}, {}, "map 'albedo': 64 of 64 pixels are not fin"),
        ({"ao": eg.Map(ROUGH, space="hsv")}, {}, "map 'ao': space 'hsv' is unknown; use one of yc"),
        ({"albedo": eg.Map(WHITE, weight=0)}, {}, "'albedo': weight is 0; it must be"),
        ({"albedo": eg.Map(WHITE, weight=1e20)}, {}, "is 1e\\+20; it must be from 1e-6 to"),
        ({"albedo": eg.Map(WHITE, weight="x")}, {}, "'albedo': weight is 'x'; it must be a"),
        (SMALL | {"ao": eg.Map(ROUGH, goal=30)}, {}, "map 'albedo' has no goal; give each map one"),
        ({"ao": eg.Map(ROUGH, goal=np.nan)}, {}, "map 'ao': target_psnr is nan"),
        (SMALL, {"space": "linear"}, "space and maps exclude each other: give each map a space of"),
        (SMALL, {"weight": np.ones((8, 9))}, "map 'albedo': weight is for 9x8 pixels, but the im"),
    ],
)
def test_mistakes(maps, settings, words):
    kind = TypeError if "; it must be a" in words else ValueError
    with pytest.raises(kind, match=words) as error:
        eg.fit(maps, **settings)
    assert "\n" not in str(error.value)
