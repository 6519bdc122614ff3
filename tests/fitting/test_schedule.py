"""Schedules of a descent."""

from eigengs_dr.fitting.parameterization import Adam
from eigengs_dr.fitting.schedule import Schedule


def test_schedules_are_plain_values():
    """Two of the same numbers are the same."""
    assert Schedule(Adam, {"mean": 1.0}) == Schedule(Adam, {"mean": 1.0})
