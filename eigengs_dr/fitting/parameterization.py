"""Parameterizations: the variables that an optimiser moves, and their Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import drjit as dr

from ..backend.arithmetic import rsqrt, tanh
from ..backend.arrays import types_of
from ..gaussian.covariance import cholesky_from_factor, factor_from_cholesky
from ..gaussian.gaussians import Gaussians


class Parameterization(NamedTuple):
    """A change of variables, differentiable by Dr.Jit.

    Attributes
    ----------
    encode : callable
        ``encode(gaussians) -> dict`` of named arrays.
    decode : callable
        ``decode(fixed, variables, size=None) -> Gaussians``, with `fixed` the argument of
        `encode`. Fields without a variable keep the values of `fixed`. `size` is the width and
        the height of `fixed`, in arrays if the program shall serve every size.
    project : callable
        ``project(fixed, variables, size=None) -> dict``: the variables, moved back into their
        bounds.
    reach : callable
        ``reach(fixed, moves) -> (pad, growth)``: how far the ellipses of the Gaussians reach, in
        pixels and as a factor, if every entry of a variable moves by ``moves[name]``.
    """

    encode: Callable[[Gaussians], dict[str, Any]]
    decode: Callable[..., Gaussians]
    project: Callable[..., dict[str, Any]]
    reach: Callable[[Gaussians, dict[str, float]], tuple[Any, float]]


# ---------------------------------------------------------------------------------------------
#  The parameters themselves, in units of the size of each Gaussian
# ---------------------------------------------------------------------------------------------


def _size(g: Gaussians) -> Any:
    """Geometric mean of the standard deviations of a Gaussian, in pixels: ``det F = a c``."""
    return rsqrt(g.factor[0] * g.factor[2])


def _encode_relative(g: Gaussians) -> dict[str, Any]:
    return _relative_to(g, _size(g))


def _relative_to(g: Gaussians, size: Any) -> dict[str, Any]:
    return {"mean": g.mean / size, "factor": g.factor * size, "color": g.color}


def _decode_relative(fixed: Gaussians, variables: dict[str, Any], size: Any = None) -> Gaussians:
    own = _size(fixed)
    units = {"mean": own, "factor": 1 / own, "color": 1}
    return replace(fixed, **{name: value * units[name] for name, value in variables.items()})


def _project_relative(
    fixed: Gaussians, variables: dict[str, Any], size: Any = None
) -> dict[str, Any]:
    inside = _relative_to(_decode_relative(fixed, variables).bounded(size), _size(fixed))
    return {name: inside[name] for name in variables}


MOVE_SHARE, GROWTH_SHARE = 0.25, 0.1
"""How far Gaussians move and grow, relative to the sum of the rates. Steps change direction: with
these shares, lists miss about 1 % of the tiles just before the next build, and a fit has the PSNR
of lists that are built twice as often. The strict bounds, 1 and 1, would make the lists half as
long again."""


def _reach_relative(fixed: Gaussians, moves: dict[str, float]) -> tuple[Any, float]:
    # An array, because another literal in every build would compile the kernels again.
    share = dr.opaque(types_of(fixed.mean).Float, MOVE_SHARE * moves.get("mean", 0.0))
    return share * _size(fixed), 1 + GROWTH_SHARE * moves.get("factor", 0.0)


SCALE_RELATIVE = Parameterization(
    _encode_relative, _decode_relative, _project_relative, _reach_relative
)
"""Mean divided by the size of the Gaussian at the start, factor times this size, and colour. One
learning rate then serves small and large Gaussians, and images of any size."""


# ---------------------------------------------------------------------------------------------
#  The parameters of GaussianImage (Zhang et al., ECCV 2024)
# ---------------------------------------------------------------------------------------------

CHOLESKY_BOUND = 0.5
"""Pixels added to the diagonal of the Cholesky factor, as GaussianImage does."""

MIN_DIAGONAL = 0.01
"""Smallest diagonal entry of the Cholesky factor in pixels. GaussianImage has no such bound, but an
entry that reaches 0 makes the covariance singular, and the set not finite."""


def _encode_cholesky(g: Gaussians) -> dict[str, Any]:
    types = types_of(g.mean)
    x, y = g.mean
    width, height = (dr.opaque(types.Float, side) for side in (g.width, g.height))
    l1, l2, l3 = cholesky_from_factor(*g.factor)
    return {
        "mean": types.Float2(_atanh(2 * x / width - 1), _atanh(2 * y / height - 1)),
        "cholesky": types.Float3(l1 - CHOLESKY_BOUND, l2, l3 - CHOLESKY_BOUND),
        "color": g.color,
    }


def _atanh(x: Any) -> Any:
    return dr.atanh(dr.clip(x, -0.999999, 0.999999))


def _decode_cholesky(fixed: Gaussians, variables: dict[str, Any], size: Any = None) -> Gaussians:
    width, height = size or (fixed.width, fixed.height)
    parts = {}
    if "mean" in variables:
        x, y = (0.5 * (tanh(v) + 1) for v in variables["mean"])
        parts["mean"] = type(fixed.mean)(x * width, y * height)
    if "cholesky" in variables:
        l1, l2, l3 = variables["cholesky"]
        factor = factor_from_cholesky(l1 + CHOLESKY_BOUND, l2, l3 + CHOLESKY_BOUND)
        parts["factor"] = type(fixed.factor)(factor)
    if "color" in variables:
        parts["color"] = variables["color"]
    return replace(fixed, **parts)


def _project_cholesky(
    fixed: Gaussians, variables: dict[str, Any], size: Any = None
) -> dict[str, Any]:
    if "cholesky" not in variables:
        return variables
    l1, l2, l3 = variables["cholesky"]
    least = MIN_DIAGONAL - CHOLESKY_BOUND
    inside = type(variables["cholesky"])(dr.maximum(l1, least), l2, dr.maximum(l3, least))
    return {**variables, "cholesky": inside}


def _reach_cholesky(fixed: Gaussians, moves: dict[str, float]) -> tuple[Any, float]:
    side = 0.5 * max(fixed.width, fixed.height)  # the slope of tanh is at most 1
    return moves.get("mean", 0.0) * side + moves.get("cholesky", 0.0) * fixed.cutoff, 1.0


CHOLESKY = Parameterization(_encode_cholesky, _decode_cholesky, _project_cholesky, _reach_cholesky)
"""atanh of the mean in [-1, 1], Cholesky factor of the covariance in pixels, and colour."""
