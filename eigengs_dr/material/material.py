"""Materials: Gaussians with the channels of several maps."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
from numpy.typing import NDArray

from ..backend.arrays import types_of
from ..backend.feedback import to_html
from ..backend.recording import exclusive
from ..gaussian.gaussians import Gaussians
from ..raster.render import render
from ..storage.npz import BadValue
from .file import MaterialData, read, write
from .maps import TextureMap, check_maps, find_map, show_sums, slices


@dataclass(eq=False)
class Material:
    """Several maps on the same means and shapes: albedo, roughness, normals, ...

    ``material["albedo"]`` is the set of one map: an ordinary `eigengs_dr.Gaussians` in the space of
    the map, for `eigengs_dr.render` and for textures. The sets of all maps share the memory of
    means and shapes. The class is a PyTree.

    Attributes
    ----------
    gaussians : Gaussians
        The channels of all maps, in the order of the maps, in the space "data": each map in its own
        units.
    maps : tuple of TextureMap
        The name, space, number of channels and weight of each map. The maps have at most 16
        channels together.

    Raises
    ------
    ValueError
        If the maps are invalid or do not fit the channels.

    Examples
    --------
    >>> import eigengs_dr as eg
    >>> from eigengs_dr.material.maps import TextureMap
    >>> g = eg.Gaussians.from_arrays(
    ...     [[4, 4]], [[0.5, 0, 0.5]], [[1, 1, 1, 0.5]], size=(8, 8), space="data"
    ... )
    >>> maps = TextureMap("albedo", "linear", 3), TextureMap("roughness", "data", 1)
    >>> material = eg.Material(g, maps)
    >>> list(material), eg.render(material["roughness"]).shape
    (['albedo', 'roughness'], (8, 8, 1))
    """

    gaussians: Gaussians
    maps: tuple[TextureMap, ...]

    def __post_init__(self) -> None:
        try:
            check_maps(self.maps, self.gaussians.channels)
        except BadValue as error:
            raise ValueError(f"Material: {error}") from None

    def __repr__(self) -> str:
        g = self.gaussians
        return f"Material({len(g)} Gaussians, {g.width}x{g.height} pixels: {', '.join(self)})"

    _repr_html_ = to_html  # what a notebook shows

    def __len__(self) -> int:
        """Return the number of maps."""
        return len(self.maps)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the maps."""
        return iter([m.name for m in self.maps])

    @exclusive()
    def __getitem__(self, name: str) -> Gaussians:
        """Return the set of one map; it shares means and shapes; differentiable.

        Raises
        ------
        KeyError
            If there is no such map; the message lists the names.
        """
        try:
            number = find_map(self.maps, name)
        except BadValue as error:
            raise KeyError(f"Material: {error}") from None
        g, own = self.gaussians, slices(self.maps)[number]

        def take(rows: Any) -> Any:
            return type(rows)([rows[k] for k in range(own.start, own.stop)])

        return replace(
            g, color=take(g.color), background=take(g.background), space=self.maps[number].space
        )

    def first(self, count: int) -> Material:
        """Return the first Gaussians: a level, if the material was fitted with levels."""
        return replace(self, gaussians=self.gaussians[:count])

    @exclusive()
    def pictures(self, width: int | None = None, height: int | None = None) -> dict[str, Any]:
        """Render all maps in one pass.

        Parameters
        ----------
        width, height : int, optional
            Size in pixels, as for `eigengs_dr.render`.

        Returns
        -------
        dict of str to ndarray, shape (height, width, C)
            What `eigengs_dr.picture_of` gives for the set of each map, up to rounding.
        """
        sums: NDArray[Any] = render(dr.detach(self.gaussians), width, height).numpy()
        cuts = zip(self.maps, slices(self.maps), strict=True)
        return {m.name: show_sums(m.space, sums[..., own]) for m, own in cuts}

    def data(self) -> MaterialData:
        """Return the content for a file."""
        g = self.gaussians
        return MaterialData(g.to_arrays(), (g.width, g.height), g.cutoff, self.maps)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the material as an ``.npz`` file, completely or not at all.

        Raises
        ------
        ValueError
            If the suffix is ``.egs``; use `eigengs_dr.pack_material` for such files.
        OSError
            If the file cannot be written; an existing file does not change.
        """
        write(path, self.data())

    @classmethod
    def load(cls, path: str | os.PathLike[str], backend: str | None = None) -> Material:
        """Read a material that `save` or `eigengs_dr.pack_material` wrote.

        Parameters
        ----------
        path : path-like
        backend : {"llvm", "cuda"}, optional
            As for `eigengs_dr.Gaussians.from_arrays`.

        Raises
        ------
        ValueError
            If the file holds something else, is damaged, or holds invalid values. One line names
            the file and the key.
        OSError
            If the file cannot be opened.
        """
        data = read(Path(path))
        return cls(Gaussians.from_data(data.set_data(), backend), data.maps)


def scale_channels(gaussians: Gaussians, factors: Sequence[float]) -> Gaussians:
    """Multiply colours and background by a factor for each channel."""
    FloatX = types_of(gaussians.mean).FloatX

    def scale(rows: Any) -> Any:
        return FloatX([row * float(f) for row, f in zip(rows, factors, strict=True)])

    return replace(gaussians, color=scale(gaussians.color), background=scale(gaussians.background))
