"""Which backend is selected, and what is said, also by doctor, where there is none."""

import json
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import pytest

from _helpers.process import SELECT, run_python
from eigengs_dr.backend import selection as module
from eigengs_dr.backend.selection import (
    BACKENDS,
    PATH_VARIABLE,
    BackendError,
    backend_of,
    describe,
    name_of,
    select,
)


def fake_drjit(monkeypatch, *, llvm=True, version=(19, 1, 7), cuda=False, metal=False):
    """Put a Dr.Jit in place that has GPUs or none, and an LLVM backend or none."""
    works = {"LLVM": llvm, "CUDA": cuda, "Metal": metal}
    drjit = ModuleType("drjit")
    drjit.JitBackend = SimpleNamespace(**{name: name for name in works})
    drjit.has_backend = works.__getitem__
    for name in BACKENDS:
        setattr(drjit, name, SimpleNamespace(ad=ModuleType(f"drjit.{name}.ad")))
    drjit.detail = SimpleNamespace(llvm_version=lambda: version)
    monkeypatch.setitem(sys.modules, "drjit", drjit)
    monkeypatch.delenv(PATH_VARIABLE, raising=False)
    return drjit


@pytest.mark.parametrize(
    ("works", "version", "words"),
    [
        (False, (-1, -1, -1), r"no libLLVM was found; install LLVM 18.*libllvm19"),
        (True, (15, 0, 6), r"LLVM 15, which is too old; .*libllvm19"),
    ],
)
def test_machine_without_an_llvm_that_works(monkeypatch, works, version, words):
    fake_drjit(monkeypatch, llvm=works, version=version)
    monkeypatch.setattr(module, "candidates", lambda: [])
    with pytest.raises(BackendError, match=words):
        select()


def test_cuda_without_gpu(monkeypatch):
    fake_drjit(monkeypatch)
    with pytest.raises(BackendError, match=r"no CUDA GPU or driver was found; use backend 'llvm'"):
        select("cuda")


def test_cuda_is_the_default_where_there_is_a_gpu(monkeypatch):
    """Nothing runs on it first, in this process or another one."""
    drjit = fake_drjit(monkeypatch, cuda=True)
    monkeypatch.setattr(subprocess, "run", None)
    assert select() is select("cuda") is drjit.cuda.ad
    assert select("llvm") is drjit.llvm.ad
    assert select() is drjit.cuda.ad


def test_metal_by_its_names(monkeypatch):
    """By stand-in: Dr.Jit's wheels for Linux have no Metal."""
    drjit = fake_drjit(monkeypatch, metal=True)
    assert select("metal") is drjit.metal.ad
    assert select() is drjit.llvm.ad
    assert name_of(drjit.metal.ad) == backend_of("metal_ad_rgb") == "metal"
    assert backend_of("scalar_rgb") is None
    fake_drjit(monkeypatch)
    with pytest.raises(BackendError, match="no Metal GPU"):
        select("metal")


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
    with pytest.raises(ValueError, match="'vulkan' is unknown"):
        select("vulkan")


def test_describe(backend):
    found = describe(backend)
    assert found["backend"] == backend
    assert found["threads"] >= 1
    assert found["versions"]["drjit"].startswith("1.")
    if backend == "llvm":
        assert int(found["versions"]["libllvm"].split(".")[0]) >= module.MIN_VERSION
    json.dumps(found)


def test_import_where_standard_error_is_closed():
    """As in some daemons."""
    code = "import os; os.close(2); import eigengs_dr as eg; print(eg.render.__name__)"
    found = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert (found.returncode, found.stdout) == (0, "render\n")


def test_a_mitsuba_for_another_drjit_is_explained(tmp_path):
    """Both pin each other: a Mitsuba before 3.9 cannot be imported beside this package."""
    (tmp_path / "mitsuba").mkdir()
    (tmp_path / "mitsuba" / "__init__.py").write_text("raise ImportError('another drjit')")
    facts = tmp_path / "mitsuba-3.8.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: mitsuba\nVersion: 3.8.0\nRequires-Dist: drjit ==1.2.0\n"
    )
    names = "from eigengs_dr.backend.doctor import describe_machine, report"
    code = f"{names}; print(describe_machine(report()))"
    told = run_python(code, PYTHONPATH=str(tmp_path)).stdout.splitlines()
    assert told[-1].startswith("mitsuba  3.8.0: cannot be imported; it needs drjit ==1.2.0, and")
    assert told[-1].endswith("is installed: pip install 'mitsuba>=3.9,<3.10'")
