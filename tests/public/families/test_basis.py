"""The eigenbasis: against scikit-learn, of families of every kind, from sources of every kind."""

import threading
import warnings
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import eigengs_dr as eg
from _helpers.errors import one_line, refused
from _helpers.low_rank import HEIGHT, PIXELS, SIZE, WIDTH, assert_same, basis_of, family, planes


def flat(components):
    return components.reshape(len(components), components.shape[1] * components.shape[2])


def assert_orthonormal(basis):
    for components in basis.components:
        rows = flat(components).astype(np.float64)
        np.testing.assert_allclose(rows @ rows.T, np.eye(len(rows)), rtol=0, atol=1e-5)


def subspace_angle(a, b):
    """Largest angle, in radians, between the spans of orthonormal rows."""
    a, b = (np.linalg.qr(rows.astype(np.float64).T)[0] for rows in (a, b))
    return np.linalg.norm(a - b @ (b.T @ a), 2)


def check_exact(basis, images, angle):
    """Check a basis of as many components a channel as it was asked for."""
    from sklearn.decomposition import PCA  # here, because it takes a second

    assert_orthonormal(basis)
    for c, plane in enumerate(np.moveaxis(planes(images, basis.space), 1, 0)):
        rows, reference = flat(basis.components[c]), PCA(svd_solver="full").fit(plane)
        # scikit-learn divides by m - 1, the paper by m.
        variances = reference.explained_variance_ * (1 - 1 / len(images))
        np.testing.assert_allclose(basis.mean[c].ravel(), reference.mean_, rtol=0, atol=1e-7)
        np.testing.assert_allclose(basis.eigenvalues[c], variances[: len(rows)], rtol=1e-5)
        np.testing.assert_allclose(basis.variance[c], variances.sum(), rtol=1e-6)
        assert subspace_angle(rows, reference.components_[: len(rows)]) < angle


@pytest.mark.parametrize("space", ["ycbcr", "rgb"])
def test_components_are_those_of_scikit_learn(space):
    images = family()
    basis = eg.Eigenbasis.from_images(images, SIZE, 12, space=space)
    assert (basis.width, basis.height, len(basis.components)) == (*SIZE, 3)
    assert (basis.count, basis.space) == (60, space)
    assert basis.mean.dtype == basis.components[0].dtype == np.float32
    assert basis.eigenvalues[0].dtype == basis.variance.dtype == np.float64
    check_exact(basis, images, 1e-4)


@pytest.mark.parametrize("count", [1030, 2100])
def test_many_images_in_blocks_and_shards_are_exact_while_the_rank_suffices(count):
    images = family(count, noise=0, directions=8)
    check_exact(eg.Eigenbasis.from_images(images, SIZE, 8), images, 1e-3)


def test_rows_stay_orthonormal_when_variances_differ_much():
    """What rounding mixes into small components is as large as they are."""
    rng = np.random.default_rng(0)
    spread = np.logspace(-1, -4.5, 30)
    directions = np.linalg.qr(rng.normal(size=(PIXELS, 30)))[0].T * np.sqrt(PIXELS)
    grey = (0.5 + (rng.normal(size=(1100, 30)) * spread) @ directions).clip(-0.4, 1.4)
    images = np.repeat(grey.reshape(-1, HEIGHT, WIDTH, 1), 3, axis=3).astype(np.float32)
    assert_orthonormal(eg.Eigenbasis.from_images(images, SIZE, 30, space="rgb"))


# --- Families of every kind ---


