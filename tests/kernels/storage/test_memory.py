"""The memory of this process in a container."""

import sys

import pytest

from eigengs_dr.storage.memory import usable_memory

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
