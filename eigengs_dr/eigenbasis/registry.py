"""Models by name, from the package or from files."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from ..backend.arrays import types_of
from .eigengs import EigenGS

SHIPPED = {"natural": Path(__file__).parent / "data" / "natural.npz"}
"""Files of the package's models, by name; see ``tools/train_natural.py``."""


def load_basis(basis: str | os.PathLike[str] | EigenGS, backend: str | None = None) -> EigenGS:
    """Load a model by name or file.

    Parameters
    ----------
    basis : str, path-like or EigenGS
        A name of `SHIPPED`, whose file is read once; a file; or a model, which is returned.
    backend : {"llvm", "cuda"}, optional

    Raises
    ------
    ValueError
        If the name or file does not exist, the file is no model, or the model is on another
        backend.
    """
    if isinstance(basis, EigenGS):
        current = types_of(basis.gaussians.mean).backend
        if backend not in (None, current):
            raise ValueError(
                f"the basis is a model on backend {current!r}, not on {backend!r}; load it with "
                f"backend={backend!r}, or leave the backend out"
            )
        return basis
    if basis in SHIPPED:
        return _shipped(str(basis), backend)
    if not Path(basis).is_file():
        names = ", ".join(SHIPPED)
        raise ValueError(f"basis {str(basis)!r} is neither a file nor one of: {names}")
    return EigenGS.load(basis, backend)


@cache
def _shipped(name: str, backend: str | None) -> EigenGS:
    return EigenGS.load(SHIPPED[name], backend)
