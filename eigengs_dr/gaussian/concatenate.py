"""Joining sets of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr

from ..backend.recording import exclusive
from .gaussians import Gaussians, broadcast


@exclusive()
def concatenate(sets: Sequence[Gaussians]) -> Gaussians:
    """Join sets and add their backgrounds: the result renders as the sum of the sets.

    Parameters
    ----------
    sets : sequence of Gaussians
        At least one. All have the same native size, space, cutoff, channels and backend.

    Returns
    -------
    Gaussians
        The Gaussians of the first set, then those of the second, and so on. A single set is
        returned as it is.

    Raises
    ------
    ValueError
        If there are no sets, or they differ in one of these properties.
    """
    if not sets:
        raise ValueError("concatenate: no sets were given; pass at least one")
    first = sets[0]
    kinds = {(g.width, g.height, g.space, g.cutoff, g.channels, type(g.mean)) for g in sets}
    if len(kinds) > 1:
        raise ValueError(
            "concatenate: sets differ in size, space, cutoff, channels or backend; "
            "bring them to one size with scaled() first"
        )
    if len(sets) == 1:
        return first

    def join(name: str) -> Any:
        parts = [getattr(g, name) for g in sets]
        rows = [
            dr.concat([broadcast(part[k], len(g)) for part, g in zip(parts, sets, strict=True)])
            for k in range(len(parts[0]))
        ]
        return type(parts[0])(*rows) if name != "color" else type(parts[0])(rows)

    return replace(
        first,
        mean=join("mean"),
        factor=join("factor"),
        color=join("color"),
        background=sum((g.background for g in sets[1:]), first.background),
    )
