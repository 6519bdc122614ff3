"""What doctor says of an installation that does not work."""

from _helpers.process import run_python


def test_a_mitsuba_for_another_drjit_is_explained(tmp_path):
    """Both pin each other: a Mitsuba before 3.9 cannot be imported beside this package."""
    (tmp_path / "mitsuba").mkdir()
    (tmp_path / "mitsuba" / "__init__.py").write_text("raise ImportError('another drjit')")
    facts = tmp_path / "mitsuba-3.8.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: mitsuba\nVersion: 3.8.0\nRequires-Dist: drjit ==1.2.0\n"
    )
    code = "from eigengs_dr.backend.doctor import describe, report; print(describe(report()))"
    told = run_python(code, PYTHONPATH=str(tmp_path)).stdout.splitlines()
    assert told[-1].startswith("mitsuba  3.8.0: cannot be imported; it needs drjit ==1.2.0, and")
    assert told[-1].endswith("is installed: pip install 'mitsuba==3.9.*'")
