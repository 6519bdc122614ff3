"""The options of a fit in one record, which checks them once."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import wraps
from inspect import signature
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..backend.arguments import plain_numbers, takes_numbers
from ..gaussian.file import CUTOFF, MAX_CUTOFF, check_index_range, check_sides
from ..image.color import SPACES
from ..image.metrics import MAX_PSNR
from ..image.pixels import check_encoding
from .schedule import Schedule

if TYPE_CHECKING:  # a set needs Dr.Jit, and the help of the command line none
    from ..gaussian.gaussians import Gaussians

DEFAULT_COUNT = 5000
"""Number of Gaussians by default."""

INITS = ("auto", "random", "grid", "adaptive")
"""What ``init`` takes: "auto" and the placements of `eigengs_dr.fitting.start`."""

PIXELS_PER_FIRST_GAUSSIAN = 64
"""Pixels per Gaussian in the first try of a search for the number of Gaussians."""

COLOR_PARAMETERS = 5
"""Parameters of a Gaussian without its colour: two of the mean and three of the factor."""

Levels = int | Sequence[int]
"""A number of levels of detail, or the number of Gaussians up to each level in ascending order."""

LEVEL_RATIO = 4
"""Ratio of the numbers of Gaussians up to a level and up to the level before it; 4 halves their
spacing."""


Function = TypeVar("Function", bound=Callable[..., Any])


def refuse_unknown(given: Collection[str], known: Collection[str]) -> None:
    """Raise TypeError for an option that is unknown, with the name that it resembles."""
    for name in given:
        if name not in known:
            [*close] = get_close_matches(name, known, 1)
            advice = f"did you mean {close[0]!r}?" if close else f"use one of {', '.join(known)}"
            raise TypeError(f"unknown option {name!r}; {advice}")


def named_options(function: Function) -> Function:
    """Decorate a function whose unknown keywords `refuse_unknown` reports."""
    known = list(signature(function).parameters)

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        refuse_unknown(options, known)
        return function(*arguments, **options)

    return call  # type: ignore[return-value]


@runtime_checkable
class Model(Protocol):
    """What makes a set of an image at once, as `eigengs_dr.EigenGS` does."""

    @property
    def gaussians(self) -> Gaussians:
        """Gaussians at the native size of the model."""

    def encode(self, image: Any, colors: str = "exact", mean: str = "gaussians") -> Gaussians:
        """Return the set of an image at the size of the image."""

    def dense_mean(self, width: int, height: int) -> NDArray[np.float32]:
        """Return the pixels (height, width, C) that a set of the mean "dense" lacks."""


Start: TypeAlias = "Gaussians | Model | str | os.PathLike[str]"
"""What a fit starts from: a set, the file of a set, or a model."""


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """The options of `eigengs_dr.fit`, which describes each of them.

    Raises
    ------
    ValueError
        If an option is out of range, or two options exclude each other.
    """

    gaussians: int | None = None
    iterations: int = 1000
    init: str = "auto"
    start: Start | None = None
    preset: str = "default"
    solve_steps: int = 10
    space: str = "ycbcr"
    seed: int = 0
    backend: str | None = None
    cutoff: float = CUTOFF
    target_psnr: float | None = None
    target_space: str = "rgb"
    max_gaussians: int | None = None
    levels: Levels | None = None
    encoding: str | None = None

    def __post_init__(self) -> None:
        for name, value in plain_numbers(vars(self), FitOptions.__annotations__).items():
            object.__setattr__(self, name, value)
        if isinstance(self.levels, np.integer):
            object.__setattr__(self, "levels", int(self.levels))
        if self.levels is not None and not isinstance(self.levels, int):
            object.__setattr__(self, "gaussians", _check_counts(self.gaussians, self.levels)[-1])
        self._check_numbers()
        check_encoding(self.encoding)
        for name, value, known in (
            ("init", self.init, INITS),
            ("preset", self.preset, tuple(PRESETS)),
            ("space", self.space, SPACES),
            ("target_space", self.target_space, ("rgb", "ycbcr")),
        ):
            if value not in known:
                raise ValueError(f"{name} {value!r} is unknown; use one of {', '.join(known)}")
        if self.start is not None and self.init != "auto":
            raise ValueError(f"init {self.init!r} and a start exclude each other; give one of them")
        if self.method.mean == "dense" and not isinstance(self.start, Model):
            raise ValueError(
                f"preset {self.preset!r} starts from a model; give one as the start, such as "
                "EigenGS.load('natural')"
            )
        self._check_search()
        if self.levels is not None and (self.preset, self.placement) != ("default", "adaptive"):
            raise ValueError(
                "levels needs preset 'default' and init 'adaptive'; leave the others out"
            )

    @property
    def method(self) -> Preset:
        """The preset."""
        return PRESETS[self.preset]

    @property
    def placement(self) -> str | None:
        """The name of the placement, by default the preset's; None if there is a start."""
        if self.start is not None:
            return None
        return self.method.init if self.init == "auto" else self.init

    def check_image(self, pixels: NDArray[np.float32]) -> None:
        """Raise ValueError for more Gaussians than pixels, and for an image too large to index.

        Parameters
        ----------
        pixels : ndarray of float32, shape (H, W, C)
        """
        height, width, channels = pixels.shape
        check_sides((width, height))
        check_index_range(width, height, channels)
        for name in ("gaussians", "max_gaussians"):
            count = getattr(self, name)
            if count is not None and not 1 <= count <= width * height:
                raise ValueError(
                    f"{name} is {count}; an image of {width}x{height} takes 1 to {width * height}"
                )

    def count_for(self, pixels: NDArray[np.float32]) -> int:
        """Return the number of Gaussians for an image (H, W, C), if the fit does not search it."""
        return self.gaussians or default_count(pixels.shape[0] * pixels.shape[1])

    def most_for(self, pixels: NDArray[np.float32]) -> int:
        """Return the largest number of Gaussians that a search tries for an image (H, W, C)."""
        return self.max_gaussians or max_gaussians_for(pixels)

    def first_try(self, pixels: NDArray[np.float32]) -> FitOptions:
        """Return the options of the start for an image (H, W, C): a search starts with few."""
        if self.target_psnr is None:
            return self
        few = max(1, pixels.shape[0] * pixels.shape[1] // PIXELS_PER_FIRST_GAUSSIAN)
        return replace(
            self,
            gaussians=min(self.most_for(pixels), few),
            target_psnr=None,
            target_space="rgb",
            max_gaussians=None,
        )

    def _check_numbers(self) -> None:
        counts = {name: getattr(self, name) for name in ("iterations", "solve_steps", "seed")}
        for name in ("gaussians", "max_gaussians"):
            if getattr(self, name) is not None:
                counts[name] = getattr(self, name)
        for name, count in counts.items():
            if count < 0:
                least = 1 if name.endswith("gaussians") else 0
                raise ValueError(f"{name} is {count!r}; it must be at least {least}")
        if not 0 < self.cutoff <= MAX_CUTOFF:
            raise ValueError(
                f"cutoff is {self.cutoff}; it must be above 0 and at most {MAX_CUTOFF:g}"
            )

    def _check_search(self) -> None:
        """Raise ValueError for options that contradict a search for the number of Gaussians."""
        if self.target_psnr is None:
            if self.max_gaussians is not None or self.target_space != "rgb":
                raise ValueError(
                    "max_gaussians and target_space belong to target_psnr; give target_psnr too"
                )
            return
        for name in ("levels", "gaussians"):
            if getattr(self, name) is not None:
                raise ValueError(f"{name} and target_psnr exclude each other; give one of them")
        if self.preset != "default" or self.placement != "adaptive":
            raise ValueError(
                "target_psnr works with preset 'default' and init 'adaptive', not with "
                f"{self.preset!r} and {self.placement or 'a start'!r}"
            )
        check_goal(self.target_psnr)


def check_goal(target_psnr: float) -> None:
    """Raise ValueError for a PSNR in dB that no fit can have as its goal."""
    if not 0 < target_psnr <= MAX_PSNR:
        raise ValueError(
            f"target_psnr is {target_psnr}; it must be above 0 and at most {MAX_PSNR:g}"
        )


def default_count(pixels: int) -> int:
    """Return the default number of Gaussians: `DEFAULT_COUNT`, at most one per pixel."""
    return min(DEFAULT_COUNT, pixels)


def max_gaussians_for(pixels: NDArray[np.float32]) -> int:
    """Return the number of Gaussians with as many parameters as an image (H, W, C) has numbers."""
    channels = pixels.shape[2]
    return max(1, pixels.size // (COLOR_PARAMETERS + channels))


@takes_numbers
def level_counts(count: int, levels: Levels) -> list[int]:
    """Return the number of Gaussians up to each level.

    Parameters
    ----------
    count : int
        Number of Gaussians of the whole set.
    levels : int or sequence of int
        Number of levels, with the whole set: each level has `LEVEL_RATIO` times as many Gaussians
        as the one before. Or the number of Gaussians up to each level; the last is `count`.

    Returns
    -------
    list of int
        In ascending order; the last is `count`.

    Raises
    ------
    ValueError
        If the first level would have no Gaussian, levels is not positive, or numbers of Gaussians
        do not rise up to `count`.

    Examples
    --------
    >>> level_counts(5000, 4)
    [78, 312, 1250, 5000]
    >>> level_counts(9000, [5000, 7000, 9000])
    [5000, 7000, 9000]
    """
    if not isinstance(levels, (int, np.integer)):
        return _check_counts(count, levels)
    most = 1
    while count >= LEVEL_RATIO**most:
        most += 1
    if not 1 <= levels <= most:
        raise ValueError(f"levels is {levels}; {count} Gaussians make 1 to {most}")
    return [count // LEVEL_RATIO**k for k in reversed(range(levels))]


def _check_counts(count: int | None, levels: Sequence[int]) -> list[int]:
    """Return numbers of Gaussians that rise up to `count`, if that is known."""
    counts, written = list(levels), ", ".join(map(str, levels))
    if not all(isinstance(n, (int, np.integer)) for n in counts):
        raise ValueError(f"levels {written}: numbers of Gaussians must be whole")
    if not counts or not all(a < b for a, b in pairwise([0, *counts])):
        raise ValueError(f"levels {written}: numbers of Gaussians must rise, from 1 or more")
    if count is not None and counts[-1] != count:
        raise ValueError(f"levels {written}: the last must be the number of Gaussians, {count}")
    return [int(n) for n in counts]


@dataclass(frozen=True)
class Preset:
    """A method: the placement, the start of the colours and the schedule of the refinement.

    Attributes
    ----------
    init : str
        Placement for ``init="auto"``.
    solves : bool
        Whether a solve finds the best colours for the shapes before refinement. Without a solve, a
        start has its own colours, those of a model are projections on its components, and
        placements draw them from [0, 1] on a black background.
    schedule : Schedule
        Schedule of the refinement.
    mean : {"gaussians", "dense"}
        With a model: "gaussians" if the Gaussians include the mean image, "dense" if the mean image
        stays pixels.
    """

    init: str
    solves: bool
    schedule: Schedule
    mean: str = "gaussians"


# GaussianImage has one learning rate for all variables. It halves the rate after 20,000 steps,
# which no fit here reaches.
_ONE_RATE = Schedule(
    optimizer="adan",
    rates={"mean": 1e-3, "cholesky": 1e-3, "color": 1e-3},
    parameterization="cholesky",
    decay=1.0,
    warm_up=0,
    drift=4e-3,
    redistribute_after=0,
)

PRESETS = {
    "default": Preset(
        init="adaptive",
        solves=True,
        schedule=Schedule(
            optimizer="adam",
            settings={"beta_1": 0.9, "beta_2": 0.9, "epsilon": 1e-12},
            rates={"mean": 0.4, "factor": 0.22, "color": 0.0115},
            decay=0.045,
            drift=1.4,
            relocate_every=45,
            rate_exponent=0.8,
        ),
    ),
    "gaussianimage": Preset(init="random", solves=False, schedule=_ONE_RATE),
    # EigenGS's paper descends as GaussianImage does, from the projection on the eigenbasis.
    "eigengs": Preset(init="", solves=False, schedule=_ONE_RATE, mean="dense"),
}
"""Presets by name."""
