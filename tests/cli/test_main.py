"""The help of all commands, and the program around them."""

import subprocess
import sys

import pytest

from _helpers.command import run, said
from _helpers.process import run_python
from eigengs_dr.cli.main import main


@pytest.mark.parametrize("command", [None, *main.commands])
def test_help_has_an_example(command):
    words = [command] if command else []
    text = said(*words, "--help")
    assert "Example" in text and " ".join(["eigengs-dr", *words]) in text


@pytest.mark.parametrize("command", ["train", "bench"])
def test_help_loads_nothing_heavy(command):
    code = f"""
import sys
from eigengs_dr.cli.main import main
try:
    main(["{command}", "--help"])
except SystemExit:
    print(*(n for n in ("drjit", "scipy", "PIL", "pandas", "matplotlib") if n in sys.modules))
"""
    assert run_python(code).stdout.splitlines()[-1] == ""


def test_python_m():
    command = [sys.executable, "-m", "eigengs_dr", "--help"]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "eigengs-dr fit" in found.stdout


def test_what_to_install_is_said_where_the_benchmarks_are_missing(monkeypatch):
    monkeypatch.setattr("eigengs_dr.cli.main.entry_points", lambda **names: [])
    for arguments in (["bench"], ["bench", "kernels"]):
        told = run(*arguments)
        assert told.exit_code == 2
        assert told.stderr.count("\n") == 1 and "pip install ./benchmarks" in told.stderr
    assert run("--help").exit_code == 0


def test_closed_standard_error(photo, tmp_path, monkeypatch):
    """As in a service, or after ``2>&-``: no bar is shown."""
    monkeypatch.setattr(sys, "stderr", None)
    with pytest.raises(SystemExit) as ended:
        main(["fit", str(photo), "-o", str(tmp_path / "x.npz"), "--iterations", "0"])
    assert not ended.value.code
    assert (tmp_path / "x.npz").exists()
