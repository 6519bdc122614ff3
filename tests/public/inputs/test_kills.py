"""Commands that are killed at random: the same command then does all, and nothing stays."""

import os
import shutil

import pytest

import kill_commands
from _helpers.process import python_path

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals"),
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kills") / "inputs"
    kill_commands.write_inputs(folder)
    return folder


@pytest.mark.parametrize("name", kill_commands.COMMANDS)
def test_kills(inputs, tmp_path, name, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", python_path())
    words, leaves = kill_commands.COMMANDS[name]
    whole = shutil.copytree(inputs, tmp_path / "whole")
    assert kill_commands.run(words, whole).returncode == 0
    for sent in ("KILL", "TERM", "INT"):
        for delay in (0.3, 1.2, 2.5):
            work = shutil.copytree(inputs, tmp_path / f"{sent}-{delay}")
            assert kill_commands.kill_once(words, leaves, work, whole, sent, delay) == []
