"""Registration of the plugins with Mitsuba."""

from __future__ import annotations

from functools import cache

import mitsuba as mi

from .gaussian_texture import gaussian_texture
from .versions import register_texture


def register_plugins() -> None:
    """Register ``gaussian_texture`` with the current variant of Mitsuba and with later ones.

    Further calls change nothing. In scalar variants, a scene that uses the texture raises an error.

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
    register_texture("gaussian_texture", gaussian_texture())
