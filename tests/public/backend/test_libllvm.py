"""Which backend and which libLLVM are taken; what does not work is an error of one line."""

import json
import os

import drjit as dr
import pytest

import eigengs_dr as eg
from _helpers.process import SELECT, run_python

SYSTEMS = ("libllvm19", "Debian", "Ubuntu", "Fedora", "macOS", "Windows")
PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"

DOCTOR = """
import runpy, sys
sys.argv = ["eigengs-dr", "doctor", "--no-compile", *{words!r}]
runpy.run_module("eigengs_dr", run_name="__main__")
"""


def doctor(*words, **environment):
    """What the command says of a machine with other environment variables."""
    return run_python(DOCTOR.format(words=words), **environment).stdout


def set_of_one(**backend):
    return eg.Gaussians.from_arrays(
        [[1, 1]], [[1, 0, 1]], [[1]], size=(2, 2), space="data", **backend
    )


# --- A libLLVM that is refused ---


SIMILARITY = """
import eigengs_dr as eg, numpy as np
try:
    eg.ssim(np.zeros((16, 16, 3)), np.zeros((16, 16, 3)))
except eg.BackendError as error:
    print(error)
"""


def refusal(library, program=SELECT):
    """What is said where `library` is forced; it has to be all that is said."""
    process = run_python(program, **{PATH_VARIABLE: str(library)})
    assert process.returncode == 0, process.stderr
    assert process.stderr == "" and process.stdout.count("\n") == 1
    return process.stdout


def test_a_metric_that_needs_a_backend_is_as_quiet(tmp_path):
    assert "does not exist" in refusal(tmp_path / "libLLVM.so", SIMILARITY)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("libLLVM.so.17.1", b"", "is LLVM 17"),  # refused before it is loaded
        ("libLLVM.so", None, "does not exist"),
        ("libLLVM.so", b"INPUT(libLLVM-19.so)", "is not a libLLVM"),
    ],
)
def test_a_library_that_is_refused(tmp_path, name, content, reason):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    message = refusal(tmp_path / name)
    assert reason in message and all(system in message for system in SYSTEMS)


def test_loaded_old_llvm_is_refused():
    old = "import eigengs_dr, drjit\ndrjit.detail.llvm_version = lambda: (15, 0, 6)\n"
    process = run_python(old + SELECT, **{PATH_VARIABLE: None})
    assert "LLVM 15, which is too old; " in process.stdout
    assert process.stderr == ""


# --- Which one is taken ---


def test_the_newest_that_was_tested_comes_first(tmp_path):
    """By the names of files and of folders; a linker script and a link to nothing are none."""
    names = [
        *("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM.so.20.1", "libLLVM-15.so.1"),
        *("llvm-16/lib/libLLVM.so", "llvm@21/lib/libLLVM.so", "plain/libLLVM.so"),
    ]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        with open(tmp_path / name, "wb") as file:
            file.truncate(2_000_000)
    (tmp_path / "libLLVM-23.so").write_bytes(b"INPUT(libLLVM.so.19.1)")
    (tmp_path / "libLLVM-24.so").symlink_to(tmp_path / "gone")
    folders = [tmp_path, *(tmp_path / name for name in ("llvm-16/lib", "llvm@21/lib", "plain"))]
    paths = {PATH_VARIABLE: None, "LD_LIBRARY_PATH": ":".join(map(str, folders))}
    libraries = json.loads(doctor("--json", **paths))["libllvm"]
    ours = [library for library in libraries if library["path"].startswith(str(tmp_path))]
    assert [library["version"] for library in ours] == [19, 21, 20, 16, 15, 14, None]
    assert [library["usable"] for library in ours] == [True] * 3 + [False] * 3 + [True]
    chosen = f"import os, eigengs_dr; print(os.environ[{PATH_VARIABLE!r}])"
    first = next(library["path"] for library in libraries if library["usable"])
    assert run_python(chosen, **paths).stdout.strip() == first
    mine = paths | {PATH_VARIABLE: "/my/libLLVM.so"}
    assert run_python(chosen, **mine).stdout.strip() == "/my/libLLVM.so"


# --- Which backend ---


def test_the_default_is_cuda_where_there_is_a_gpu():
    expected = "cuda" if dr.has_backend(dr.JitBackend.CUDA) else "llvm"
    assert type(set_of_one().mean).__module__ == f"drjit.{expected}.ad"


@pytest.mark.parametrize(("backend", "name"), [("cuda", "CUDA"), ("metal", "Metal")])
def test_a_backend_without_its_gpu(backend, name):
    if dr.has_backend(getattr(dr.JitBackend, name)):
        pytest.skip("there is one")
    with pytest.raises(eg.BackendError, match=f"no {name} GPU or driver .*use backend 'llvm'"):
        set_of_one(backend=backend)


# --- Dr.Jit and Mitsuba that cannot be imported ---


def test_drjit_that_cannot_be_imported(tmp_path):
    # What Dr.Jit 1.5.0 does where libatomic is missing, as on a bare Debian.
    (tmp_path / "drjit.py").write_text(
        "try:\n    raise ImportError('libatomic.so.1: cannot open shared object file')\n"
        "except ImportError:\n    undefined_name\n"
    )
    process = run_python(f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{SELECT}")
    assert process.returncode == 0, process.stderr
    assert process.stdout.count("\n") == 1
    assert "libatomic.so.1" in process.stdout
    assert "apt install libatomic1" in process.stdout


def test_a_mitsuba_for_another_drjit_is_explained(tmp_path):
    """Both pin each other: a Mitsuba before 3.9 cannot be imported beside this package."""
    (tmp_path / "mitsuba").mkdir()
    (tmp_path / "mitsuba" / "__init__.py").write_text("raise ImportError('another drjit')")
    facts = tmp_path / "mitsuba-3.8.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: mitsuba\nVersion: 3.8.0\nRequires-Dist: drjit ==1.2.0\n"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    told = doctor(PYTHONPATH=path).splitlines()
    line = next(line for line in told if line.startswith("mitsuba"))
    assert line.startswith("mitsuba  3.8.0: cannot be imported; it needs drjit ==1.2.0, and")
    assert line.endswith("is installed: pip install 'mitsuba>=3.9,<3.10'")
