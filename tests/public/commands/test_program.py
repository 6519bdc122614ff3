"""The program around the commands: help, what is missing, Ctrl-C and SIGTERM."""

import json
import os
import pty
import signal
import termios
from contextlib import suppress
from subprocess import PIPE

import pytest

import eigengs_dr as eg
from _helpers.command import main, said
from _helpers.process import python_path, run_python, start


@pytest.mark.parametrize("command", [None, *main.commands])
def test_help_has_an_example(command):
    words = [command] if command else []
    text = said(*words, "--help")
    assert "Example" in text and " ".join(["eigengs-dr", *words]) in text


@pytest.mark.parametrize("command", ["train", "bench"])
def test_help_loads_nothing_heavy(command):
    code = f"""
import sys
from eigengs_dr.__main__ import main
try:
    main(["{command}", "--help"])
except SystemExit:
    print(*(n for n in ("drjit", "scipy", "PIL", "pandas", "matplotlib") if n in sys.modules))
"""
    assert run_python(code, PYTHONPATH=python_path()).stdout.splitlines()[-1] == ""


def test_doctor_finds_llvm():
    lines = said("doctor", "--no-compile").splitlines()
    assert any(line.startswith("llvm     works") for line in lines)
    facts = json.loads(said("doctor", "--json", "--no-compile"))
    assert facts["llvm"]["works"] and facts["llvm"]["versions"]["drjit"]


@pytest.mark.parametrize(
    ("module", "command", "words"),
    [
        ("distributed", "fit . -o x --cluster local", "pip install -e '.[cluster]'"),
        ("mitsuba", "scene x.xml -o x.png", "pip install 'mitsuba>=3.9,<3.10'"),
    ],
)
def test_one_line_says_what_to_install(photo, tmp_path, module, command, words):
    (tmp_path / "x.xml").write_text("<scene version='3.0.0'/>")
    code = f"""
import os, sys
sys.modules[{module!r}] = None
os.chdir({str(tmp_path)!r})
from eigengs_dr.__main__ import main
main({command.split()})
"""
    ended = run_python(code, PYTHONPATH=python_path())
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert module in ended.stderr and words in ended.stderr


def test_closed_standard_error(photo, tmp_path):
    """As in a service, or after ``2>&-``: no bar is shown."""
    words = ("fit", photo, "-o", tmp_path / "x.npz", "--gaussians", 64, "--iterations", 1)
    assert start(*words, preexec_fn=lambda: os.close(2)).wait() == 0
    assert (tmp_path / "x.npz").exists()


# --- Ctrl-C and SIGTERM: one line and exit code 130, and nothing half-written stays ---


@pytest.mark.parametrize(("module", "sent"), [("click", signal.SIGINT), ("numpy", signal.SIGTERM)])
def test_in_an_import(tmp_path, module, sent):
    """NumPy would blame its installation for an interrupt."""
    code = f"import os, time\nos.kill(os.getpid(), {int(sent)})\ntime.sleep(60)"
    (tmp_path / f"{module}.py").write_text(code)
    ended = start("info", "natural", folder=tmp_path, stdout=PIPE, stderr=PIPE)
    told = ended.communicate()
    assert (ended.returncode, *told) == (130, "", "eigengs-dr: interrupted\n")


def test_fit_writes_the_best_so_far_and_shows_a_bar(photo, tmp_path):
    """In a terminal, where the bar appears after 2 seconds; Ctrl-C is sent when it does."""
    outputs = ["-o", tmp_path / "x.npz", "--report", tmp_path / "r.json"]
    words = ["fit", photo, *outputs, "--gaussians", 64, "--iterations", 10_000_000]
    terminal, stderr = pty.openpty()
    termios.tcsetwinsize(stderr, (24, 100))  # rows and columns
    process = start(*words, stderr=stderr)
    os.close(stderr)
    shown, stopped = "", False
    with suppress(OSError):  # the terminal is closed when the process has ended
        while text := os.read(terminal, 1000).decode():
            shown += text
            if "psnr_rgb" in shown and not stopped:
                process.send_signal(signal.SIGINT)
                stopped = True
    assert process.wait() == 130
    assert "photo.png" in shown and "/10000000" in shown
    line = f"eigengs-dr: interrupted; the best fit so far is in {tmp_path / 'x.npz'}"
    assert [text.strip() for text in shown.splitlines()].count(line) == 1
    assert json.loads((tmp_path / "r.json").read_text())["stopped"] == "interrupted"
    assert len(eg.Gaussians.load(tmp_path / "x.npz")) == 64


def test_who_uses_the_package_keeps_its_signals():
    code = "import signal, eigengs_dr; print(signal.getsignal(signal.SIGTERM) == signal.SIG_DFL)"
    assert run_python(code, PYTHONPATH=python_path()).stdout == "True\n"
