"""The memory of a fit, said beforehand."""

import json
import sys

import pytest

from _helpers.process import run_python
from eigengs_dr.cli.memory import estimate_memory


def test_memory_grows_with_every_argument():
    least = estimate_memory(100, 100, 1, 1000)
    for larger in (
        (200, 100, 1, 1000),
        (100, 200, 1, 1000),
        (100, 100, 3, 1000),
        (100, 100, 1, 2000),
    ):
        assert estimate_memory(*larger) > least


FIT = """
import json
import eigengs_dr as eg
from eigengs_dr.image.resize import resample
eg.fit(resample(eg.sample("astronaut"), 1024, 1024), gaussians=80_000, iterations=10)
status = open("/proc/self/status")  # getrusage counts the process that started this one too
print(json.dumps(next(1024 * int(line.split()[1]) for line in status if "VmHWM" in line)))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Linux tells the peak of a process")
def test_estimate_is_near_the_measured_memory():
    """If this fails after a change of the renderer, measure the constants again."""
    measured = json.loads(run_python(FIT).stdout.splitlines()[-1])
    assert estimate_memory(1024, 1024, 3, 80_000) == pytest.approx(measured, rel=0.4)
