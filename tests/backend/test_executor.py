"""The executor of this process, and which executor a client has."""

import pytest

from eigengs_dr.backend.executor import Done
from eigengs_dr.cluster import executor_for


def test_tasks_run_in_order_when_they_are_asked_for():
    drawn = []

    def tasks():
        for task in range(3):
            drawn.append(task)
            yield task

    done = executor_for(None).map(lambda task, shared: task + shared, tasks(), 10)
    assert next(done) == Done(0, 10) and drawn == [0]
    assert list(done) == [Done(1, 11), Done(2, 12)]


def test_other_clients_are_refused():
    with pytest.raises(TypeError, match=r"client is a builtins.str; pass a distributed.Client"):
        executor_for("tcp://node:8786")
