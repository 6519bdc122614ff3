"""Which libLLVM is taken, and that a bad one is an error of one line, never a crash."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from eigengs_dr.backend import libllvm as module
from eigengs_dr.backend.libllvm import PATH_VARIABLE, candidates, select_libllvm
from eigengs_dr.backend.selection import BackendError, describe, select

SELECT = """
import eigengs_dr
from eigengs_dr.backend.selection import BackendError, select
try:
    types = select("llvm")
except BackendError as error:
    print(error)
else:
    import drjit as dr
    print(dr.clip(types.Float(1, 2, 3), 0, 2))
"""

SYSTEMS = ("libllvm19", "Debian", "Ubuntu", "Fedora", "macOS", "Windows")


def run_python(code, **environment):
    """Run code in a fresh interpreter, with environment variables set, or unset by None."""
    merged = {**os.environ, **environment}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={key: value for key, value in merged.items() if value is not None},
        capture_output=True,
        text=True,
        check=False,
        timeout=250,  # a library that is read for the first time may take minutes
    )


def refusal(library):
    """What `select` says where `library` is forced; it has to be all that is said."""
    process = run_python(SELECT, **{PATH_VARIABLE: str(library)})
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    assert process.stdout.count("\n") == 1
    return process.stdout


def installed(*versions):
    return [library.path for library in candidates() if library.version in versions]


@pytest.mark.skipif(not installed(15, 16), reason="needs LLVM 15 or 16, which crash Dr.Jit")
def test_forced_crashing_llvm_is_refused():
    message = refusal(installed(15, 16)[0])
    assert "crashes Dr.Jit" in message
    assert all(name in message for name in SYSTEMS)


@pytest.mark.skipif(not installed(14), reason="needs LLVM 14, which Dr.Jit refuses")
def test_forced_old_llvm_is_refused():
    message = refusal(installed(14)[0])
    assert "LLVM 14" in message
    assert all(name in message for name in SYSTEMS)


def test_missing_llvm_is_refused(tmp_path):
    message = refusal(tmp_path / "libLLVM.so")
    assert "does not exist" in message
    assert all(name in message for name in SYSTEMS)


def test_other_library_is_refused(tmp_path):
    (tmp_path / "libLLVM.so").write_bytes(b"INPUT(libLLVM-19.so)")
    assert "is no libLLVM" in refusal(tmp_path / "libLLVM.so")


@pytest.mark.skipif(not installed(*range(17, 30)), reason="needs an LLVM that works")
def test_newest_installed_llvm_works():
    process = run_python(SELECT, **{PATH_VARIABLE: None})
    assert (process.stdout, process.stderr) == ("[1, 2, 2]\n", "")


def fake_drjit(monkeypatch, *, llvm, version):
    """Put a Dr.Jit in place that has no GPU, and an LLVM backend or none."""
    kinds = SimpleNamespace(CUDA="cuda", LLVM="llvm")
    drjit = SimpleNamespace(
        JitBackend=kinds,
        has_backend=lambda kind: llvm and kind == "llvm",
        detail=SimpleNamespace(llvm_version=lambda: version),
    )
    monkeypatch.setitem(sys.modules, "drjit", drjit)
    monkeypatch.delenv(PATH_VARIABLE, raising=False)


def test_machine_without_llvm(monkeypatch):
    fake_drjit(monkeypatch, llvm=False, version=(-1, -1, -1))
    monkeypatch.setattr(module, "candidates", lambda: [])
    with pytest.raises(BackendError, match=r"no libLLVM was found; install LLVM 17.*libllvm19"):
        select()


def test_machine_with_old_llvm_only(monkeypatch):
    fake_drjit(monkeypatch, llvm=True, version=(15, 0, 6))
    monkeypatch.setattr(module, "candidates", lambda: [])
    with pytest.raises(BackendError, match=r"LLVM 15, which crashes.*libllvm19"):
        select("llvm")


def test_cuda_without_gpu(monkeypatch):
    fake_drjit(monkeypatch, llvm=True, version=(19, 1, 7))
    with pytest.raises(BackendError, match=r"no CUDA GPU or driver was found; use backend 'llvm'"):
        select("cuda")


def test_drjit_that_cannot_be_imported(tmp_path):
    # What Dr.Jit 1.5.0 does where libatomic is missing, as on a bare Debian.
    (tmp_path / "drjit.py").write_text(
        "try:\n    raise ImportError('libatomic.so.1: cannot open shared object file')\n"
        "except ImportError:\n    undefined_name\n"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{SELECT}"
    process = run_python(code)
    assert process.returncode == 0, process.stderr
    assert process.stdout.count("\n") == 1
    assert "libatomic.so.1" in process.stdout
    assert "apt install libatomic1" in process.stdout


def test_unknown_backend():
    with pytest.raises(ValueError, match="'metal' is unknown"):
        select("metal")


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


def test_newest_is_chosen(folder):
    for name in ("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM.so.20.1", "libLLVM-15.so.1"):
        add_library(folder, name)
    add_library(folder, "libLLVM-22.so", size=30)  # a linker script
    os.symlink(folder / "gone", folder / "libLLVM-21.so")
    assert [library.version for library in candidates()] == [20, 19, 15, 14]
    select_libllvm()
    assert os.environ[PATH_VARIABLE] == str(folder / "libLLVM.so.20.1")


def test_old_ones_are_not_chosen(folder):
    for name in ("libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1"):
        add_library(folder, name)
    select_libllvm()
    assert os.environ[PATH_VARIABLE] == ""


def test_choice_of_the_user_stays(folder, monkeypatch):
    add_library(folder, "libLLVM.so.19.1")
    monkeypatch.setenv(PATH_VARIABLE, "/my/libLLVM.so")
    select_libllvm()
    assert os.environ[PATH_VARIABLE] == "/my/libLLVM.so"


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/llvm-14/lib/libLLVM.so", 14),
        ("/usr/lib64/llvm18/lib64/libLLVM.so", 18),
        ("/opt/homebrew/opt/llvm@20/lib/libLLVM.dylib", 20),
        ("/opt/homebrew/Cellar/llvm/21.1.2/lib/libLLVM.dylib", 21),
        ("/opt/local/libexec/llvm-19/lib/libLLVM.dylib", 19),
        (r"C:\Program Files\LLVM\bin\LLVM-C.dll", None),
        ("/opt/conda/lib/libLLVM.so", None),
    ],
)
def test_version_in_names(path, version):
    assert module._version_in(path) == version


def test_describe(backend):
    found = describe(backend)
    assert found["backend"] == backend
    assert found["threads"] >= 1
    assert found["versions"]["drjit"].startswith("1.")
    if backend == "llvm":
        assert int(found["versions"]["libllvm"].split(".")[0]) >= module.MIN_VERSION
    json.dumps(found)


def test_import_starts_nothing():
    code = """
import sys
import eigengs_dr
slow = {"click", "matplotlib", "mitsuba", "scipy", "skimage", "tqdm"}
print(sorted(slow & set(sys.modules)))
if sys.platform == "linux":
    # Dr.Jit loads libLLVM when it is imported, and with it what a user may not want.
    print([line for line in open("/proc/self/maps") if "libLLVM" in line][:1])
"""
    process = run_python(code)
    assert process.returncode == 0, process.stderr
    assert set(process.stdout.splitlines()) == {"[]"}
