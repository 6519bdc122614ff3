"""Files of models: what is saved comes back, and whatever else is there is refused in one line."""

import zipfile

import numpy as np
import pytest
from numpy.lib import format as npy
from test_training import SMALL, random_fields

from eigengs_dr.eigenbasis import model_file as modelfile
from eigengs_dr.eigenbasis.eigengs import EigenGS
from eigengs_dr.eigenbasis.training import TrainOptions, train
from eigengs_dr.storage import npz as archive

REALS = [key for key, field in modelfile.LAYOUT.items() if field.kind[0] == "f"]
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
