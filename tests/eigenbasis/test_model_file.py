"""Files of models: what is saved comes back, and whatever else is there is refused in one line."""

import zipfile

import numpy as np
import pytest
from numpy.lib import format as npy

import eigengs_dr as eg
from _helpers.command import said
from _helpers.families import family, fidelity, rendered, small_basis, small_model, splits
from _helpers.photos import SMALL, random_fields
from eigengs_dr.eigenbasis import model_file as modelfile
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.eigenbasis.options import TrainOptions
from eigengs_dr.eigenbasis.training import train
from eigengs_dr.storage import npz as archive

NUMBERS = [key for key, field in modelfile.LAYOUT.items() if field.kind != "U"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    photos = random_fields(folder / "photos", 12)
    settings = TrainOptions(**SMALL, frequency_aware=True)
    return train(photos, folder / "model.npz", settings).model


@pytest.fixture(scope="module")
def members(model):
    return modelfile.to_members(model)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.npz"


def refusal(path):
    """The one line that a file is refused with."""
    with pytest.raises(ValueError) as caught:
        EigenGS.load(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    return str(caught.value)


def write(path, members, version=modelfile.VERSION, name=modelfile.FORMAT):
    archive.write(path, name, version, members)


def test_round_trip(model, path):
    model.save(path)
    loaded = EigenGS.load(path)
    assert (loaded.low, loaded.low_components) == (model.low, model.low_components) == (6, 3)
    assert loaded.components == model.components
    for name, array in model.gaussians.to_arrays().items():
        np.testing.assert_array_equal(loaded.gaussians.to_arrays()[name], array)
    for c in range(3):
        largest = np.abs(model.weights[c]).max(axis=1, keepdims=True)
        assert (np.abs(loaded.weights[c] - model.weights[c]) <= largest * 2**-11).all()
        np.testing.assert_array_equal(loaded.eigenvalues[c], model.eigenvalues[c])
    np.testing.assert_allclose(loaded.mean_image, model.mean_image, rtol=2**-11)


def test_saving_twice_gives_the_same_bytes_of_arrays(model, path):
    model.save(path)
    again = path.with_name("again.npz")
    EigenGS.load(path).save(again)
    with np.load(path) as first, np.load(again) as second:
        for key in first.files:
            np.testing.assert_array_equal(first[key], second[key])


@pytest.mark.parametrize("key", modelfile.LAYOUT)
def test_missing_key(members, path, key):
    write(path, {k: v for k, v in members.items() if k != key})
    assert f"key '{key}' is missing" in refusal(path)


@pytest.mark.parametrize(
    "key", [k for k, field in modelfile.LAYOUT.items() if field.kind[0] == "f"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(members, path, key, value):
    array = members[key].copy()
    array.flat[-1] = value
    write(path, {**members, key: array})
    assert f"{key} holds values that are not finite" in refusal(path)


@pytest.mark.parametrize("key", NUMBERS)
def test_arrays_of_another_type_or_dimension(members, path, key):
    for array in (members[key].astype(np.int32), members[key][None]):
        write(path, {**members, key: array})
        assert f"key '{key}' is " in refusal(path)


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("weights1", lambda a: a[:, :-1]),
        ("weights1", lambda a: a[:-1]),
        ("weights1", lambda a: a[:, :0]),
        ("scale2", lambda a: a[:-1]),
        ("eigenvalues0", lambda a: a[:-1]),
        ("mean_image", lambda a: a[:, :-1]),
        ("mean_image", lambda a: a[:1]),
        ("mean", lambda a: a[:-1]),
        ("mean", lambda a: a[:0]),
        ("factor", lambda a: -a),
        ("color", lambda a: a[:, :1]),
        ("background", lambda a: a[:2]),
        ("size", lambda a: -a),
        ("size", lambda a: 0 * a),
        ("size", lambda a: a + 1),
        ("size", lambda a: a + (1 << 40)),
        ("size", lambda a: np.append(a, 1)),
        ("split", lambda a: np.append(a, 1)),
        ("split", lambda a: np.array([60, 3])),
        ("split", lambda a: np.array([-1, 3])),
        ("split", lambda a: np.array([6, -1])),
        ("split", lambda a: np.array([6, 1 << 40])),
        ("space", lambda a: np.array("data")),
        ("space", lambda a: np.array("linear")),
        ("space", lambda a: np.array("")),
        ("space", lambda a: np.array("x" * 100)),
    ],
)
def test_arrays_that_do_not_fit(members, path, key, change):
    changed = members[key].dtype.type(change(members[key])) if key != "space" else change(None)
    write(path, {**members, key: changed})
    refusal(path)


@pytest.mark.filterwarnings("ignore:overflow")
def test_weights_beyond_single_precision(members, path):
    weights, scale = members["weights0"].copy(), members["scale0"].copy()
    weights[0, 0], scale[0] = 6e4, 3e38
    write(path, {**members, "weights0": weights, "scale0": scale})
    refusal(path)


def test_four_channels(members, path):
    color = np.pad(members["color"], ((0, 0), (0, 1)))
    changed = {"space": np.array("rgb"), "color": color, "background": np.zeros(4, np.float32)}
    write(path, {**members, **changed})
    refusal(path)


@pytest.mark.parametrize("shape", [(1 << 20, 61), (1 << 40, 1 << 40), (6, 62)])
def test_headers_that_lie(members, path, shape):
    rest = {key: array for key, array in members.items() if key != "weights0"}
    write(path, rest)
    with zipfile.ZipFile(path, "a") as file, file.open("weights0.npy", "w") as member:
        header = {"descr": "<f2", "fortran_order": False, "shape": shape}
        npy.write_array_header_1_0(member, header)
        member.write(members["weights0"].tobytes())
    assert "weights0" in refusal(path)


@pytest.mark.parametrize("keep", [0, 10, 0.3, 0.7, 0.99])
def test_truncated(model, path, keep):
    model.save(path)
    content = path.read_bytes()
    path.write_bytes(content[: keep if isinstance(keep, int) else int(keep * len(content))])
    refusal(path)


def test_other_formats_and_versions(members, model, path):
    write(path, members, version=modelfile.VERSION + 1)
    assert "upgrade" in refusal(path)
    model.gaussians.save(path)
    assert "format is 'eigengs_dr.gaussians'" in refusal(path)
    np.savez(path, a=np.zeros(3))
    assert "key 'format' is missing" in refusal(path)


def test_an_existing_file_stays_where_a_model_cannot_be_written(model, path, monkeypatch):
    path.write_bytes(b"earlier")

    def full(*arguments, **members):
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="no space"):
        model.save(path)
    assert [(p, p.read_bytes()) for p in path.parent.iterdir()] == [(path, b"earlier")]


@pytest.fixture(scope="module")
def others():
    """Images of the family that were not trained on."""
    return family(8, seed=1)


@splits
def test_save_and_load(backend, split, others, tmp_path):
    """Half precision costs nothing that can be seen."""
    model = small_model(backend, split)
    model.save(tmp_path / "model.npz")
    again = eg.EigenGS.load(tmp_path / "model.npz", backend=backend)
    assert (again.low, again.low_components) == (model.low, model.low_components)
    assert again.gaussians.space == model.gaussians.space
    for one, two in zip(again.weights, model.weights, strict=True):
        np.testing.assert_allclose(one, two, atol=6e-4 * np.abs(two).max())
    for one, two in zip(again.eigenvalues, model.eigenvalues, strict=True):
        np.testing.assert_array_equal(one, two)
    for colors in ("exact", "projected"):
        first, second = (fidelity(rendered(m, others, colors), others) for m in (model, again))
        assert second == pytest.approx(first, abs=0.01)


def test_half_precision_of_extreme_weights(backend, tmp_path):
    """Scaled by component: neither tiny nor huge ones are lost."""
    basis, model = small_basis(), small_model(backend)
    weights = tuple(w * s for w, s in zip(model.weights, (1e-9, 1e3, 0), strict=True))
    odd = eg.EigenGS(model.gaussians, weights, basis.eigenvalues, basis.mean)
    odd.save(tmp_path / "odd.npz")
    for one, two in zip(eg.EigenGS.load(tmp_path / "odd.npz").weights, weights, strict=True):
        np.testing.assert_allclose(one, two, atol=6e-4 * np.abs(two).max())


def test_models_keep_how_the_error_falls(trained):
    folder, result = trained
    loaded = eg.EigenGS.load(folder / "model.npz")
    np.testing.assert_array_equal(
        loaded.truncation_curve().psnr, result.basis.truncation_curve().psnr
    )
    np.testing.assert_array_equal(loaded.held_out, result.model.held_out)
    assert loaded.split_reason == "32 pixels a side; auto measures from 512 on"
    assert len(loaded.held_out) == 19
    assert loaded.held_out[-1] == pytest.approx(result.figures["psnr_pca"], abs=1e-3)


def test_files_of_version_1_are_read(trained, tmp_path):
    _, result = trained
    old = {key: modelfile.to_members(result.model)[key] for key in modelfile.LAYOUT_V1}
    archive.write(tmp_path / "old.npz", modelfile.FORMAT, 1, old)
    loaded = eg.EigenGS.load(tmp_path / "old.npz")
    assert (
        loaded.truncation_curve() is None
        and len(loaded.held_out) == 0
        and loaded.split_reason == ""
    )
    for one, two in zip(
        loaded.weights, eg.EigenGS.load(saved(result, tmp_path)).weights, strict=True
    ):
        np.testing.assert_array_equal(one, two)
    loaded.save(tmp_path / "again.npz")
    assert eg.EigenGS.load(tmp_path / "again.npz").truncation_curve() is None
    told = said("info", tmp_path / "old.npz")
    assert "variance" not in told and "split_reason" not in told
    archive.write(tmp_path / "cut.npz", modelfile.FORMAT, 2, old)
    with pytest.raises(ValueError, match="key 'variance' is missing"):
        eg.EigenGS.load(tmp_path / "cut.npz")


def saved(result, folder):
    result.model.save(folder / "new.npz")
    return folder / "new.npz"


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("variance", lambda a: a[:2], "variance has shape"),
        ("variance", lambda a: 0 * a, "more than variance 0"),
        ("variance", lambda a: -a, "more than variance 0"),
        ("held_out", lambda a: a[:-1], "held_out has shape"),
        ("held_out", lambda a: a[::-1], "held_out must ascend"),
        ("held_out", lambda a: a + 1e6, "held_out must ascend"),
        ("held_out", lambda a: a - 1e6, "held_out must ascend"),
        ("split_reason", lambda a: np.array("\x1b[2J"), "not printed"),
        ("split_reason", lambda a: np.array("a\nb"), "not printed"),
        ("split_reason", lambda a: np.array("x" * 100), "over 64 characters"),
    ],
)
def test_hostile_values(trained, tmp_path, key, change, words):
    known = modelfile.to_members(trained[1].model)
    path = tmp_path / "bad.npz"
    archive.write(path, modelfile.FORMAT, 2, {**known, key: change(known[key])})
    with pytest.raises(ValueError, match=words) as caught:
        eg.EigenGS.load(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
