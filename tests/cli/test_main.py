"""The help of all commands."""

import subprocess
import sys

import pytest

from _helpers.command import run, succeeded
from eigengs_dr.cli.main import main


@pytest.mark.parametrize(
    "command", [[], ["fit"], ["train"], ["render"], ["info"], ["doctor"], ["bench"]]
)
def test_help_has_an_example(command):
    text = succeeded(run(*command, "--help")).stdout
    assert "Example" in text
    assert "eigengs-dr " + " ".join(command) in text


def test_help_loads_nothing_heavy():
    script = (
        "import sys; from eigengs_dr.cli.main import main\n"
        "try: main(['train', '--help'])\n"
        "except SystemExit: print(*(n for n in ('drjit', 'scipy', 'PIL') if n in sys.modules))"
    )
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert process.stdout.splitlines()[-1] == ""


def test_render_says_what_it_wrote(fitted, tmp_path):
    target = tmp_path / "y.png"
    told = succeeded(run("render", fitted[0] / "fit.npz", "-o", target)).stdout
    assert str(target) in told and "32x24" in told
    assert succeeded(run("render", fitted[0] / "fit.npz", "-o", target, "--quiet")).stdout == ""


def test_python_m():
    command = [sys.executable, "-m", "eigengs_dr", "--help"]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "eigengs-dr fit" in found.stdout


def test_closed_standard_error(photo, tmp_path, monkeypatch):
    """As in a service, or after ``2>&-``: no bar is shown."""
    monkeypatch.setattr(sys, "stderr", None)
    with pytest.raises(SystemExit) as ended:
        main(["fit", str(photo), "-o", str(tmp_path / "x.npz"), "--iterations", "0"])
    assert not ended.value.code
    assert (tmp_path / "x.npz").exists()
