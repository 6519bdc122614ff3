"""Fits of materials: every map in its own space, goals for each map, levels, packing, mistakes."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.materials import images
from eigengs_dr.image.pixels import ImageError


def figures(result, **changed):
    """psnr_rgb of each map of a fit, measured anew."""
    shown = images() | changed
    return {name: eg.psnr(shown[name], result.image[name]) for name in shown}


def test_each_map_is_fitted_in_its_space():
    result = eg.fit(images(), 100, iterations=60)
    spaces = [(m.name, m.space, m.channels) for m in result.gaussians.maps]
    assert spaces == [("albedo", "linear", 3), ("roughness", "data", 1), ("normal", "normal", 3)]
    found = figures(result)
    assert min(found.values()) > 30
    best = max(result.trace, key=lambda row: row["psnr_ycbcr"])
    for name, psnr in found.items():
        assert best["maps"][name]["psnr_rgb"] == pytest.approx(psnr, abs=0.05)
    lengths = np.linalg.norm(2 * result.image["normal"] - 1, axis=2)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)


def test_a_weight_favours_its_map():
    plain = figures(eg.fit(images(), 40, iterations=40))
    heavy = figures(eg.fit(images(), 40, iterations=40, weights={"roughness": 8}))
    assert heavy["roughness"] > plain["roughness"] + 0.5


def test_one_map_of_one_channel_and_data_above_1():
    height = 12 * images()["roughness"]
    result = eg.fit({"height": height}, 100, iterations=40)
    assert [tuple(m)[:3] for m in result.gaussians.maps] == [("height", "data", 1)]
    assert np.abs(result.image["height"] - height).mean() < 0.1


def test_equal_channels_of_data_become_one():
    grey = np.repeat(images()["roughness"], 3, axis=2)
    result = eg.fit({"roughness": grey, "albedo": grey}, 30, iterations=0)
    assert [m.channels for m in result.gaussians.maps] == [1, 3]


def test_goals_of_maps_are_met_by_few():
    goals = {"albedo": 32, "roughness": 30, "normal": 28}
    result = eg.fit(images(), target_psnr=goals, target_space="rgb", iterations=60)
    assert result.stopped == "met"
    found = figures(result)
    assert all(found[name] >= goals[name] - 0.01 for name in goals)
    easier = eg.fit(images(), target_psnr=24, iterations=60)
    assert len(easier.gaussians) < len(result.gaussians)


def test_levels_are_materials_too():
    result = eg.fit(images(), 160, iterations=40, levels=2)
    level = eg.picture_of(result.gaussians[:40])
    assert eg.psnr(level["albedo"], images()["albedo"]) > 22


def test_packing(tmp_path):
    result = eg.fit(images(), 12, iterations=100)
    before = figures(result)
    packed = eg.pack(result, tmp_path / "m.egs", images(), max_psnr_drop=0.5)
    assert 0 < packed.psnr_drop <= 0.5
    assert packed.bytes == (tmp_path / "m.egs").stat().st_size < 12 * 12 * 4
    loaded = eg.Gaussians.load(tmp_path / "m.egs")
    assert [m[:3] for m in loaded.maps] == [m[:3] for m in result.gaussians.maps]
    for name, picture in eg.picture_of(loaded).items():
        np.testing.assert_allclose(picture, eg.picture_of(packed.gaussians)[name], atol=1e-5)
        psnr = eg.psnr(picture, images()[name])
        assert psnr == pytest.approx(packed.psnr[name], abs=0.05)
        assert psnr > before[name] - 2.5  # so few Gaussians share the loss unevenly
    eg.pack(result.gaussians["albedo"], tmp_path / "a.egs", images()["albedo"])
    assert eg.Gaussians.load(tmp_path / "a.egs").maps == ()
    with pytest.raises(ValueError, match="a set with maps has one section"):
        eg.pack(result, tmp_path / "b.egs", images(), sections=[4, 8])
    with pytest.raises(ValueError, match="the set has no maps; give its image alone"):
        eg.pack(result.gaussians["albedo"], tmp_path / "b.egs", images())
    with pytest.raises(ValueError, match="has maps; give the images of albedo, roughness, normal"):
        eg.pack(result, tmp_path / "b.egs", images()["albedo"])
    content = bytearray((tmp_path / "m.egs").read_bytes())
    for cut in (60, 75, 90):  # inside the table of maps
        (tmp_path / "bad.egs").write_bytes(content[:cut])
        with pytest.raises(ValueError, match="is cut off"):
            eg.Gaussians.load(tmp_path / "bad.egs")
    content[75] ^= 0xFF
    (tmp_path / "bad.egs").write_bytes(content)
    with pytest.raises(ValueError, match=r"bad.egs: .*(damaged|unknown|cut off)"):
        eg.Gaussians.load(tmp_path / "bad.egs")


def test_packing_without_images(tmp_path):
    result = eg.fit(images(), 4, iterations=10)
    packed = eg.pack(result, tmp_path / "m.egs")
    assert min(packed.psnr.values()) > 25
    with pytest.raises(ValueError, match="images are of albedo; give one of each of albedo, rough"):
        eg.pack(result, tmp_path / "m.egs", {"albedo": images()["albedo"]})
    with pytest.raises(ValueError, match=r"pack writes \.egs files"):
        eg.pack(result, tmp_path / "m.npz")


SMALL = {"albedo": np.zeros((8, 8, 3)), "roughness": np.zeros((8, 8))}


@pytest.mark.parametrize(
    ("maps", "settings", "words"),
    [
        (SMALL | {"ao": np.zeros((8, 9))}, {}, "differ in size: albedo 8x8, roughness 8x8, ao 9x8"),
        (SMALL | {"a b": np.zeros((8, 8))}, {}, "map 'a b': a name starts with a letter"),
        ({}, {}, "maps are none; give each name once"),
        ({f"albedo{k}": np.eye(3)[:, :, None] * (1, 2, 3) for k in range(6)}, {}, "18 channels"),
        (SMALL | {"normal": np.zeros((8, 8))}, {}, "map 'normal': shape .* three channels"),
        ({"albedo": np.full((8, 8, 3), np.nan)}, {}, "map 'albedo': 64 of 64 pixels are not fin"),
        (SMALL, {"space": {"rough": "data"}}, "space names 'rough', which is no map"),
        (SMALL, {"space": {"roughness": "hsv"}}, "map 'roughness': space 'hsv' is unknown"),
        (SMALL, {"weights": {"ao": 1}}, "weights names 'ao', which is no map"),
        (SMALL, {"weights": {"albedo": 0}}, "'albedo' has 0; it must be above 0"),
        (SMALL, {"target_psnr": {"albedo": 30}}, "target_psnr names albedo; give one number"),
        (
            SMALL,
            {"target_psnr": {"albedo": 30, "roughness": np.nan}},
            "target_psnr is nan",
        ),
        (SMALL, {"target_psnr": 30, "gaussians": 9}, "exclude each other"),
        (SMALL, {"target_psnr": 30, "levels": 2}, "levels and target_psnr exclude each other"),
        (SMALL, {"gaussians": 65}, "gaussians is 65"),
        (SMALL, {"space": "linear"}, "for maps give the space of each by its name"),
        (SMALL, {"preset": "gaussianimage"}, "maps need preset 'default' and no start"),
        (SMALL["albedo"], {"weights": {"a": 1}}, "are for a mapping of images"),
    ],
)
def test_mistakes(maps, settings, words):
    with pytest.raises((ImageError, ValueError), match=words) as error:
        eg.fit(maps, **settings)
    assert "\n" not in str(error.value)
