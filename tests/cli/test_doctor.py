"""The command doctor: what it finds, and what it compiles."""

import json

from _helpers.command import said


def test_it_finds_llvm_and_compiles_a_first_fit():
    lines = said("doctor").splitlines()
    assert any(line.startswith("llvm     works") for line in lines)
    assert "programs of a first fit are compiled" in lines[-1]


def test_json_holds_facts_alone():
    facts = json.loads(said("doctor", "--json", "--no-compile"))
    assert facts["llvm"]["works"] and facts["llvm"]["versions"]["drjit"]
