"""Adam without the NaN of long runs."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
from drjit.opt import Adam as DrjitAdam


class Adam(DrjitAdam):
    """Dr.Jit's Adam with a limit on its count of steps.

    Debiasing divides by ``1 - beta^t``. Dr.Jit 1.5 computes ``beta^t`` in double precision and
    returns minus infinity for powers just below the smallest normal number: with a beta of 0.9,
    the steps 6,734 to 6,736 would turn all variables into NaN. If ``beta^t`` is below 2^-54, the
    division changes nothing, so the count stops there.

    The parameters are those of `drjit.opt.Adam`. Both betas must be above 0, and close to each
    other: when the power of the larger is 2^-54, the power of the smaller must be a normal number.

    Raises
    ------
    ValueError
        If the betas differ too much.
    """

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        betas = (self.beta_1, self.beta_2)
        self.last = math.ceil(54 / -math.log2(max(betas)))
        if -math.log2(min(betas)) * self.last > 1000:
            raise ValueError(f"Adam: betas are {betas}; they must be closer to each other")

    def _step(self, cache: Any, value: Any, grad: Any, lr: Any, extra: Any, /) -> tuple[Any, Any]:
        t, *averages = extra
        return super()._step(cache, value, grad, lr, (dr.minimum(t, self.last), *averages))
