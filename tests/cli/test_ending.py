"""Ctrl-C and SIGTERM: one line and exit code 130 from the first import on, and nothing stays."""

import os
import signal
import subprocess
import sys

import pytest

from _helpers.process import python_path, run_python
from eigengs_dr.cli.main import main

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")

LINE = "eigengs-dr: interrupted\n"


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", ["click", "numpy"])
def test_in_an_import(tmp_path, module, sent):
    """NumPy would blame its installation for an interrupt."""
    code = f"import os, time\nos.kill(os.getpid(), {int(sent)})\ntime.sleep(60)"
    (tmp_path / f"{module}.py").write_text(code)
    path = os.pathsep.join([str(tmp_path), python_path()])
    command = [sys.executable, "-m", "eigengs_dr", "info", "natural"]
    found = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    assert (found.returncode, found.stdout, found.stderr) == (130, "", LINE)


@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM"])
def test_in_a_write(tmp_path, sent):
    code = f"""
import os, signal
from pathlib import Path
from eigengs_dr.backend.interrupts import end_at_signals
from eigengs_dr.storage.atomic import atomic_folder, atomic_write
from eigengs_dr.storage.checkpoint import open_checkpoint
folder = Path({str(tmp_path)!r})
end_at_signals()
with open_checkpoint(folder / "x.npz", {{}}, []), atomic_folder(folder / "made") as made:
    (made / "half").touch()
    with atomic_write(folder / "x.npz"):
        os.kill(os.getpid(), signal.{sent})
        raise SystemExit("goes on")
"""
    found = run_python(code, PYTHONPATH=python_path())
    assert (found.returncode, found.stderr) == (130, LINE)
    assert list(tmp_path.iterdir()) == []


def test_who_uses_the_package_keeps_its_signals():
    code = "import signal, eigengs_dr; print(signal.getsignal(signal.SIGTERM) == signal.SIG_DFL)"
    assert run_python(code, PYTHONPATH=python_path()).stdout == "True\n"


def wrapped(depth):
    """An interrupt that became other errors on its way, as in Dr.Jit and in imports."""
    error = KeyboardInterrupt()
    for kind in [RuntimeError, SystemError, ImportError, ValueError][:depth]:
        outer = kind("see above")
        outer.__cause__ = error
        error = outer
    return error


@pytest.mark.parametrize("depth", range(5))
def test_an_interrupt_below_other_errors(depth, monkeypatch, capsys):
    def interrupted():
        raise wrapped(depth)

    monkeypatch.setattr("eigengs_dr.backend.doctor.report", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(["doctor"])
    assert ended.value.code == 130
    assert capsys.readouterr().err.lstrip() == LINE  # Click ends the line of ^C
