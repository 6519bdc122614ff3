"""The package needs no Dask, until somebody asks for a cluster."""

from _helpers.process import run_python


def test_importing_the_package_imports_no_dask():
    code = (
        "import sys, eigengs_dr as eg\n"
        "from eigengs_dr.cli import main\n"
        "eg.fit_many, eg.EigenGS, eg.Eigenbasis\n"
        "print([name for name in ('dask', 'distributed', 'fsspec') if name in sys.modules])"
    )
    result = run_python(code)
    assert result.stdout.strip() == "[]", result.stderr
