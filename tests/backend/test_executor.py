"""The executor of this process, and which executor a client has."""

import pytest

from eigengs_dr.backend.executor import ClusterError, Done, completed, executor_for


def add(task, shared):
    return task + shared


def test_tasks_run_in_order_when_they_are_asked_for():
    drawn = []

    def tasks():
        for task in range(3):
            drawn.append(task)
            yield task

    done = executor_for(None).map(add, tasks(), 10)
    assert next(done) == Done(0, 10) and drawn == [0]
    assert list(done) == [Done(1, 11), Done(2, 12)]


def test_errors_are_raised():
    with pytest.raises(TypeError):
        list(executor_for().map(add, [None], 1))


def test_an_executor_is_taken_as_it_is():
    here = executor_for(None)
    assert executor_for(here) is here


def test_completed_is_strict_about_lost_tasks():
    class Losing:
        def map(self, function, tasks, shared=None):
            yield Done(1, 5)
            yield Done(0, None, "its worker ended 2 times")

    found = completed(Losing(), add, [1, 2], 3)
    assert next(found) == (1, 5)
    with pytest.raises(ClusterError, match="cannot be done: its worker ended 2 times"):
        next(found)


def test_other_clients_are_refused():
    with pytest.raises(TypeError, match=r"client is a builtins.str; pass a distributed.Client"):
        executor_for("tcp://node:8786")
