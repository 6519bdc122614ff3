"""Settings of small trainings, and where a training keeps what it has."""

from pathlib import Path

from _helpers.photos import SMALL
from eigengs_dr.eigenbasis.options import TrainOptions


def settings(**changed):
    return TrainOptions(**{**SMALL, **changed})


def checkpoint_of(output):
    return Path(f"{output}.checkpoint")