def test_energy_keeps_as_few_as_hold_it():
    images = family()
    full = eg.Eigenbasis.from_images(images, SIZE, 59)
    for shares in full.energy():
        assert (np.diff(shares) >= 0).all() and shares[-1] == pytest.approx(1, abs=1e-5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        basis = eg.Eigenbasis.from_images(images, SIZE, energy=0.9)
        whole = eg.Eigenbasis.from_images(family(20, noise=0, directions=5), SIZE, energy=1)
    for shares, all_shares in zip(basis.energy(), full.energy(), strict=True):
        k = len(shares)
        assert shares[-1] >= 0.9 and (k == 1 or shares[-2] < 0.9)
        np.testing.assert_allclose(shares, all_shares[:k], rtol=1e-6)
    assert [len(c) for c in whole.components] == [5, 5, 5]


def test_energy_beyond_the_cap_is_told_by_channel():
    with pytest.warns(UserWarning) as caught:
        basis = eg.Eigenbasis.from_images(family(), SIZE, (3, 59, 59), energy=0.99)
    (message,) = (str(w.message) for w in caught)
    share = basis.energy()[0][-1]
    assert message == (
        f"channel Y: 3 components hold {share:.2%} of the variance, less than 99.00%; "
        "raise components"
    )
    assert len(basis.components[0]) == 3 < len(basis.components[1])


def test_truncated_is_what_fewer_components_give():
    basis = eg.Eigenbasis.from_images(family(), SIZE, 12)
    few = basis.truncated((5, 3, 100))
    assert [len(c) for c in few.components] == [len(e) for e in few.eigenvalues] == [5, 3, 12]
    np.testing.assert_array_equal(few.components[1], basis.components[1][:3])
    for three in (np.int64(3), [3, 3, 3], np.array([3, 3, 3])):
        assert [len(c) for c in basis.truncated(three).components] == [3, 3, 3]


def test_grey_images_have_no_chroma_components():
    grey = family()[..., :1].repeat(3, axis=3)
    basis = eg.Eigenbasis.from_images(grey, SIZE, 5)
    assert [len(c) for c in basis.components] == [5, 0, 0]
    np.testing.assert_allclose(basis.mean[1:], 128 / 255, atol=1e-6)
    result = basis.reconstruct(basis.project(grey[0]))
    np.testing.assert_allclose(result, result[..., :1].repeat(3, axis=2), atol=1e-5)


@pytest.mark.parametrize(("count", "copies"), [(1, 1), (12, 1), (1, 50), (5, 10)])
def test_few_images_are_spanned(count, copies):
    """Directions of copies that are nothing but rounding are not taken for components."""
    images = np.tile(family(count), (copies, 1, 1, 1))
    told = pytest.warns(UserWarning, match=f"{count} images? gives? at most {count - 1} components")
    with told if copies == 1 else nullcontext():
        basis = eg.Eigenbasis.from_images(images, SIZE, 20)
    assert [len(c) for c in basis.components] == [len(e) for e in basis.energy()] == [count - 1] * 3
    assert_orthonormal(basis)
    for image in images[:count]:
        np.testing.assert_allclose(basis.reconstruct(basis.project(image)), image, atol=5e-5)


# --- Sources ---


def write(folder, images):
    for i, image in enumerate(images):
        eg.save_image(folder / f"{i:03}.png", image)
    return sorted(folder.iterdir())


def reused(images):
    """A source that overwrites an array of three images when the next one is requested."""
    buffer = np.empty_like(images[:3])
    for part in np.split(images, len(images) // 3):
        buffer[:] = part
        yield buffer


def test_every_source_gives_the_same_bits(tmp_path):
    images = np.rint(family(30).clip(0, 1) * 255).astype(np.uint8)
    files = write(tmp_path, images)
    first = eg.Eigenbasis.from_images(images, SIZE, 5)
    for source in (
        tmp_path,
        str(tmp_path),
        [str(file) for file in files],
        iter(files),
        np.stack([eg.load_image(file) for file in files]),
        list(images),
        reused(images),
        [*files[:5], images[5:6], images[6], images[7:]],
    ):
        assert_same(eg.Eigenbasis.from_images(source, SIZE, 5), first)


def test_progress_counts_every_image_and_an_interruption_leaves_no_thread(tmp_path):
    files = write(tmp_path, family(12))
    files[1].write_bytes(b"")
    calls = []
    with pytest.warns(UserWarning, match="1 of 12 images were skipped"):
        for source in (tmp_path, [files[0], family(11)], iter(files)):
            eg.Eigenbasis.from_images(source, SIZE, 2, progress=lambda *call: calls.append(call))
    expected = [(done, total, {}) for total in (12, 12, None) for done in range(1, 13)]
    assert calls == expected

    def interrupt(done, total, row):
        if done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        eg.Eigenbasis.from_images(tmp_path, SIZE, 2, progress=interrupt)
    assert not [t for t in threading.enumerate() if t.name.startswith("decode")]


def test_an_iterator_is_read_but_a_little_ahead():
    """Images that wait take 32 MB: here 42 of them."""
    given, ahead = [], []

    def images():
        for value in np.linspace(0, 1, 60):
            given.append(value)
            yield np.full((256, 256, 3), value, np.float32)

    def progress(done, *_):
        ahead.append(len(given) - done)

    eg.Eigenbasis.from_images(images(), (256, 256), 1, progress=progress)
    assert 1 < max(ahead) < 50


def test_files_that_cannot_be_read_are_named_and_skipped(tmp_path):
    images = family(9)
    files = write(tmp_path, images)
    files[0].write_bytes(b"")
    files[1].write_bytes(b"no image")
    files[4].write_bytes(files[4].read_bytes()[:60])
    files[7].unlink()  # vanished since it was listed
    with pytest.warns(UserWarning) as caught:
        basis = eg.Eigenbasis.from_images(files, SIZE, 2)
    (message,) = (str(w.message) for w in caught)
    assert message.startswith("4 of 9 images were skipped: 000.png (the file is empty (0 bytes)),")
    assert "001.png (not an image that Pillow knows)" in message and message.endswith(", ...")
    assert "\n" not in message and str(tmp_path) not in message
    assert basis.count == 5
    for path in tmp_path.iterdir():
        path.write_text("no image")
    with pytest.raises(eg.ImageError, match="none of 8 images"):
        eg.Eigenbasis.from_images(tmp_path, SIZE, 4)


@pytest.mark.parametrize(
    ("source", "complaint"),
    [
        ([], "holds no images"),
        (np.zeros((0, 5, 6, 3)), "holds no images"),
        (iter([]), "holds no images"),
        (np.zeros((5, 6)), r"got shape \(5, 6\), expected \(n, H, W, 3\)"),
        ([None], "got NoneType"),
        ([[1, 2]], "got list"),
        ([family(2), np.zeros((2, 5, 6, 4))], "image 2 of the source: .* drop alpha"),
        (np.full((1, 5, 6, 3), 255.0), "image 0 of the source: .* divide by 255"),
        (np.full((1, 5, 6, 3), np.nan), "image 0 of the source: 30 of 30 pixels are not finite"),
    ],
)
def test_what_is_no_family(source, complaint):
    with refused(eg.ImageError, complaint):
        eg.Eigenbasis.from_images(source, SIZE, 1)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"components": -1}, "components is -1; expected no negative"),
        ({"components": (1, 2)}, r"components is \(1, 2\); expected a number, or three"),
        ({"components": 1.5}, "components is 1.5; expected"),
        ({"energy": 0}, "energy is 0.0; expected a share"),
        ({"energy": float("nan")}, "energy is nan; expected a share"),
        ({"space": "linear"}, "'linear' is unknown; use one of"),
        *(({"size": size}, "size is") for size in [(0, 3), 4, (4,), (4.5, 4), "ab", None]),
    ],
)
def test_bad_arguments_are_refused_before_an_image_is_read(options, complaint):
    def never():
        raise AssertionError
        yield

    with refused(ValueError, complaint):
        eg.Eigenbasis.from_images(never(), **{"size": SIZE, **options})


