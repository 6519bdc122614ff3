"""Programs in a Python of their own."""

import os
import subprocess
import sys
from pathlib import Path

import eigengs_dr

SELECT = """
import eigengs_dr as eg
try:
    eg.Gaussians.from_arrays(
        [[1, 1]], [[1, 0, 1]], [[1]], size=(2, 2), space="data", backend="llvm"
    )
except eg.BackendError as error:
    print(error)
else:
    import drjit as dr
    print(dr.clip(dr.llvm.ad.Float(1, 2, 3), 0, 2))
"""


HUNG = """
import faulthandler, os
# An import of Dr.Jit hides standard error, so the watch has its own copy.
faulthandler.enable(os.dup(2))
faulthandler.dump_traceback_later({seconds}, exit=True, file=os.dup(2))
"""
"""What lets a program that hangs end, and one that crashes too say where: threads are in play."""


def run_python(code, seconds=200, **environment):
    """Run code in a fresh interpreter, with environment variables set, or unset by None.

    It ends after so many seconds: a library that is read for the first time may take minutes.
    """
    merged = {**os.environ, **environment}
    return subprocess.run(
        [sys.executable, "-c", HUNG.format(seconds=seconds) + code],
        env={key: value for key, value in merged.items() if value is not None},
        capture_output=True,
        text=True,
        check=False,
        timeout=seconds + 50,
    )


def start(*words, folder="", **options):
    """Start the command line in a process of its own, which imports from a folder first."""
    program = [sys.executable, "-m", "eigengs_dr", *map(str, words)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), python_path()])}
    return subprocess.Popen(program, env=environment, text=True, **options)


def python_path():
    """Return where such programs find the package and the helpers of the tests."""
    root = Path(eigengs_dr.__file__).parents[1]
    return os.pathsep.join([str(root), str(root / "tests")])
