"""A method of fitting as a value: where Gaussians start, what moves them, and by which rates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import NamedTuple, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..backend.entry_points import check_fields
from ..backend.messages import shown
from ..gaussian.file import CUTOFF, MAX_CUTOFF
from ..gaussian.gaussians import Gaussians
from .control import (
    Backtrack,
    Control,
    Perturb,
    Phase,
    Redistribute,
    Relocate,
    Surplus,
    phase_of,
)
from .objective import Pixels
from .place import Adaptive, Placement
from .solve import solve
from .state import Adam, Coordinates, Optimizer, Relative, State


class Schedule(NamedTuple):
    """The factors of all learning rates of a descent.

    Attributes
    ----------
    factors : list of float
        From `Method.rate_factors`.
    warm_up : int
    """

    factors: list[float]
    warm_up: int

    def rate(self, step: int, state: State, largest: float = 1.0, kind: type = float) -> float:
        """Return the rate of a step of a variable with the largest rate `largest`.

        It rises after the start of the optimiser. `kind` is the precision in which it is computed.
        """
        warm = min(1.0, (step - state.since + 1) / max(1, self.warm_up))
        rate: float = kind(largest * self.factors[step]) * (kind(warm) * kind(state.speed))
        return rate


@runtime_checkable
class Model(Protocol):
    """Makes a set from an image at once, as `eigengs_dr.EigenGS` does."""

    @property
    def gaussians(self) -> Gaussians:
        """Gaussians at the native size of the model."""

    def encode(
        self, image: NDArray[np.float32], colors: str = "exact", mean: str = "gaussians"
    ) -> Gaussians:
        """Return the set of an image at the size of the image."""

    def dense_mean(self, width: int, height: int) -> NDArray[np.float32]:
        """Return the pixels (height, width, C) that a set lacks if the mean is "dense"."""


@dataclass(frozen=True)
class Method:
    """How `eigengs_dr.fit` fits; change it by `dataclasses.replace`.

    Attributes
    ----------
    place : Placement
        Where Gaussians start without a given start.
    controls : tuple of Control
        What adds, moves and removes Gaussians, in this order.
    optimizer : Optimizer
    rates : mapping of str to float
        Largest learning rate of every variable. With the coordinates `Relative`, the rates of mean
        and factor are relative to the size of the Gaussian, and the unit of color is white, or the
        range of data.
    coordinates : Coordinates
        The variables that steps move.
    warm_up : int
        Steps over which the rates rise after each start of the optimiser: at the first step, and
        after a control has changed Gaussians. The moments start at 0 there, and the first steps of
        Adam have full length whatever the gradient.
    decay : float
        Fraction of the rates at the end, after half a cosine.
    drift : float
        Sum of the largest rates after which the tile lists are built again, up to 96x96 pixels
        1.6 times as much. A build enlarges the Gaussians by what they may move until the next
        build, see `Coordinates.reach`.
    rate_exponent : float
        Exponent by which the rates of means and shapes fall with the colour, see
        `eigengs_dr.fitting.step.rate_scale_of`.
    average : float
        Share of the steps at the end whose mean set is the result, in [0, 1): for derivatives with
        noise, see `eigengs_dr.fitting.loop.averaged`. Controls must leave their Gaussians alone.
    solve_steps : int
        Steps of conjugate gradients in the colour solve before the first step.
    cutoff : float
        Radius of a Gaussian in standard deviations, in (0, 12]; the set keeps it.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import eigengs_dr as eg
    >>> method = replace(eg.DEFAULT, cutoff=4.0)
    >>> eg.fit(eg.sample("coffee")[:32, :32], 50, 10, method=method).gaussians.cutoff
    4.0
    """

    place: Placement
    controls: tuple[Control, ...]
    optimizer: Optimizer
    rates: Mapping[str, float]
    coordinates: Coordinates
    warm_up: int = 5
    decay: float = 0.03
    drift: float = 1.0
    rate_exponent: float = 0.0
    average: float = 0.0
    solve_steps: int = 10
    cutoff: float = CUTOFF

    needs_model = False
    """Whether the start must be a model."""

    def __post_init__(self) -> None:
        check_fields(self, warm_up="[0, inf)", decay="[0, 1]", drift="[0, inf)")
        check_fields(self, rate_exponent="[0, inf)", average="[0, 1)", solve_steps="[0, inf)")
        check_fields(self, cutoff=f"(0, {MAX_CUTOFF:g}]")
        self._check_parts()
        if self.average and self.controls:
            raise ValueError(
                f"average is {self.average}; it must be 0 with controls, which exchange Gaussians"
            )
        every = {phase_of(c): getattr(c, "every", 0) for c in reversed(self.controls)}
        if every.get("densify") and not 0 < every.get("relocate", 0) <= every["densify"]:
            raise ValueError(
                "controls: a Surplus leaves by a Relocate that comes as often; add one, or leave "
                "the Surplus out"
            )

    def _check_parts(self) -> None:
        """Raise TypeError or ValueError unless each part has what a fit calls."""
        kinds = {"place": Placement, "optimizer": Optimizer, "coordinates": Coordinates}
        parts = [(name, getattr(self, name), kind) for name, kind in kinds.items()]
        if not isinstance(self.controls, (tuple, list)):
            raise TypeError(f"Method: controls is {shown(self.controls)}; give a tuple of controls")
        for name, part, kind in [*parts, *(("a control", c, Control) for c in self.controls)]:
            if isinstance(part, type) or not isinstance(part, kind):
                raise TypeError(
                    f"Method: {name} is {shown(part)}, which lacks what a {kind.__name__} has; "
                    f"see {kind.__module__}.{kind.__name__}"
                )
        rates = self.rates if isinstance(self.rates, Mapping) else {}
        plain = all(isinstance(r, Real) and not isinstance(r, bool) for r in rates.values())
        if not (rates and plain and all(0 < r < math.inf for r in rates.values())):
            raise ValueError(f"Method: rates are {self.rates!r}; each must be above 0 and finite")

    def __hash__(self) -> int:  # a dictionary has none
        return hash(tuple(sorted(self.rates.items())))

    def __repr__(self) -> str:
        lines = [f"    {f.name}={getattr(self, f.name)!r}," for f in fields(self)]
        return "\n".join([f"{type(self).__name__}(", *lines, ")"])

    def rate_factors(self, iterations: int) -> list[float]:
        """Return the factors of the learning rates at all steps: half a cosine down to `decay`.

        The steps before a redistribution have their own cosine, which gains 0.03 to 0.1 dB.
        """
        first, factors = self.first_phase(iterations), []
        for length in (first, iterations - first):
            for step in range(length):
                falling = 0.5 * (1 + math.cos(math.pi * step / length))
                factors.append(self.decay + (1 - self.decay) * falling)
        return factors

    def first_phase(self, iterations: int) -> int:
        """Return the steps before a redistribution; 0 if there is none."""
        return max(self.steps_in("redistribute", iterations), default=0)

    def in_phase(self, phase: Phase) -> list[Control]:
        """Return the controls of a phase."""
        return [control for control in self.controls if phase_of(control) == phase]

    def steps_in(self, phase: Phase, iterations: int) -> set[int]:
        """Return the steps of a descent before which controls of a phase act."""
        return {step for control in self.in_phase(phase) for step in control.steps(iterations)}

    def without(self, *phases: Phase) -> Method:
        """Return the method without the controls of some phases.

        Examples
        --------
        >>> import eigengs_dr as eg
        >>> eg.DEFAULT.without("densify", "redistribute", "relocate", "perturb").controls
        (Backtrack(rise=4.0, factor=0.4, first=10),)
        """
        known = get_args(Phase)
        for phase in phases:
            if not isinstance(phase, str) or phase not in known:
                raise ValueError(f"phase {shown(phase)} is unknown; use one of {', '.join(known)}")
        kept = tuple(c for c in self.controls if phase_of(c) not in phases)
        return replace(self, controls=kept)

    def at_rates(self, factor: float) -> Method:
        """Return the method with all learning rates times a factor."""
        return replace(self, rates={name: factor * rate for name, rate in self.rates.items()})

    def place_and_solve(self, objective: Pixels, count: int, seed: int = 0) -> Gaussians:
        """Return Gaussians where the placement puts them, with the best colours for the image."""
        placed = self.place(objective, count, self.cutoff, seed)
        return placed if self.place.has_colors else solve(placed, objective, self.solve_steps)

    def start_from(self, objective: Pixels, gaussians: Gaussians) -> Gaussians:
        """Return a set with better colours for the image: the solve starts from its colours.

        A method whose placement has colours skips the solve here too.
        """
        if self.place.has_colors:
            return gaussians
        return solve(gaussians, objective, self.solve_steps, warm_start=True)

    def start_from_model(
        self, objective: Pixels, model: Model, pixels: NDArray[np.float32]
    ) -> tuple[Pixels, Gaussians]:
        """Return the objective, and the Gaussians of a model with the best colours for the image.

        At another size or cutoff the exact colours of the model are not the best.
        """
        encoded, native = replace(model.encode(pixels), cutoff=float(self.cutoff)), model.gaussians
        same = (native.width, native.height, native.cutoff) == (*objective.size, self.cutoff)
        return objective, encoded if same else self.start_from(objective, encoded)


DEFAULT = Method(
    place=Adaptive(),
    controls=(Backtrack(), Surplus(), Redistribute(), Relocate(), Perturb()),
    optimizer=Adam(0.9, 0.9, 1e-12),
    rates={"mean": 0.4, "factor": 0.22, "color": 0.0115},
    coordinates=Relative(),
    decay=0.045,
    drift=1.4,
    rate_exponent=0.8,
)
"""The method of this package."""