# --- Images of other sizes ---


def resized(image, width, height):
    """What a family takes of an image: the mean of a family of one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        basis = eg.Eigenbasis.from_images([image], (width, height), 0, space="rgb")
    return np.moveaxis(basis.mean, 0, 2)


sizes = st.tuples(st.integers(1, 40), st.integers(1, 40))


@settings(max_examples=30)
@given(start=sizes, end=sizes, value=st.floats(-0.375, 1.375, width=32))
def test_resizing_keeps_constants_and_the_same_size(start, end, value):
    result = resized(np.full((*start, 3), value, np.float32), *end)
    assert result.dtype == np.float32 and result.shape == (end[1], end[0], 3)
    np.testing.assert_allclose(result, value, atol=1e-6)
    image = np.random.default_rng(0).random((*start, 3), np.float32)
    np.testing.assert_allclose(resized(image, *start[::-1]), image, atol=1e-7)


def test_cropping_takes_the_centre_undistorted():
    ramp = np.linspace(0, 1, 30, dtype=np.float32)
    image = np.stack([*np.meshgrid(ramp, ramp[:20]), np.zeros((20, 30), np.float32)], axis=2)
    result = resized(image, 10, 10)
    assert np.ptp(result[..., 0], axis=0).max() < 1e-5 > np.ptp(result[..., 1], axis=1).max()
    assert result[0, 0, 0] == pytest.approx(5.5 / 29, abs=0.01)  # five columns are cut off
    assert result[:, ::-1, 0] + result[..., 0] == pytest.approx(1, abs=1e-5)
    noise = np.random.default_rng(0).random((20, 31, 3)).astype(np.float32)
    turned = resized(noise.transpose(1, 0, 2), 7, 9)
    np.testing.assert_allclose(resized(noise, 9, 7).transpose(1, 0, 2), turned, atol=1e-6)
    mirrored = resized(noise[:, ::-1], 10, 10)[:, ::-1]
    np.testing.assert_allclose(mirrored, resized(noise, 10, 10), atol=1e-5)


# --- Projecting ---


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_projecting_twice_is_projecting_once_and_brings_no_image_away(seed):
    basis = basis_of("rgb")
    image = np.random.default_rng(seed).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    once = basis.reconstruct(basis.project(image))
    np.testing.assert_allclose(basis.reconstruct(basis.project(once)), once, atol=2e-5)
    mean = np.moveaxis(basis.mean, 0, 2)
    left, moved = np.sum((image - once) ** 2), np.sum((once - mean) ** 2)
    assert left + moved == pytest.approx(np.sum((image - mean) ** 2), rel=1e-4)  # Pythagoras


def test_images_of_any_size_and_type_are_projected():
    basis = basis_of("rgb")
    large = family(1, size=(28, 22))[0]
    for a, b in zip(basis.project(large), basis.project(resized(large, *SIZE)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    assert len(basis.project(np.zeros((4, 4), np.uint8))[0]) == 12
    with pytest.raises(eg.ImageError, match="not finite"):
        basis.project(np.full((4, 4), np.nan))


def test_coefficients_of_another_basis_are_refused():
    for weights in ([np.zeros(12)] * 3, [np.zeros(12)], [np.zeros((12, 1)), np.zeros(5), 0]):
        with pytest.raises(ValueError, match="coefficients have shapes") as error:
            basis_of("rgb").reconstruct(weights)
        one_line(error)
