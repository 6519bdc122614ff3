"""The memory of a fit, said beforehand."""

import json
import sys

import pytest

from _helpers.process import run_python
from eigengs_dr.fitting.memory import estimate_memory, usable_memory


def test_memory_grows_with_every_argument():
    least = estimate_memory(100, 100, 1, 1000)
    for larger in (
        (200, 100, 1, 1000),
        (100, 200, 1, 1000),
        (100, 100, 3, 1000),
        (100, 100, 1, 2000),
    ):
        assert estimate_memory(*larger) > least


GROUPS = {
    "version 2": ("0::/job/task", {"job/memory.max": 5000, "job/task/memory.max": "max"}),
    "version 2, own root": ("0::/", {"memory.max": 5000}),
    "version 1": (
        "5:cpu:/job\n4:memory:/job",
        {
            "memory/memory.limit_in_bytes": 9223372036854771712,
            "memory/job/memory.limit_in_bytes": 5000,
        },
    ),
    "version 1, own root": ("4:memory:/docker/123", {"memory/memory.limit_in_bytes": 5000}),
    "two controllers": ("2:memory,hugetlb:/", {"memory/memory.limit_in_bytes": 5000}),
}


@pytest.mark.skipif(sys.platform != "linux", reason="Linux has control groups")
@pytest.mark.parametrize("name", GROUPS)
def test_memory_of_a_container_is_that_of_its_group(tmp_path, name):
    installed = usable_memory(tmp_path)
    groups, limits = GROUPS[name]
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text(groups + "\n")
    assert usable_memory(tmp_path) == installed > 5000
    for file, limit in limits.items():
        path = tmp_path / "sys/fs/cgroup" / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{limit}\n")
    assert usable_memory(tmp_path) == 5000


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
