"""The record of results that a redesign shall keep, `tools/record.py`."""

import json

import record


def test_every_entry_is_recorded():
    recorded = json.loads(record.EXPECTED.read_text(encoding="utf-8"))
    assert list(recorded["entries"]) == list(record.ENTRIES)


def test_entries_are_as_recorded(capsys):
    """Two quick ones, whose figures are those of every machine."""
    assert record.main(["--only", "render smaller"]) == 0
    assert record.main(["--only", "read pfm"]) == 0
    assert "DIFFERS" not in capsys.readouterr().out


def test_a_difference_is_told():
    old = {"psnr": 40.0, "loss": 0.1, "bytes": 1000, "gaussians": 50, "bits": "a"}
    better = {"psnr": 41.0, "loss": 0.05, "bytes": 1020, "gaussians": 50, "bits": "b"}
    assert record.verdict(old, old) == "equal bits"
    assert record.verdict(old, {**old, "bits": "b"}) == "within all figures, other bits"
    assert record.verdict(old, better).startswith("within psnr 40.0 -> 41.0; ")
    for name, value in (("psnr", 39.9), ("loss", 0.102), ("bytes", 1040), ("gaussians", 51)):
        assert record.verdict(old, {**old, name: value}) == f"DIFFERS {name} {old[name]} -> {value}"
    del better["loss"]
    assert record.verdict(old, better) == "DIFFERS loss 0.1 -> nothing"
