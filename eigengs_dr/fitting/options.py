"""The options of a fit in one record, which checks them once."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import wraps
from inspect import signature
from itertools import pairwise, product
from typing import Any, TypeAlias, TypeVar

import numpy as np

from ..backend.entry_points import check_types, checks_types
from ..backend.messages import shown
from ..gaussian.file import check_index_range, check_sides
from ..gaussian.gaussians import Fitted, Gaussians
from ..image.metrics import MAX_PSNR
from ..image.pixels import check_encoding
from ..image.space import FAMILY_SPACES, Space, space_of
from .coarse import Coarse
from .loss import Loss
from .method import DEFAULT, Method, Model
from .place import Adaptive

DEFAULT_COUNT = 5000
"""Number of Gaussians by default."""

PIXELS_PER_FIRST_GAUSSIAN = 64
"""Pixels per Gaussian in the first try of a search for the number of Gaussians."""

COLOR_PARAMETERS = 5
"""Parameters of a Gaussian without its colour: two of the mean and three of the factor."""

Levels = int | Sequence[int]
"""A number of levels of detail, or the number of Gaussians up to each level in ascending order."""

LEVEL_RATIO = 4
"""Ratio of the numbers of Gaussians up to a level and up to the previous level; 4 halves their
spacing."""

Start: TypeAlias = "Gaussians | Fitted | Model | str | os.PathLike[str]"
"""What a fit starts from: a set, the file of a set, or a model."""

Exclusion = tuple[str, str, str]
"""Names of parameters, names of others that each of them excludes, and why, or what to give."""

EXCLUSIONS: tuple[Exclusion, ...] = (
    ("gaussians levels", "target_psnr Map.goal", "a search finds how many, up to max_gaussians"),
    ("gaussians levels", "loss.target", "a search finds how many"),
    ("target_psnr Map.goal", "loss.target", "a search has one target"),
    ("levels", "loss", "levels are for the squared error"),
    ("levels", "start", "the Gaussians of levels are placed anew"),
    ("start", "maps", "a start is for one image"),
    ("space", "maps", "give each map a space of its own"),
    ("size", "image maps", "size is for a loss without an image"),
    ("target_psnr", "size", "without an image there is no PSNR; give the loss a target"),
    ("encoding", "size", "encoding is for the pixels of an image"),
)
"""What `eigengs_dr.fit` does not take together. "levels" are also several numbers of Gaussians,
"maps" a mapping of images."""


Function = TypeVar("Function", bound=Callable[..., Any])


def refuse_unknown(given: Collection[str], names: Collection[str]) -> None:
    """Raise TypeError for an unknown option, and name the option that it resembles."""
    for name in given:
        if name not in names:
            parts = [known for known in names if name in known.split("_")]
            close = parts or get_close_matches(name, names, 1)
            advice = f"did you mean {close[0]!r}?" if close else f"use one of {', '.join(names)}"
            raise TypeError(f"unknown option {name!r}; {advice}")


def named_options(function: Function) -> Function:
    """Decorate a function whose unknown keywords `refuse_unknown` reports."""
    names = list(signature(function).parameters)

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        refuse_unknown(options, names)
        return function(*arguments, **options)

    return call  # type: ignore[return-value]


def conflict_in(
    given: Mapping[str, object],
    exclusions: Sequence[Exclusion] = EXCLUSIONS,
    label: Callable[[str], str] = str,
) -> str | None:
    """Return why two parameters exclude each other, in one line, if neither is None.

    It calls them by their labels: on the command line, by its options.
    """
    for names, others, reason in exclusions:
        for one, other in product(names.split(), others.split()):
            if given.get(one) is not None and given.get(other) is not None:
                return f"{label(one)} and {label(other)} exclude each other: {reason}"
    return None


@dataclass(frozen=True)
class Goal:
    """A PSNR to reach with as few Gaussians as possible.

    Attributes
    ----------
    psnr : float
        In dB, above 0 and at most 100. A picture whose psnr_ycbcr is above 100 reaches each: in 8
        bits, rounding errors at halves of levels, as of a constant 0.5, leave about 50 dB.
    space : {"rgb", "ycbcr"}
        Whether it is a psnr_rgb or a psnr_ycbcr of an image. Data, normals and light above 1 have
        only one PSNR, see `key`.
    max_gaussians : int or None
        Largest number of Gaussians; an image with fewer pixels takes one per pixel at most. By
        default they have at most as many parameters as the image has numbers: 3 Gaussians for 8
        pixels in colour.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    psnr: float
    space: str = "rgb"
    max_gaussians: int | None = None

    def __post_init__(self) -> None:
        for name, value in check_types(vars(self), Goal.__annotations__).items():
            object.__setattr__(self, name, value)
        if not 0 < self.psnr <= MAX_PSNR:
            raise ValueError(
                f"target_psnr is {self.psnr}; it must be above 0 and at most {MAX_PSNR:g}"
            )
        if self.space not in FAMILY_SPACES:
            raise ValueError(f"Goal: space {self.space!r} is unknown; use one of rgb, ycbcr")
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise ValueError(f"max_gaussians is {self.max_gaussians}; it must be at least 1")

    def key(self, space: Space) -> str:
        """Return the key of the rows of a trace that must reach the goal.

        Data, normals and light above 1 may exceed the range to which psnr_rgb clamps; for these it
        is psnr_ycbcr, in the `figure` of the space.
        """
        return f"psnr_{self.space}" if space.has_rgb else "psnr_ycbcr"


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """The options of `eigengs_dr.fit`, which describes each of them.

    Raises
    ------
    ValueError
        If an option is out of range, or two options contradict each other.
    """

    gaussians: int | Sequence[int] | None = None
    iterations: int = 1000
    target_psnr: float | Goal | None = None
    start: Start | None = None
    space: Space | None = None
    method: Method = field(default=DEFAULT, repr=False)
    seed: int = 0
    backend: str | None = None
    encoding: str | None = None
    loss: Loss | None = None
    levels: int | None = None

    def __post_init__(self) -> None:
        given = self.gaussians
        if isinstance(given, (Sequence, np.ndarray)) and not isinstance(given, (str, bytes)):
            object.__setattr__(self, "gaussians", tuple(_check_rising("gaussians", given)))
        if self.target_psnr is not None and not isinstance(self.target_psnr, Goal):
            object.__setattr__(self, "target_psnr", Goal(self.target_psnr))
        kinds = FitOptions.__annotations__
        if not isinstance(self.gaussians, tuple):
            kinds = kinds | {"gaussians": "int | None"}
        for name, value in check_types(vars(self), kinds).items():
            object.__setattr__(self, name, value)
        for name, least in (("gaussians", 1), ("iterations", 0), ("seed", 0), ("levels", 1)):
            count = getattr(self, name)
            if isinstance(count, int) and count < least:
                raise ValueError(f"{name} is {count!r}; it must be at least {least}")
        if self.iterations > MAX_ITERATIONS:
            raise ValueError(
                f"iterations is {self.iterations}; it must be at most {MAX_ITERATIONS}"
            )
        check_encoding(self.encoding)
        if self.space is not None:
            object.__setattr__(self, "space", space_of(self.space))
        if not isinstance(self.method, Method):
            raise TypeError(
                f"method is {shown(self.method)}; pass a Method, such as eigengs_dr.DEFAULT"
            )
        if self.method.needs_model and not isinstance(self.start, Model):
            raise ValueError(
                "this method starts from a model; give one as the start, such as "
                "EigenGS.load('natural')"
            )
        self._check_nested()

    def _check_nested(self) -> None:
        """Raise ValueError if other options exclude what a search or levels need."""
        if conflict := conflict_in(self.given):
            raise ValueError(conflict)
        if self.levels and isinstance(self.gaussians, tuple):
            raise ValueError("levels and numbers of Gaussians up to each exclude each other")
        is_adaptive = self.method.place == Adaptive()
        if self.has_levels and not is_adaptive:
            raise ValueError("levels need the placement Adaptive; leave them or the method out")
        if not self.searches or isinstance(self.method.place, Coarse):
            return
        if not is_adaptive or self.start is not None or not self.method.in_phase("redistribute"):
            raise ValueError(
                f"{'target_psnr' if self.goal else 'loss.target'} needs a method that places "
                "Gaussians by the image and redistributes them, such as DEFAULT, and no start"
            )

    @property
    def given(self) -> dict[str, object]:
        """The options by the names in `EXCLUSIONS`; None for what is not given."""
        target = self.loss.target if self.loss else None
        return vars(self) | {"levels": self.has_levels or None, "loss.target": target}

    @property
    def goal(self) -> Goal | None:
        """The goal of a search."""
        return self.target_psnr if isinstance(self.target_psnr, Goal) else None

    @property
    def searches(self) -> bool:
        """Whether the number of Gaussians is searched: the smallest that reaches a target."""
        return self.goal is not None or (self.loss is not None and self.loss.target is not None)

    @property
    def has_levels(self) -> bool:
        """Whether the first Gaussians of the set form the image too."""
        return self.levels is not None or isinstance(self.gaussians, tuple)

    def levels_for(self, pixels: int) -> tuple[int, ...]:
        """Return the numbers of Gaussians up to each level; () without levels.

        Raises
        ------
        ValueError
            If an image of so many pixels has too few Gaussians for the number of levels.
        """
        if isinstance(self.gaussians, tuple):
            return self.gaussians
        return tuple(level_counts(self.count_for(pixels), self.levels)) if self.levels else ()

    def check_image(self, width: int, height: int, channels: int) -> None:
        """Raise ValueError for more Gaussians than pixels, and for an image too large to index."""
        check_sides((width, height))
        check_index_range(width, height, channels)
        count = self.count
        if count is not None and not 1 <= count <= width * height:
            raise ValueError(
                f"gaussians is {count}; an image of {width}x{height} takes 1 to {width * height}"
            )
        self.levels_for(width * height)

    @property
    def count(self) -> int | None:
        """Number of Gaussians, if the user gives one; with levels, of all."""
        given = self.gaussians
        return given[-1] if isinstance(given, tuple) else given  # type: ignore[return-value]

    def count_for(self, pixels: int) -> int:
        """Return the number of Gaussians for so many pixels, if the fit does not search for it."""
        return self.count or default_count(pixels)

    def max_count_for(self, pixels: int, channels: int) -> int:
        """Return the largest number of Gaussians that a search tries."""
        limit = self.goal.max_gaussians if self.goal else None
        return min(limit, pixels) if limit else max_gaussians_for(pixels, channels)

    def first_try(self, pixels: int, channels: int) -> int:
        """Return the number of Gaussians with which a search starts."""
        return min(
            self.max_count_for(pixels, channels), max(1, pixels // PIXELS_PER_FIRST_GAUSSIAN)
        )


MAX_ITERATIONS = 10_000_000  # lists of what happens at which step take memory


def default_count(pixels: int) -> int:
    """Return the default number of Gaussians: `DEFAULT_COUNT`, at most one per pixel."""
    return min(DEFAULT_COUNT, pixels)


def max_gaussians_for(pixels: int, channels: int) -> int:
    """Return the number of Gaussians with as many parameters as an image has numbers."""
    return max(1, pixels * channels // (COLOR_PARAMETERS + channels))


@checks_types
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
    TypeError
        If a number is not whole.

    Examples
    --------
    >>> level_counts(5000, 4)
    [78, 312, 1250, 5000]
    >>> level_counts(9000, [5000, 7000, 9000])
    [5000, 7000, 9000]
    """
    if count < 1:
        raise ValueError(f"count is {count}; it must be at least 1")
    if isinstance(levels, Sequence):
        counts = _check_rising("levels", levels)
        if counts[-1] != count:
            raise ValueError(
                f"levels is {shown(levels)}; the last must be the number of Gaussians, {count}"
            )
        return counts
    check_types({"levels": levels}, {"levels": "int"})
    max_levels = 1
    while count >= LEVEL_RATIO**max_levels:
        max_levels += 1
    if not 1 <= levels <= max_levels:
        raise ValueError(f"levels is {levels}; {count} Gaussians make 1 to {max_levels}")
    return [count // LEVEL_RATIO**k for k in reversed(range(levels))]


def _check_rising(name: str, counts: Sequence[int]) -> list[int]:
    """Return numbers of Gaussians up to each level, which must be whole and rise."""
    check_types({name: counts}, {name: "Sequence[int]"})
    if not len(counts) or not all(a < b for a, b in pairwise([0, *counts])):
        raise ValueError(f"{name} is {shown(counts)}; its numbers must rise, from 1 or more")
    return [int(n) for n in counts]
