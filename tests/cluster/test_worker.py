"""What a worker of another machine does before its first task."""

import os

import pytest

from eigengs_dr.cluster.executor import use_own_kernel_cache

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows has no modes")


@pytest.fixture
def chosen(tmp_path, monkeypatch):
    """The function that chooses the folder of compiled kernels, in a folder that all may write."""
    monkeypatch.setenv("DRJIT_CACHE_DIR", "x")  # so that the end of the test undoes the choice

    def choose():
        del os.environ["DRJIT_CACHE_DIR"]
        use_own_kernel_cache(tmp_path)
        return os.environ["DRJIT_CACHE_DIR"]

    return choose


def assert_private(folder):
    found = os.lstat(folder)
    assert found.st_uid == os.getuid() and not found.st_mode & 0o077


def test_kernels_are_kept_in_a_private_folder(chosen):
    folder = chosen()
    assert_private(folder)
    assert chosen() == folder


def taken_by_mode(folder):
    os.mkdir(folder)
    os.chmod(folder, 0o777)


def taken_by_owner(folder):
    if os.getuid() != 0:
        pytest.skip("needs root, to make a folder of another user")
    os.mkdir(folder, 0o700)
    os.chown(folder, 12345, -1)


def taken_by_link(folder):
    os.mkdir(folder + "-elsewhere", 0o700)
    os.symlink(folder + "-elsewhere", folder)


@pytest.mark.parametrize("take", [taken_by_mode, taken_by_owner, taken_by_link])
def test_a_folder_that_others_may_write_is_left_alone(chosen, take):
    expected = chosen()
    os.rmdir(expected)
    take(expected)
    folder = chosen()
    assert folder != expected
    assert_private(folder)


def test_a_folder_that_the_user_chose_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("DRJIT_CACHE_DIR", "mine")
    use_own_kernel_cache(tmp_path)
    assert os.environ["DRJIT_CACHE_DIR"] == "mine" and not list(tmp_path.iterdir())
