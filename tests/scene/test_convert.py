"""A scene whose bitmaps become Gaussians: what is converted, what stays, and mistakes."""

import shutil
import signal
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.bitmap_scenes import cornell, room, save_images, sky, wall
from _helpers.lit_spheres import directions, photos
from _helpers.poster import mi
from _helpers.texture import gaussians
from eigengs_dr.eigenbasis.eigengs import SHIPPED
from eigengs_dr.image.io import load_image
from eigengs_dr.plugins import texture_of
from eigengs_dr.scene import convert, fit_uses
from eigengs_dr.scene.rendering import pictures
from eigengs_dr.storage.atomic import lock_output

pytestmark = pytest.mark.mitsuba

QUICK = {"target_psnr": 30, "iterations": 20, "replace_all": True}
QUICKEST = {"target_psnr": 20, "iterations": 1, "replace_all": True}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The images of the scenes."""
    return save_images(tmp_path_factory.mktemp("images"))


def bitmaps_in(path):
    """Number of bitmaps in an XML file."""
    return Path(path).read_text().count('type="bitmap"')


def test_nested_maps_and_several_uses(folder, tmp_path):
    found = eg.convert_scene(wall(folder), tmp_path / "new", **QUICK)
    assert found.left == [] and bitmaps_in(found.scene) == 0
    names = {t.file: t.names for t in found.textures}
    assert names == {
        "photo.npz": ("photo.png (paint.reflectance)", "photo.png (principled.base_color)"),
        "normals.npz": ("normals.png (normalmap.normalmap)",),
        "rough.npz": ("rough.png (principled.roughness)",),
    }
    for texture in found.textures:
        assert texture.psnr >= 30 and texture.overlap > 0
        saved = eg.Gaussians.load(tmp_path / "new" / texture.file)
        assert len(saved) == texture.gaussians
        assert saved.space == ("linear" if texture.file == "photo.npz" else "data")
    assert len(found.psnr) == 2 and min(found.psnr) > 25
    text = found.scene.read_text()
    assert text.count("photo.npz") == 2 and 'value="mirror"' in text and "<scale" in text
    pictures = {p.name for p in (tmp_path / "new").glob("*.png")}
    assert pictures == {f"{k}-{n}.png" for k in ("before", "after", "difference") for n in (1, 2)}
    before, after = (load_image(tmp_path / "new" / f"{k}-1.png") for k in ("before", "after"))
    assert eg.psnr(before, after) == pytest.approx(found.psnr[0], abs=0.1)


def test_a_bitmap_that_is_better_stays(folder, tmp_path, monkeypatch):
    """A small bitmap of one channel takes less memory than its Gaussians, a large gradient more."""
    monkeypatch.setattr(convert, "NEGLIGIBLE", 0)  # it is small
    y, x = np.mgrid[:256, :256] / 256
    eg.save_image(folder / "soft.png", np.stack([0.2 + 0.5 * x, y * x, 0.5 + 0 * x], axis=2))
    text = wall(folder).read_text()
    scene = folder / "mixed.xml"
    scene.write_text(text.replace("photo.png", "soft.png", 1))
    settings = {"target_psnr": 50, "iterations": 60, "spp": 0}
    found = eg.convert_scene(scene, tmp_path / "new", **settings)
    by_name = {t.names[0]: t for t in found.textures}
    assert by_name["soft.png (paint.reflectance)"].bytes == 256 * 256 * 4  # Dr.Jit pads colours
    assert all(t.gaussian_bytes <= t.bytes for t in found.textures)
    assert "rough.png (principled.roughness)" in {t.names[0] for t in found.better}
    [(left, reason)] = found.left  # without renderings
    assert left == "normals.png (normalmap.normalmap)" and "renderings decide" in reason
    for texture in found.better:
        assert texture.file == "" and texture.gaussian_bytes > texture.bytes
        assert texture.psnr >= 50 and texture.gaussians > 0
    files = {path.name for path in (tmp_path / "new").glob("*.npz")}
    assert files == {t.file for t in found.textures}
    assert bitmaps_in(found.scene) == len(found.better) + 1


def many_at_a_point(count):
    """A set of wide Gaussians, of which so many overlap."""
    side, deviation = 512, 20.0
    number = round(count * side**2 / (np.pi * 9 * deviation**2))
    mean = np.random.default_rng(0).uniform(0, side, (number, 2))
    factor = np.tile([1 / deviation, 0, 1 / deviation], (number, 1))
    return eg.Gaussians.from_arrays(mean, factor, np.full((number, 3), 0.01), size=(side, side))


def test_where_many_gaussians_overlap_the_bitmap_is_better(tmp_path):
    """A count decides, not a clock, and so does memory."""
    settings = convert.Settings(40.0, 10, 0, False)
    for count, held, stays in (
        (20, [1 << 20, 1000], False),
        (50, [1 << 20, 1000], True),
        (20, [1000, 17_000], False),
        (20, [1000, 18_000], True),
    ):
        g, file = many_at_a_point(count), tmp_path / "set.npz"
        assert convert.overlap_of(g) == pytest.approx(count, rel=0.02)
        g.save(file)
        for chosen in (settings, settings._replace(replace_all=True)):
            found = convert._chosen(("name",), file, g, 40.0, held, chosen)
            assert (found.file == "") == (not file.exists()) == (stays and chosen is settings)
            g.save(file)


def test_what_stays_and_why(folder, tmp_path):
    found = eg.convert_scene(sky(folder), tmp_path / "new", **QUICK)
    reasons = dict(found.left)
    assert "no shape" in reasons["photo.png (projector.irradiance)"]
    assert "two values" in reasons["leaf.png (mask.opacity)"]
    assert "two values" in reasons["leaf.png (blendbsdf.weight)"]
    assert "no pixel" in reasons["hidden.png (diffuse.reflectance)"]
    photo, environment = found.textures
    assert photo.names == ("photo.png (diffuse.reflectance)", "photo.png (area.radiance)")
    assert environment.names == ("photo.png (environment)",)
    assert bitmaps_in(found.scene) == 4
    assert min(found.psnr) > 25
    assert str(folder) not in found.scene.read_text()  # other files are named relative to it


def test_renderings_that_miss_the_goal_are_named(folder, tmp_path):
    """The goal is that of textures in even light; a strong lamp amplifies errors in the dark."""
    eg.save_image(folder / "night.png", 0.15 * eg.sample("coffee")[:192:6, :192:6])
    lamp = {"type": "constant", "radiance": {"type": "rgb", "value": 40.0}}
    scene = plain(mi, folder, {"type": "bitmap", "filename": str(folder / "night.png")}, lamp=lamp)
    with pytest.warns(UserWarning, match=r"new: camera 1 sees psnr_rgb .* below the goal of 30"):
        found = eg.convert_scene(scene, tmp_path / "new", **QUICK)
    assert min(found.psnr) < 30


def test_the_search_aims_at_the_renderings(folder, tmp_path):
    """A set that is seen at 32 dB in even light is rendered at 29 under a strong lamp."""
    eg.save_image(folder / "dim.png", 0.3 * eg.sample("coffee")[:192:6, :192:6])
    lamp = {"type": "constant", "radiance": {"type": "rgb", "value": 5.0}}
    scene = plain(mi, folder, {"type": "bitmap", "filename": str(folder / "dim.png")}, lamp=lamp)
    settings = {"iterations": 40, "spp": 16, "replace_all": True}
    found = eg.convert_scene(scene, tmp_path / "new", 32, **settings)
    assert found.psnr[0] > 31.5 and found.textures[0].psnr > 33.5


def test_a_dictionary_with_a_mesh_and_a_bump_map_that_stays(folder, tmp_path):
    """A cube shows the facets of 32 x 32 texels, which no Gaussians have."""
    found = eg.convert_scene(room(mi, folder), tmp_path / "new", spp=2, **QUICK)
    assert {t.file for t in found.textures} == {"photo.npz"}
    assert dict(found.left)["rough.png (cube.bsdf.nested_texture)"].startswith(
        "heights of a bump map: the renderings keep "
    )
    scene = mi.load_file(str(found.scene))
    assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
    assert "cube.ply" in found.scene.read_text()
    assert not (tmp_path / "new" / "rough.npz").exists()


def test_ids_are_kept(folder, tmp_path):
    """Also those that nothing refers to: of cameras, shapes, emitters, materials and textures."""
    text = wall(folder).read_text().replace("<emitter", '<emitter id="sky"')
    for number, kind in enumerate(["sensor", "sensor", "shape", "shape"]):
        text = text.replace(f'<{kind} type="', f'<{kind} id="object-{number}" type="', 1)
    text = text.replace('<bsdf type="principled"', '<bsdf type="principled" id="coat"')
    text = text.replace('name="roughness" type', 'id="grain" name="roughness" type')
    (folder / "named.xml").write_text(text)
    found = eg.convert_scene(folder / "named.xml", tmp_path / "new", spp=0, **QUICKEST)
    assert found.psnr == [] and not list((tmp_path / "new").glob("*.png"))  # nothing is rendered
    assert found.left[0][1].startswith("vectors of a normal map: renderings decide")
    ids = [
        {e.attrib["id"]: e.attrib["type"] for e in ElementTree.parse(file).iter("*")
         if "id" in e.attrib and e.tag != "ref"}
        for file in (folder / "named.xml", found.scene)
    ]  # fmt: skip
    bitmaps = {name for name, kind in ids[0].items() if kind == "bitmap"}
    assert bitmaps == {"photo", "grain"}
    assert ids[1] == ids[0] | dict.fromkeys(bitmaps, "gaussian_texture")
    names = [
        {k for k in mi.traverse(mi.load_file(str(file))).keys() if "to_world" in k}  # noqa: SIM118
        for file in (folder / "named.xml", found.scene)
    ]
    assert names[1] == names[0] == {f"object-{k}.to_world" for k in range(4)}


def test_ids_of_a_dictionary(folder, tmp_path):
    """Slots are called alike in many objects, and one of them may be an object of the scene."""
    photo = {"type": "bitmap", "filename": str(folder / "photo.png")}
    coat = {"type": "diffuse", "id": "coat", "reflectance": {"type": "rgb", "value": 0.2}}
    other = {"type": "sphere", "radius": 0.1, "bsdf": coat}
    scene = plain(mi, folder, photo, other=other, bsdf={"type": "sphere", "bsdf": {"type": "null"}})
    found = eg.convert_scene(scene, tmp_path / "new", spp=0, **QUICKEST)
    ids = [e.attrib.get("id") for e in ElementTree.parse(found.scene).iter("*")]
    assert {"cube", "other", "coat", "bsdf", "sensor"} <= {*ids}
    assert "bsdf.to_world" in mi.traverse(mi.load_file(str(found.scene)))


def bumpy(folder, name, **settings):
    """A wall with soft waves of 128 x 128 texels, which a camera sees at 24 x 24 pixels."""
    y, x = np.mgrid[:128, :128] / 128
    waves = 0.5 + 0.3 * np.sin(20 * x + 3 * np.sin(9 * y))
    eg.save_image(folder / name, waves)
    bump = {"type": "bitmap", "filename": str(folder / name), "wrap_mode": "clamp", **settings}
    bump = {"type": "bumpmap", "arbitrary": bump, "bsdf": {"type": "diffuse"}}
    light = {"type": "point", "position": [2, 2, 2], "intensity": 8.0}
    wall = {"type": "rectangle", "bsdf": bump}
    return {**room(mi, folder), "cube": wall, "lamp": light}


@pytest.mark.parametrize("raw", [True, False])
def test_a_bump_map_that_keeps_the_renderings_alike(folder, tmp_path, raw):
    scene = bumpy(folder, "waves.png", raw=raw)
    settings = {"target_psnr": 36, "iterations": 40, "spp": 64, "replace_all": True}
    found = eg.convert_scene(scene, tmp_path / "new", **settings)
    [waves] = found.textures
    assert found.left == [] and waves.names == ("waves.png (cube.bsdf.nested_texture)",)
    assert 36 <= waves.psnr == pytest.approx(found.psnr[0], abs=0.5) and waves.gaussians < 1000
    flat = {**scene, "cube": {"type": "rectangle", "bsdf": {"type": "diffuse"}}}
    seen, smooth = (pictures(mi.load_dict(s), 64)[0] for s in (scene, flat))
    assert eg.psnr(seen, smooth) < 26  # without its bumps


def test_a_bump_map_without_renderings_stays(folder, tmp_path):
    found = eg.convert_scene(bumpy(folder, "waves.png"), tmp_path / "new", spp=0, **QUICK)
    [(_, reason)] = found.left
    assert found.textures == [] and "renderings decide, and none was asked for" in reason


def test_a_normal_map_whose_glints_would_go_stays(folder, tmp_path):
    """Its vectors look alike in the mean of each pixel, and nothing of what they reflect does."""
    noise = np.random.default_rng(0).normal(0, 0.3, (64, 64, 2))
    n = np.concatenate([noise, np.ones((64, 64, 1))], axis=2)
    eg.save_image(folder / "glints.png", 0.5 + 0.5 * n / np.linalg.norm(n, axis=2, keepdims=True))
    glints = {"type": "bitmap", "filename": str(folder / "glints.png"), "raw": True}
    metal = {"type": "roughconductor", "alpha": 0.05}
    wall = {"type": "rectangle", "bsdf": {"type": "normalmap", "normalmap": glints, "bsdf": metal}}
    lamp = {"type": "point", "position": [1, 1, 3], "intensity": 8.0}
    scene = {**room(mi, folder), "cube": wall, "lamp": lamp}
    found = eg.convert_scene(scene, tmp_path / "new", spp=16, **QUICK)
    [(name, reason)] = found.left
    assert found.textures == [] and name.startswith("glints.png")
    assert reason.startswith("vectors of a normal map: the renderings keep ")
    assert min(found.psnr) > 60


def test_what_cannot_be_smooth_is_refused_without_a_fit(folder, tmp_path, monkeypatch):
    """A chequered bump map: one rendering tells."""
    monkeypatch.setattr(fit_uses, "fit", None)
    scene = bumpy(folder, "tiles.png")
    y, x = np.mgrid[:32, :32] // 2
    eg.save_image(folder / "tiles.png", 0.3 + 0.4 * ((x + y) % 2))
    found = eg.convert_scene(scene, tmp_path / "new", spp=16, **{**QUICK, "target_psnr": 40})
    [(_, reason)] = found.left
    assert reason.startswith("heights of a bump map: the renderings keep ")
    assert reason.endswith(" dB if they are only made smooth")


def test_progress_from_the_first_second(folder, tmp_path):
    calls = []
    scene = plain(mi, folder, {"type": "bitmap", "filename": str(folder / "photo.png")})
    show = lambda *call: calls.append(call)  # noqa: E731
    eg.convert_scene(scene, tmp_path / "new", progress=show, **QUICKEST)
    labels = list(dict.fromkeys((row.get("image"), row["stage"]) for _, _, row in calls))
    stages = [("1/1 photo.png", stage) for stage in ("rays", "target", "search")]
    assert labels == [(None, "scene"), *stages, (None, "renderings")]
    assert all(0 <= done <= total for done, total, _ in calls)


@pytest.mark.parametrize(
    ("stage", "decided", "stops"),
    [
        ("scene", 0, "by progress"),
        ("rays", 1, "by a signal"),
        ("search", 1, "by progress"),
        ("renderings", 3, "by a signal"),
    ],
)
def test_ctrl_c_writes_nothing(folder, tmp_path, stage, decided, stops):
    """The error holds the images that were decided; the second one is interrupted."""
    scene = wall(folder)

    def stop(done, total, row):
        if row["stage"] == stage and row.get("image", "2/3").startswith("2/3"):
            if stops == "by progress":
                raise KeyboardInterrupt
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(eg.Interrupted, match="nothing is written") as stopped:
        eg.convert_scene(scene, tmp_path / "new", progress=stop, **QUICKEST)
    found = stopped.value.result
    assert len([*found.textures, *found.better, *found.left]) == decided and found.psnr == []
    assert list(tmp_path.iterdir()) == []


def test_mistakes(folder, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")
    (tmp_path / "bad.xml").write_text("<scene version='3.0.0'><shape type='cube'></scene>")
    (tmp_path / "shape.xml").write_text("<shape version='3.0.0' type='cube'/>")
    before = sorted(tmp_path.rglob("*"))
    good = wall(folder)
    for scene, target, settings, error, words in (
        (good, tmp_path / "full", {}, ValueError, "exists and is not empty"),
        (good, tmp_path / "a" / "b", {}, OSError, "cannot create a file in"),
        (good, tmp_path / "new", {"target_psnr": 70}, ValueError, "target_psnr is 70"),
        (tmp_path / "bad.xml", tmp_path / "new", {}, RuntimeError, "pars"),
        (tmp_path / "shape.xml", tmp_path / "new", {}, ValueError, "holds no scene"),
        (good, "s3://x/y", {}, OSError, "cannot be written to URLs"),
    ):
        with pytest.raises(error, match=words):
            eg.convert_scene(scene, target, **settings)
        assert sorted(tmp_path.rglob("*")) == before


def test_a_link_to_a_folder_is_followed(folder, tmp_path):
    """What a killed run left beside the folder goes."""
    stale = tmp_path / ".eigengs_dr-0123456789abcdef"
    stale.mkdir()
    (stale / "photo.npz").write_bytes(b"half")
    link, real = tmp_path / "link", tmp_path / "real"
    link.symlink_to(real, target_is_directory=True)
    scene = plain(mi, folder, {"type": "bitmap", "filename": str(folder / "photo.png")})
    for make in (lambda: None, real.mkdir):
        make()
        found = eg.convert_scene(scene, link, spp=0, **QUICKEST)
        assert found.scene == link / "scene.xml" and found.scene.exists()
        assert sorted(tmp_path.iterdir()) == [link, real] and link.is_symlink()
        shutil.rmtree(real)
    real.write_text("")
    with pytest.raises(ValueError, match="link: exists and is not empty"):
        eg.convert_scene(scene, link)


def test_two_runs_into_one_folder(folder, tmp_path):
    with (
        lock_output(tmp_path / "new"),
        pytest.raises(OSError, match=r"new: process \d+ on .*; wait for its end"),
    ):
        eg.convert_scene(wall(folder), tmp_path / "new", spp=0, **QUICK)


@pytest.mark.parametrize("kind", ["file", "dictionary"])
def test_a_material_of_lights_stays(folder, tmp_path, monkeypatch, kind):
    """Its model is found beside the scene, and from the new folder."""
    lights, model = directions(8), folder / "m.npz"
    eg.Relightable.fit(photos(lights), lights, gaussians=20, planes=2, iterations=0).save(model)
    shape = '<shape type="rectangle"><bsdf type="gaussian_relightable">'
    shape += '<string name="model" value="m.npz"/></bsdf></shape></scene>'
    scene = wall(folder)
    scene.write_text(scene.read_text().replace("</scene>", shape))
    if kind == "dictionary":
        material = {"type": "gaussian_relightable", "model": str(model)}
        scene = room(mi, folder) | {"wall": {"type": "rectangle", "bsdf": material}}
    monkeypatch.chdir(tmp_path)
    found = eg.convert_scene(scene, "new", spp=0, **QUICKEST)
    monkeypatch.chdir("/")
    assert "gaussian_relightable" in (tmp_path / found.scene).read_text()
    assert np.array(mi.render(mi.load_file(str(tmp_path / found.scene)), spp=1)).mean() > 0


def test_an_error_is_no_reason_to_leave_a_bitmap(folder, tmp_path):
    with pytest.raises(ValueError, match="iterations is -1"):
        eg.convert_scene(wall(folder), tmp_path / "new", iterations=-1)
    with pytest.raises(ValueError, match="parameters are those of an XML file"):
        eg.convert_scene(room(mi, folder), tmp_path / "new", parameters={"spp": "4"})
    with pytest.raises(ValueError, match="spp is -1"):
        eg.convert_scene(wall(folder), tmp_path / "new", spp=-1)
    assert list(tmp_path.iterdir()) == []


def test_the_cornell_box(folder, tmp_path):
    found = eg.convert_scene(cornell(mi, folder), tmp_path / "new", **QUICK)
    assert len(found.textures) == 1 and min(found.psnr) >= 30
    assert found.left == []


def plain(mi, folder, texture, **others):
    """The dictionary of a wall under even light that has a texture."""
    material = {"type": "diffuse", "reflectance": texture}
    wall = {"type": "rectangle", "bsdf": material}
    return {**room(mi, folder), "integrator": {"type": "path"}, "cube": wall, **others}


@pytest.mark.exr
@pytest.mark.parametrize("kind", ["tensor", "bitmap"])
def test_pixels_in_memory(folder, tmp_path, kind):
    """They become sets; those that stay become files; and the scene of the caller still works."""
    light = np.array(mi.Bitmap(eg.sample("coffee")[:192:6, :192:6]), np.float32)
    given = {"data": mi.TensorXf(light)} if kind == "tensor" else {"bitmap": mi.Bitmap(light)}
    photo = {"type": "bitmap", "raw": True, "wrap_mode": "clamp", **given}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.8, np.float32))}
    scene = plain(mi, folder, photo, lamp=sky)
    found = eg.convert_scene(scene, tmp_path / "new", **QUICK)
    [texture] = found.textures
    assert texture.names == ("a bitmap in memory (cube.bsdf.reflectance)",)
    assert eg.Gaussians.load(tmp_path / "new" / texture.file).space == "linear"
    assert [name for name, _ in found.left] == ["a bitmap in memory (lamp)"]
    assert min(found.psnr) > 29
    moved = (tmp_path / "new").rename(tmp_path / "moved")
    for again in (mi.load_file(str(moved / "scene.xml")), mi.load_dict(scene)):
        named = {key.rpartition(".")[0] for key in mi.traverse(again).keys()}  # noqa: SIM118
        assert {"cube.bsdf.reflectance", "lamp"} <= named
        assert np.array(mi.render(again, spp=4)).mean() > 0.1


def test_a_dictionary_with_an_integrator_in_python(folder, tmp_path):
    photo = {"type": "bitmap", "filename": str(folder / "photo.png")}
    scene = plain(mi, folder, photo, integrator={"type": "prb", "max_depth": 3})
    found = eg.convert_scene(scene, tmp_path / "new", spp=0, **QUICK)
    assert mi.load_file(str(found.scene)).integrator().max_depth == 3
    with pytest.raises(TypeError, match="scene is loaded; give its XML file or its dictionary"):
        eg.convert_scene(mi.load_dict(scene), tmp_path / "other")
    for given in (scene, "room.xml"):
        with pytest.raises(
            TypeError, match=r"give a loaded one, by mi\.load_file or mi\.load_dict"
        ):
            eg.fit_for_scene(given, "cube.bsdf.reflectance", folder / "photo.png")


@pytest.mark.exr
def test_a_lamp_above_1_also_lights_by_what_is_hidden(folder, tmp_path):
    light = 6 * eg.sample("coffee")[:384:4, :384:4] ** 2
    mi.Bitmap(light).write(str(folder / "lamp.exr"))
    picture = {"type": "bitmap", "filename": str(folder / "lamp.exr"), "wrap_mode": "clamp"}
    at = mi.ScalarTransform4f()
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": picture}}
    board = {"type": "rectangle", "to_world": at.translate([1, 0, 0.5])}
    scene = plain(mi, folder, {"type": "rgb", "value": 0.5}, lamp=lamp, cube=board)
    found = eg.convert_scene(scene, tmp_path / "new", spp=256, **QUICK)
    [texture] = found.textures
    assert found.left == [] and min(found.psnr) > 30
    saved = eg.Gaussians.load(tmp_path / "new" / texture.file)
    assert saved.space == "radiance"
    hidden = np.s_[:, 60:]  # behind the board
    power = eg.render(saved).numpy()[hidden].mean() / light[hidden].mean()
    assert power == pytest.approx(1, abs=0.03)


def test_a_soft_mask_and_what_shows_through_it(folder, tmp_path):
    y, x = np.mgrid[:64, :64] / 64
    eg.save_image(folder / "veil.png", np.clip(1.1 - 2 * np.hypot(x - 0.5, y - 0.5), 0, 1))
    veil = {"type": "bitmap", "filename": str(folder / "veil.png"), "raw": True}
    photo = {"type": "bitmap", "filename": str(folder / "photo.png"), "wrap_mode": "clamp"}
    grey = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    curtain = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 1]).scale(2),
        "bsdf": {"type": "mask", "opacity": veil, "bsdf": grey},
    }
    scene = plain(mi, folder, photo, curtain=curtain)
    found = eg.convert_scene(scene, tmp_path / "new", **QUICK)
    assert found.left == []
    assert {t.file for t in found.textures} == {"photo.npz", "veil.npz"}
    assert min(found.psnr) > 31


@pytest.mark.exr
def test_meshes_in_memory_are_refused(folder, tmp_path):
    scene = room(mi, folder)
    scene["cube"] = mi.load_dict({"type": "ply", "filename": str(folder / "cube.ply")})
    veil = {"type": "bitmap", "data": mi.TensorXf(np.full((2, 2, 1), 0.5, np.float32))}
    scene["wall"] = {
        "type": "rectangle",
        "bsdf": {"type": "mask", "opacity": veil, "bsdf": {"type": "diffuse"}},
    }
    with pytest.raises(
        ValueError, match=r"cannot be written as XML .*; give meshes and volumes by files"
    ):
        eg.convert_scene(scene, tmp_path / "new", spp=0, **QUICK)
    assert not list(tmp_path.iterdir())


def test_files_are_found_as_mitsuba_finds_them(folder, tmp_path):
    """In the folders of <path>, beside the scene, and beside the file that a link names."""
    parts = tmp_path / "scenes" / "parts"
    parts.mkdir(parents=True)
    for name in ("photo.png", "normals.png", "rough.png"):
        shutil.copy(folder / name, parts)
    shutil.copy(folder / "normals.png", tmp_path / "scenes" / "photo.png")  # the path goes first
    text = wall(folder).read_text().replace("<integrator", '<path value="parts"/><integrator')
    scene = tmp_path / "scenes" / "wall.xml"
    scene.write_text(text)
    before = list(mi.file_resolver())
    found = eg.convert_scene(scene, tmp_path / "new", spp=0, **QUICKEST)
    assert list(mi.file_resolver()) == before
    [photo] = [t for t in found.textures if t.file == "photo.npz"]
    seen = eg.render(eg.Gaussians.load(tmp_path / "new" / photo.file)).numpy().mean(axis=(0, 1))
    expected = np.array(mi.Bitmap(str(folder / "photo.png")).convert(srgb_gamma=False))
    assert seen == pytest.approx((expected / 255).mean(axis=(0, 1)), abs=0.1)
    assert np.array(mi.render(mi.load_file(str(found.scene)), spp=1)).mean() > 0
    link = tmp_path / "link.xml"
    link.symlink_to(scene)
    eg.convert_scene(link, tmp_path / "other", spp=0, **QUICKEST)


def test_a_dictionary_with_resources_and_no_integrator(folder, tmp_path):
    scene = plain(mi, folder, {"type": "bitmap", "filename": "photo.png"})
    scene = {"parts": {"type": "resources", "path": str(folder)}, **scene}
    del scene["integrator"]
    found = eg.convert_scene(scene, tmp_path / "new", **QUICK)
    assert len(found.textures) == 1 and min(found.psnr) > 25


@pytest.mark.parametrize("name", ["wood.<UDIM>.png", "wood.%(UDIM)d.png"])
def test_tiles_are_named(folder, tmp_path, name):
    scene = plain(mi, folder, {"type": "bitmap", "filename": name})
    with pytest.raises(ValueError, match="stands for UDIM tiles, and Mitsuba reads one image"):
        eg.convert_scene(scene, tmp_path / "new")


def sets_in_memory():
    """Textures that a dictionary may hold: a set, one of one channel, and a model."""
    model = {"type": "gaussian_texture", "model": str(SHIPPED["natural"])}
    some = np.random.default_rng(1).normal(0, 2, (3, 230)).astype(np.float32)
    turned = mi.Transform4f().rotate([0, 0, 1], 20)
    return [
        texture_of(gaussians("linear"), wrap_mode="mirror", to_uv=turned),
        texture_of(gaussians("data", channels=1)),
        {**model, "coefficients": mi.TensorXf(some)},
        model,
    ]


@pytest.mark.parametrize("kind", range(4))
def test_sets_that_are_there_already_stay(folder, tmp_path, kind):
    """Beside bitmaps that become sets; the scene of the caller still works."""
    scene = plain(mi, folder, sets_in_memory()[kind])
    found = eg.convert_scene(scene, tmp_path / "new", spp=4)
    assert found.textures == [] and found.psnr[0] > 80
    moved = (tmp_path / "new").rename(tmp_path / "moved")
    if "filename" in (moved / "scene.xml").read_text():
        again = mi.render(mi.load_file(str(moved / "scene.xml")), spp=4)
        assert np.isfinite(np.array(again)).all()
    mi.load_dict(scene)
