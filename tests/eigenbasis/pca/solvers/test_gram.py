"""The exact solver: against scikit-learn and the incremental one, by parts, and its limit."""

import numpy as np
import pytest
from sklearn.decomposition import PCA

from _helpers.errors import one_line
from _helpers.low_rank import SIZE, assert_same, family, planes
from eigengs_dr.backend.executor import Done
from eigengs_dr.eigenbasis.pca.basis import Eigenbasis
from eigengs_dr.eigenbasis.pca.solvers import eigenpairs, gram, plane_store, store_images
from eigengs_dr.image.io import ImageError, save_image


@pytest.fixture(params=["whole", "parts"])
def parts(request, monkeypatch):
    """One file, tile and strip of everything; or files of 7 images, tiles of 14, strips of 40."""
    if request.param == "parts":
        monkeypatch.setattr(plane_store, "FILE_IMAGES", 7)
        monkeypatch.setattr(gram, "TILE_IMAGES", 14)
        monkeypatch.setattr(plane_store, "COLUMNS", 40)


def by_gram(images, components, **options):
    return Eigenbasis.from_images(images, SIZE, components, solver="gram", **options)


def assert_is_pca(basis, images, components, space="ycbcr"):
    """Equal to scikit-learn in double precision; single precision gives 1e-5 of the largest."""
    count = len(images)
    for c in range(3):
        channel = planes(images, space)[:, c].astype(np.float64)
        expected = PCA(components, svd_solver="full").fit(channel)
        values = expected.explained_variance_ * (count - 1) / count
        np.testing.assert_allclose(basis.mean[c].ravel(), expected.mean_, atol=1e-7)
        np.testing.assert_allclose(basis.eigenvalues[c], values, rtol=1e-5, atol=1e-6 * values[0])
        found = basis.components[c].reshape(components, -1)
        np.testing.assert_allclose(found, expected.components_, atol=1e-4)
        np.testing.assert_allclose(basis.variance[c], channel.var(axis=0).sum(), rtol=1e-5)


@pytest.mark.parametrize("solver", ["incremental", "gram"])
@pytest.mark.parametrize("space", ["ycbcr", "rgb"])
def test_both_solvers_are_scikit_learn_with_its_signs(solver, space):
    images = family(90, noise=0)
    basis = Eigenbasis.from_images(images, SIZE, 12, solver=solver, space=space)
    assert_is_pca(basis, images, 12, space)


def test_random_images_in_parts(parts):
    """Of noise, whose variances hardly fall, so that only the exact solver finds them in blocks."""
    rng = np.random.default_rng(0)
    images = rng.random((60, SIZE[1], SIZE[0], 3), np.float32)
    assert_is_pca(by_gram(images, 20), images, 20)


def test_solvers_agree(parts):
    """More images than a quarter of the components, and fewer; the same examples."""
    for count, components in ((80, 5), (40, 30)):
        images = family(count, directions=40)
        expected = Eigenbasis.from_images(images, SIZE, components)
        basis = by_gram(images, components)
        np.testing.assert_array_equal(basis.examples, expected.examples)
        np.testing.assert_allclose(basis.mean, expected.mean, atol=1e-7)
        for c in range(3):
            values = expected.eigenvalues[c]
            np.testing.assert_allclose(basis.eigenvalues[c], values, atol=1e-6 * values[0])
            np.testing.assert_allclose(basis.components[c], expected.components[c], atol=2e-3)
            flat = basis.components[c].reshape(components, -1).astype(np.float64)
            np.testing.assert_allclose(flat @ flat.T, np.eye(components), atol=1e-5)


def test_families_without_so_many_components(parts):
    few = family(12)
    with pytest.warns(UserWarning, match="12 images give at most 11 components"):
        basis = by_gram(few, 300)
    assert [len(c) for c in basis.components] == [11, 11, 11]
    for image in few:
        np.testing.assert_allclose(basis.reconstruct(basis.project(image)), image, atol=5e-5)
    copies = by_gram(family(5)[np.arange(50) % 5], 20)
    assert [len(c) for c in copies.components] == [4, 4, 4]
    low = by_gram(family(60, directions=3, noise=0), 20)
    assert [len(c) for c in low.components] == [3, 3, 3]
    equal = by_gram(np.stack([few[0]] * 30), 5, energy=0.9)
    assert [len(c) for c in equal.components] == [0, 0, 0]
    with pytest.warns(UserWarning, match="1 image gives at most 0 components"):
        one = by_gram(few[0], 5)
    np.testing.assert_allclose(one.reconstruct(one.project(few[0])), few[0], atol=1e-5)
    assert [len(c) for c in by_gram(few, (3, 0, 1)).components] == [3, 0, 1]


