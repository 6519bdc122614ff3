"""Make the plugins known to Mitsuba, for the variant in use and for those set later."""

from __future__ import annotations

from functools import cache

import mitsuba as mi

from .gaussian_texture import gaussian_texture


def register_plugins() -> None:
    """Make ``gaussian_texture`` known to Mitsuba.

    For the variant in use, if one is set, and for every variant set later; calling it again
    changes nothing. Scalar variants learn the name as well, and refuse it when a scene uses it.

    Raises
    ------
    ImportError
        If Mitsuba is not installed.

    Examples
    --------
    >>> import eigengs_dr as eg, mitsuba as mi
    >>> mi.set_variant("llvm_ad_rgb")
    >>> eg.register_plugins()
    """
    _follow()
    if mi.variant():
        _register(mi.variant())


@cache
def _follow() -> None:
    mi.detail.add_variant_callback(lambda old, new: _register(new))


@cache
def _register(variant: str) -> None:
    mi.register_texture("gaussian_texture", gaussian_texture())
