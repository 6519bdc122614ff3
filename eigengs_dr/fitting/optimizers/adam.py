"""Adam that survives long runs."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
from drjit.opt import Adam as DrjitAdam


class Adam(DrjitAdam):
    """Dr.Jit's Adam, whose count of steps stops where its averages need no debiasing any more.

    Debiasing divides by ``1 - beta^t``. Dr.Jit 1.5 computes that power in double precision, and
    its result is minus infinity for powers just below the least normal number: with a beta of 0.9
    the steps 6,734 to 6,736 would turn all variables into NaN. Powers below 2^-54 round to the
    same quotient, so the count may stop there.

    Parameters are those of `drjit.opt.Adam`; both betas must be above 0, and so close that the
    power of the smaller is a normal number where that of the larger is 2^-54.
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
