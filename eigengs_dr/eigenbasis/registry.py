"""Models by name, from the package or from files."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from ..backend.arrays import types_of
from ..fitting.options import default_count
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from .eigengs import EigenGS
from .pca.basis import Eigenbasis

SHIPPED = {"natural": Path(__file__).parent / "data" / "natural.npz"}
"""Files of the package's models, by name; see ``tools/train_natural.py``."""


@dataclass(frozen=True, eq=False)
class PackedModel:
    """A model as NumPy arrays, for another process.

    Attributes
    ----------
    shapes : SetData
        The Gaussians of the model.
    members : dict
        The other attributes of `eigengs_dr.EigenGS`.
    backend : str or None
        The backend of the model.
    """

    shapes: SetData
    members: dict[str, Any]
    backend: str | None

    @cached_property
    def model(self) -> EigenGS:
        """The model, with the bits of the first; it is built once in a process."""
        return EigenGS(Gaussians.from_data(self.shapes, self.backend), **self.members)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the model here: arrays of Dr.Jit do not travel."""
        return {key: value for key, value in self.__dict__.items() if key != "model"}


def pack_basis(
    basis: str | os.PathLike[str] | EigenGS | Eigenbasis,
    backend: str | None = None,
    gaussians: int | None = None,
) -> str | PackedModel:
    """Return a model in a form that travels to another process, for `load_basis` there.

    Parameters
    ----------
    basis : str, path-like or EigenGS
        As for `load_basis`, also for errors. A name of `SHIPPED` stays a name.
    backend : {"llvm", "cuda"}, optional
        Backend there.
    """
    if isinstance(basis, str) and basis in SHIPPED:
        return basis
    model = load_basis(basis, gaussians=gaussians)
    names = [field.name for field in fields(EigenGS) if field.name != "gaussians"]
    members = {name: getattr(model, name) for name in names}
    return PackedModel(model.gaussians.data(), members, backend)


def load_basis(
    basis: str | os.PathLike[str] | EigenGS | Eigenbasis | PackedModel,
    backend: str | None = None,
    gaussians: int | None = None,
) -> EigenGS:
    """Load a model by name or file.

    Parameters
    ----------
    basis : str, path-like, EigenGS, Eigenbasis or PackedModel
        A name of `SHIPPED`, whose file is read once; a file; a model, which is returned; or an
        `Eigenbasis`, to which a model is fitted.
    backend : {"llvm", "cuda"}, optional
    gaussians : int, optional
        Number of Gaussians of a model that is fitted.

    Raises
    ------
    ValueError
        If the name or file does not exist, the file is no model, or the model is on another
        backend.
    """
    if isinstance(basis, Eigenbasis):
        pixels = basis.width * basis.height
        return EigenGS.fit(
            basis, gaussians or default_count(pixels), backend=backend, progress=False
        )
    if isinstance(basis, PackedModel):
        basis = basis.model
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
