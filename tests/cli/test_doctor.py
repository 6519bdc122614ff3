"""The command `doctor`."""

import json

from _helpers.command import run, succeeded


def test_doctor():
    text = succeeded(run("doctor")).stdout
    assert "llvm" in text
    assert "libLLVM" in text
    found = json.loads(run("doctor", "--json").stdout)
    assert found["llvm"]["works"] or found["cuda"]["works"]