class Backwards:
    """An executor that ends tasks in the wrong order."""

    workers = 3

    def __init__(self):
        self.done = []

    def map(self, function, tasks, shared=None, at_once=None):
        for index, task in reversed(list(enumerate(tasks))):
            self.done.append(function.__name__)
            yield Done(index, function(task, shared))


def test_the_order_of_the_work_changes_no_bit(parts, tmp_path):
    images, executor = family(50), Backwards()
    expected = by_gram(images, 9)
    options = {"client": executor, "checkpoint": tmp_path}
    assert_same(by_gram(images, 9, **options), expected)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert before and set(executor.done) == {
        "store_batch", "compute_tile", "find_eigenpairs", "combine_strip"
    }  # fmt: skip
    assert_same(by_gram(images, 9, **options), expected)  # of the files that are there
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match="on a cluster, pass as checkpoint a folder") as error:
        by_gram(images, 9, client=Backwards())
    one_line(error)


def test_sources_of_every_kind(parts, tmp_path):
    images = np.rint(family(30).clip(0, 1) * 255).astype(np.uint8)
    (folder := tmp_path / "photos").mkdir()
    for i, image in enumerate(images):
        save_image(folder / f"{i:03}.png", image)
    expected = by_gram(images, 5)
    steps = []
    found = by_gram(folder, 5, progress=lambda done, total, row: steps.append((done, total)))
    assert_same(found, expected)
    assert steps == [(k + 1, 30) for k in range(30)]
    assert_same(by_gram(iter(np.split(images, 10)), 5), expected)
    (folder / "004.png").write_text("no image")
    without = by_gram(np.delete(images, 4, axis=0), 5)
    with pytest.warns(UserWarning, match="1 of 30 images were skipped"):
        fewer = by_gram(folder, 5)
    np.testing.assert_allclose(fewer.eigenvalues[0], without.eigenvalues[0], rtol=1e-5)
    (tmp_path / "work").mkdir()
    options = {"client": Backwards(), "checkpoint": tmp_path / "work"}
    with pytest.warns(UserWarning, match=r"images were skipped: 004\.png"):
        assert_same(by_gram(folder, 5, **options), fewer)
    for path in folder.iterdir():
        path.write_text("no image")
    (tmp_path / "none").mkdir()
    options = {"client": Backwards(), "checkpoint": tmp_path / "none"}
    with pytest.warns(UserWarning), pytest.raises(ImageError, match="none of 30 images"):
        by_gram(folder, 5, **options)


def test_a_dask_array_is_read_once(parts):
    array = pytest.importorskip("dask.array")
    images, read = family(30), []

    def part(block_info=None):
        first, last = block_info[None]["array-location"][0]
        read.append((first, last))
        return images[first:last]

    lazy = array.map_blocks(
        part, chunks=((13, 13, 4), SIZE[1], SIZE[0], 3), dtype=np.float32, meta=images[:0]
    )
    assert_same(by_gram(lazy, 5), by_gram(images, 5))
    assert read == [(0, 13), (13, 26), (26, 30)]


def test_too_many_images_are_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(store_images, "MAX_IMAGES", 20)
    for source, options in (
        (family(21), {}),
        (iter(family(21)), {}),
        (family(21), {"client": Backwards(), "checkpoint": tmp_path}),
    ):
        with pytest.raises(ValueError, match=r"takes up to 20 images, .* 'incremental'") as error:
            by_gram(source, 5, **options)
        one_line(error)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="solver 'svd' is unknown; use one of incremental, gram"):
        Eigenbasis.from_images(family(3), SIZE, solver="svd")


def test_few_eigenvalues_are_those_of_all():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(80, 100)) * 0.9 ** np.arange(100)
    all_values = np.linalg.eigvalsh(rows @ rows.T)[::-1]
    for most in (5, 40):
        values, weights, dropped = eigenpairs.largest_eigenpairs(rows @ rows.T, most, 0)
        np.testing.assert_allclose(values, all_values[:most])
        np.testing.assert_allclose(dropped, all_values[most])
        np.testing.assert_allclose(weights.T @ rows @ rows.T @ weights, np.eye(most), atol=1e-9)
