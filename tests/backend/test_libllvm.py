"""Which libLLVM is taken, and that a bad one is an error of one line, never a crash."""

import os
import sys

import pytest

from _helpers.process import SELECT, run_python
from eigengs_dr.backend import selection as module
from eigengs_dr.backend.selection import PATH_VARIABLE, candidates, select_libllvm

SYSTEMS = ("libllvm19", "Debian", "Ubuntu", "Fedora", "macOS", "Windows")
needs_llvm = pytest.mark.skipif(
    not any(library.usable for library in candidates()), reason="needs an LLVM that works"
)


def refusal(library):
    """What `select` says where `library` is forced; it has to be all that is said."""
    process = run_python(SELECT, **{PATH_VARIABLE: str(library)})
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    assert process.stdout.count("\n") == 1
    return process.stdout


def test_forced_old_llvm_is_refused_before_it_is_loaded(tmp_path):
    (tmp_path / "libLLVM.so.17.1").touch()
    message = refusal(tmp_path / "libLLVM.so.17.1")
    assert "is LLVM 17" in message
    assert all(name in message for name in SYSTEMS)


@needs_llvm
def test_loaded_old_llvm_is_refused():
    old = "import eigengs_dr, drjit\ndrjit.detail.llvm_version = lambda: (15, 0, 6)\n"
    process = run_python(old + SELECT, **{PATH_VARIABLE: None})
    assert "LLVM 15, which is too old; " in process.stdout
    assert process.stderr == ""


def test_missing_llvm_is_refused(tmp_path):
    message = refusal(tmp_path / "libLLVM.so")
    assert "does not exist" in message
    assert all(name in message for name in SYSTEMS)


def test_other_library_is_refused(tmp_path):
    (tmp_path / "libLLVM.so").write_bytes(b"INPUT(libLLVM-19.so)")
    assert "is not a libLLVM" in refusal(tmp_path / "libLLVM.so")


@needs_llvm
def test_newest_installed_llvm_works():
    process = run_python(SELECT, **{PATH_VARIABLE: None})
    assert (process.stdout, process.stderr) == ("[1, 2, 2]\n", "")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder that is the only place where libraries are looked for, before Dr.Jit is imported."""
    monkeypatch.setattr(module, "_patterns", lambda: [str(tmp_path / "libLLVM*.so*")])
    # Set and removed, so that whatever `select_libllvm` sets is taken back.
    monkeypatch.setenv(PATH_VARIABLE, "")
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    return tmp_path


def add_library(folder, name, size=2_000_000):
    with open(folder / name, "wb") as file:
        file.truncate(size)


@pytest.mark.parametrize(
    ("names", "order"),
    [
        (("-14.so.1", ".so.19.1", ".so.20.1", "-15.so.1"), [19, 20, 15, 14]),  # tested ones first
        (("-14.so.1", ".so.18.1", ".so.20.1"), [20, 18, 14]),
        (("-14.so.1", "-16.so.1", ".so.17.0"), [17, 16, 14]),  # all too old
    ],
)
def test_which_version_is_chosen(folder, names, order):
    for name in names:
        add_library(folder, f"libLLVM{name}")
    add_library(folder, "libLLVM-22.so", size=30)  # a linker script
    os.symlink(folder / "gone", folder / "libLLVM-21.so")
    assert [library.version for library in candidates()] == order
    select_libllvm()
    chosen = str(folder / f"libLLVM.so.{order[0]}.1") if order[0] > 17 else ""
    assert os.environ[PATH_VARIABLE] == chosen


def test_choice_of_the_user_stays(folder, monkeypatch):
    add_library(folder, "libLLVM.so.19.1")
    monkeypatch.setenv(PATH_VARIABLE, "/my/libLLVM.so")
    select_libllvm()
    assert os.environ[PATH_VARIABLE] == "/my/libLLVM.so"


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/llvm-14/lib/libLLVM.so", 14),
        ("/usr/lib64/llvm18/lib64/libLLVM.so", 18),
        ("/opt/homebrew/opt/llvm@20/lib/libLLVM.dylib", 20),
        ("/opt/homebrew/Cellar/llvm/21.1.2/lib/libLLVM.dylib", 21),
        (r"C:\Program Files\LLVM\bin\LLVM-C.dll", None),
        ("/opt/conda/lib/libLLVM.so", None),
        ("/home/me/llvm-9f2ab/lib/libLLVM.so", None),
    ],
)
def test_version_in_names_of_folders(path, version):
    assert module._version_in(path) == version
